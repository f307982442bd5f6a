"""Serves a Basler camera through pypylon (pip install pypylon). PYLON_CAMEMU=1 has an emulated one.

    python examples/python/pylon_camera.py camera.sock [--rate 1000] [--bead box.sock]

With --bead the picture of firmware-sim's camera replaces the test pattern. So a bead can be held over the whole path of a Basler camera.
"""

import argparse
import threading
import time

from pypylon import genicam, pylon

import cellpos

arguments = argparse.ArgumentParser()
arguments.add_argument("socket")
arguments.add_argument("--rate", type=float, default=1000.0)
arguments.add_argument("--exposure-us", type=float, default=500.0)
arguments.add_argument("--bead")
options = arguments.parse_args()


def grabbed():
    camera = pylon.InstantCamera(pylon.TlFactory.GetInstance().CreateFirstDevice())
    camera.Open()
    camera.Width.Value, camera.Height.Value, camera.PixelFormat.Value = 256, 32, "Mono8"
    camera.ExposureTimeAbs.Value = options.exposure_us
    camera.AcquisitionFrameRateEnable.Value = True
    # The emulated camera sleeps from frame to frame, and a busy machine lets it sleep too long: 130 to 800 of 1000 frames/s. With a bead
    # each of its frames may carry the next picture, so it is asked for more of them.
    camera.AcquisitionFrameRateAbs.Value = options.rate * (1 if options.bead is None else 5)
    # A real camera's TimeStamp counts from its own start: the offset to this machine's clock is the smallest difference seen. The
    # emulated one has no TimeStamp.
    offset_ns = None
    camera.StartGrabbing(pylon.GrabStrategy_LatestImageOnly)
    lost_in_a_row = 0
    while camera.IsGrabbing():
        try:
            result = camera.RetrieveResult(2000, pylon.TimeoutHandling_ThrowException)
        except genicam.TimeoutException:
            raise
        except genicam.GenericException:
            # A frame that a newer one replaced while it was fetched is a lost frame. Without any for a second the camera is gone.
            lost_in_a_row += 1
            if lost_in_a_row > options.rate:
                raise
            continue
        lost_in_a_row = 0
        with result:
            if not result.GrabSucceeded():
                continue
            now_ns, stamp_ns = time.monotonic_ns(), result.TimeStamp
            if stamp_ns:
                offset_ns = min(now_ns - stamp_ns, offset_ns if offset_ns is not None else now_ns - stamp_ns)
                now_ns = stamp_ns + offset_ns
            mid_ns = now_ns - int(500 * options.exposure_us)
            yield result.Array, mid_ns, result.ImageNumber


def with_bead(frames, box):
    newest = []

    def look():
        for frame in cellpos.read_camera(box):
            newest[:] = [frame]

    threading.Thread(target=look, daemon=True).start()
    last = -1
    for pixels, _, _ in frames:
        if newest and newest[0].frame_id != last:
            frame = newest[0]
            last = frame.frame_id
            pixels[:] = frame.pixels
            yield pixels, frame.mid_exposure_ns, frame.frame_id


frames = grabbed() if options.bead is None else with_bead(grabbed(), options.bead)
print(cellpos.serve_camera(frames, options.rate, options.socket, exposure_s=1e-6 * options.exposure_us))
