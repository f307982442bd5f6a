"""Frames from Python: the protocol, losses, and a bead that is held over them."""

import os
import re
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, kept_for

import cellpos
from cellpos import _camera
from cellpos._camera import pack_header

pytestmark = pytest.mark.alone


def test_the_header_on_the_page_is_the_one_that_is_sent():
    page = (ROOT / "docs/camera-socket.md").read_text()
    text = re.search(r"has the header\n\n```text\n(.*?)```", page, re.S)[1]
    assert pack_header(77, 123456789012, 123458789012, 500000, 6, 2, 8, 12) == bytes.fromhex(text)


def served(frames, path, **options):
    return cellpos.CameraServer(frames, 1000.0, path, real_time=False, **options)


def test_frames_arrive_as_they_were_with_stamp_and_number(tmp_path):
    path, given = tmp_path / "c.sock", []

    def frames():
        rng = np.random.default_rng(1)
        while len(given) < 300:
            kind = np.uint8 if len(given) % 2 else np.uint16
            given.append((rng.integers(0, 200, (5, 7)).astype(kind), 10**9 + len(given), 3 * len(given)))
            yield given[-1]

    with served(frames(), path, pace=True) as server:
        got = list(cellpos.read_camera(path))
    assert len(got) > 100
    by_id = {frame_id: (pixels, stamp_ns) for pixels, stamp_ns, frame_id in given}
    for frame in got:
        pixels, stamp_ns = by_id[frame.frame_id]
        assert frame.mid_exposure_ns == stamp_ns and frame.pixels.dtype == pixels.dtype
        np.testing.assert_array_equal(frame.pixels, pixels)
    assert server.stats.sent == len(got) and server.stats.unseen + server.stats.dropped == 300 - len(got)


def test_a_slow_reader_loses_whole_frames_that_are_counted_and_the_source_goes_on(tmp_path):
    path, size = tmp_path / "c.sock", (200, 300)
    frames = (np.full(size, i % 251, np.uint8) for i in range(10**9))
    with served(frames, path, pace=True) as server:
        reader = cellpos.read_camera(path)
        got = [next(reader)]
        before = server.stats
        until_s, after = time.monotonic() + 30, before
        # As many as an idle machine has in 0.2 s: a busy one takes longer, a source that waits for the reader has none.
        while after.frames - before.frames <= 200 and time.monotonic() < until_s:
            time.sleep(0.05)
            after = server.stats
        assert after.frames - before.frames > 200
        assert after.dropped - before.dropped > 150
        got += [next(reader) for _ in range(50)]
        stats = server.stats
    numbers = [frame.frame_id for frame in got]
    assert all(np.all(frame.pixels == frame.frame_id % 251) for frame in got)
    lost = np.diff(numbers) - 1
    assert lost.min() >= 0 and lost.max() > 150
    assert int(lost.sum()) <= stats.dropped
    # A few frames waited in the socket, not a second's worth.
    assert int(np.argmax(lost)) <= 12


def test_a_reader_may_go_and_come_back(tmp_path):
    path = tmp_path / "c.sock"
    frames = (np.full((4, 4), i % 251, np.uint8) for i in range(10**9))
    with served(frames, path, pace=True) as server:
        for _ in range(3):
            reader = cellpos.read_camera(path)
            got = [next(reader) for _ in range(20)]
            assert [f.frame_id for f in got] == list(range(got[0].frame_id, got[0].frame_id + 20)) or server.stats.dropped
            reader.close()
        assert server.stats.clients == 3


def test_a_socket_that_is_served_is_not_taken_and_one_left_behind_is(tmp_path):
    path = tmp_path / "c.sock"
    dead = socket.socket(socket.AF_UNIX)
    dead.bind(str(path))
    dead.close()
    frames = (np.zeros((4, 4), np.uint8) for _ in range(10**9))
    with served(frames, path, pace=True), pytest.raises(OSError, match="served by another program"):
        served([], path)
    assert not path.exists()


def test_who_finds_a_servers_socket_may_connect(tmp_path):
    path, refused, stop = tmp_path / "c.sock", [], threading.Event()

    def look():
        while not stop.is_set():
            with socket.socket(socket.AF_UNIX) as client:
                client.setblocking(False)
                try:
                    client.connect(str(path))
                except (FileNotFoundError, BlockingIOError):
                    continue
                except OSError as error:
                    refused.append(error)

    looking = threading.Thread(target=look)
    looking.start()
    listeners = []
    for _ in range(300):
        listeners.append(_camera.listen(path))
        path.unlink()
    stop.set()
    looking.join()
    for listener in listeners:
        listener.close()
    assert not refused, refused[:3]


def test_what_is_no_frame_is_named(tmp_path):
    with pytest.raises(TypeError, match=r"uint8 or uint16, this one is float64 of shape \(2, 2\)"):
        cellpos.serve_camera([np.zeros((2, 2))], 1000.0, tmp_path / "c.sock", real_time=False)
    with pytest.raises(ValueError, match="rate = 0"):
        cellpos.CameraServer([], 0, tmp_path / "c.sock")


def firmware_sim() -> Path:
    found = [Path(cellpos.program()).parent / "firmware-sim", ROOT / "target/debug/firmware-sim"]
    for path in found:
        if path.is_file():
            return path
    pytest.skip("firmware-sim is not built: cargo build -p cellpos-firmware-sim")


@pytest.fixture
def box(tmp_path):
    """firmware-sim, and a rig that sees it through `python.sock`. Times are those of a machine that tests share."""
    text = (ROOT / "examples/rig.toml").read_text()
    for key, value in (("oldest_ms", 60.0), ("faults_in_a_row", 100000), ("lost_ticks", 20000), ("board_silence_ms", 2000.0)):
        text = re.sub(rf"(?m)^{key} = \S+", f"{key} = {value}", text)
    (tmp_path / "rig.toml").write_text(text)
    (tmp_path / "python.toml").write_text(text.replace('"camera.sock"', '"python.sock"'))
    (tmp_path / "inside.toml").write_text("first_neutral_um = 20.0\n[timing]\nfaults_in_a_row = 100000\n")
    words = [firmware_sim(), "--rig", "rig.toml", "--pty-link", "pzt", "--socket", "camera.sock", "--duration", "60s"]
    child = subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    for _ in range(200):
        if (tmp_path / "camera.sock").exists():
            break
        time.sleep(0.02)
    yield tmp_path
    child.terminate()
    child.wait()


def watched(folder: Path, name: str):
    seen = cellpos.command("camera", socket=name, duration="2s", cwd=folder).result
    interval, age = seen["interval_ms"], seen["age_ms"]
    print(
        f"{name:12} {seen['rate_hz']:7.1f} Hz, {seen['dropped']:4d} dropped, interval p50 {interval['p50']:.3f} p99"
        f" {interval['p99']:.3f} max {interval['max']:.2f} ms, age p50 {age['p50']:.3f} p99 {age['p99']:.3f} max {age['max']:.2f} ms"
    )
    return seen


def held_over(folder: Path, script: str, *words: str):
    """A bead held over a camera that an example serves from a separate process."""
    env = dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path), PYLON_CAMEMU="1")
    server = subprocess.Popen(
        [sys.executable, ROOT / "examples/python" / script, *words],
        cwd=folder, env=env, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        for _ in range(300):
            if (folder / "python.sock").exists() or server.poll() is not None:
                break
            time.sleep(0.02)
        time.sleep(0.5)
        # One after the other: two readers of the box would take each other's time.
        direct, through = watched(folder, "camera.sock"), watched(folder, "python.sock")
        result = cellpos.track("0um", "6s", rig="python.toml", cwd=folder).wait()
    finally:
        server.send_signal(2)
        said, _ = server.communicate(timeout=10)
        print(said)
    inside = cellpos.track("0um", "3s", controller="pi", clock="real", rig="inside.toml", cwd=folder).wait()
    nm = shown("over Python", result)
    shown("in one process", inside)
    return direct, through, result, nm, said


def shown(name, result):
    """Jitter, age and losses of a run's frames, and the error where the machine kept its times, nm."""
    ticks = result.run.ticks
    time_s, period_s = ticks["time_s"], 1e-3
    frames = np.flatnonzero(np.diff(ticks["frame_id"], prepend=-1) != 0)
    interval_ms, age_ms = 1e3 * np.diff(ticks["mid_exposure_s"][frames]), 1e3 * (time_s - ticks["mid_exposure_s"])[frames]
    # A tick each period, or the next, on a frame that came in time; 0.1 s after anything else the PI loop has forgotten it.
    good = (np.diff(time_s, prepend=0) < 2.5 * period_s) & (time_s - ticks["mid_exposure_s"] < 5e-3)
    kept = kept_for(good, 100) & result.run.settled()
    nm = 1e3 * np.sqrt(np.nanmean(result.run.error_um[kept] ** 2)) if kept.any() else np.nan

    def quantiles(values):
        return "p50 {:.3f} p99 {:.3f} max {:.2f} ms".format(*np.nanpercentile(values, [50, 99, 100]))

    print(
        f"{name:15} interval {quantiles(interval_ms)}, age {quantiles(age_ms)}, {result['frames_lost']} of {result['ticks']} frames lost,"
        f" {nm:.0f} nm RMS in {np.count_nonzero(kept)} ticks"
    )
    return nm


def assert_held(result, nm):
    """The loop was closed over these frames: a bead that nobody holds is 2 um away after six seconds, PI in one process holds 0.058 um.
    Frames over Python are as much older as the machine lets them be."""
    assert result.ended == "done", result.values_["ended"]
    assert nm < 500


def test_a_bead_is_held_over_a_rendered_stream(box):
    _, through, result, nm, said = held_over(box, "rendered_stream.py", "camera.sock", "python.sock")
    assert_held(result, nm)
    assert through["interval_ms"]["p50"] == pytest.approx(1.0, abs=0.3)
    assert "jitter" in said and "dropped" in said


# Milliseconds of two seconds in which the emulated camera alone has a frame: its own thread makes them, as fast as the machine lets it.
BARE = """
import time
from pypylon import pylon
camera = pylon.InstantCamera(pylon.TlFactory.GetInstance().CreateFirstDevice())
camera.Open()
camera.Width.Value, camera.Height.Value, camera.PixelFormat.Value = 256, 32, "Mono8"
camera.ExposureTimeAbs.Value, camera.AcquisitionFrameRateEnable.Value, camera.AcquisitionFrameRateAbs.Value = 500, True, 5000
camera.StartGrabbing(pylon.GrabStrategy_LatestImageOnly)
begun, seen = time.monotonic(), set()
while time.monotonic() < begun + 2:
    camera.RetrieveResult(2000, pylon.TimeoutHandling_ThrowException).Release()
    seen.add(int(1e3 * time.monotonic()))
print(len(seen) / 2)
"""


def pylon_alone() -> float:
    return float(subprocess.check_output([sys.executable, "-c", BARE], env=dict(os.environ, PYLON_CAMEMU="1")))


def test_a_bead_is_held_over_the_basler_emulator(box):
    pytest.importorskip("pypylon")
    before = pylon_alone()
    _, _, result, nm, said = held_over(box, "pylon_camera.py", "python.sock", "--bead", "camera.sock")
    alone = min(before, pylon_alone())
    served = float(re.search(r" at ([\d.]+) Hz", said)[1])
    print(f"{served:.0f} frames/s were served; the emulated camera alone has one in {alone:.0f} of 1000 milliseconds")
    assert_held(result, nm)
    assert served > 0.8 * alone
    assert "jitter" in said and "dropped" in said


def test_a_folder_of_pictures_is_served(tmp_path):
    imageio = pytest.importorskip("imageio.v3")
    (tmp_path / "pictures").mkdir()
    for i in range(40):
        imageio.imwrite(tmp_path / f"pictures/{i:03}.png", np.full((8, 9, 3), i, np.uint8))
    env = dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path))
    words = [sys.executable, ROOT / "examples/python/folder_camera.py", "pictures", "c.sock", "--rate", "40"]
    server = subprocess.Popen(words, cwd=tmp_path, env=env, stdout=subprocess.PIPE, text=True)
    while not (tmp_path / "c.sock").exists():
        assert server.poll() is None
        time.sleep(0.01)
    got = list(cellpos.read_camera(tmp_path / "c.sock"))
    assert got and all(np.all(frame.pixels == frame.frame_id) for frame in got)
    assert "40 frames" in server.communicate(timeout=10)[0]
