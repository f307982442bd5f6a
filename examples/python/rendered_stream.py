"""Serves the frames of another camera socket, as your own camera would be served.

    firmware-sim --rig examples/rig.toml --pty-link examples/pzt --socket box.sock &
    python examples/python/rendered_stream.py box.sock examples/camera.sock &
    cellpos track --target 0um --rig examples/rig.toml
"""

import sys

import cellpos

box, served = sys.argv[1:3]
print(cellpos.serve_camera(cellpos.read_camera(box), 1000.0, served, exposure_s=0.5e-3))
