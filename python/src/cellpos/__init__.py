"""cellpos: runs as NumPy arrays and pandas tables, the program from Python, cameras and actuators served to it.

    run = cellpos.open("latest")
    run.ticks["bead_um"], run.error_um, run.cycles.to_pandas(), run.events, run.clips, run.meta

    with cellpos.track("0um", "10s") as live:
        for row in live:
            print(row.time_s, row.bead_um)
    print(live.result["rms_true_nm"])
"""

from __future__ import annotations

from ._actuator import ActuatorServer, ActuatorStats, serve_actuator
from ._camera import CameraServer, CameraStats, Frame, read_camera, serve_camera
from ._columns import FLAGS
from ._program import Failed, Live, Result, Row, command, identify, program, reconcile, run, track
from ._run import Run, Session, Table, open, read_csv, runs
from ._tiff import Clip

__all__ = [
    "FLAGS", "ActuatorServer", "ActuatorStats", "CameraServer", "CameraStats", "Clip", "Failed", "Frame", "Live", "Result", "Row", "Run", "Session", "Table",
    "command", "identify", "open", "program", "read_camera", "read_csv", "reconcile", "run", "runs", "serve_actuator",
    "serve_camera", "track",
]  # fmt: skip
__version__ = "0.2.0"
