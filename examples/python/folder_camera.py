"""Serves the pictures of a folder, or a webcam, through imageio (pip install imageio).

    python examples/python/folder_camera.py PICTURES camera.sock --rate 100
    python examples/python/folder_camera.py "<video0>" camera.sock --rate 30
"""

import argparse
from pathlib import Path

import imageio.v3 as imageio
import numpy as np

import cellpos

arguments = argparse.ArgumentParser()
arguments.add_argument("source", help="a folder of pictures, a film, or <video0> for a webcam")
arguments.add_argument("socket")
arguments.add_argument("--rate", type=float, default=30.0)
options = arguments.parse_args()


def pictures():
    folder = Path(options.source)
    if folder.is_dir():
        yield from (imageio.imread(path) for path in sorted(folder.iterdir()))
    else:
        yield from imageio.imiter(options.source)


def grey(picture):
    return picture if picture.ndim == 2 else picture[..., :3].mean(axis=-1).astype(np.uint8)


# A webcam has its own rate; pictures in a folder have none.
paced = Path(options.source).exists()
print(cellpos.serve_camera(map(grey, pictures()), options.rate, options.socket, pace=paced))
