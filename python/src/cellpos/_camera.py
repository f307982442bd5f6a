"""Frames from Python to the program: the server's and the client's side of docs/camera-socket.md."""

from __future__ import annotations

import os
import select
import socket
import struct
import threading
import time
import zlib
from pathlib import Path
from typing import Any, Dict, Iterable, Iterator, List, NamedTuple, Optional, Tuple, Union

import numpy as np

from ._run import PathLike

Array = Any
_HEADER = struct.Struct("<4sHHQQQIHHHHI12xI")
_MAGIC, _VERSION = b"CPFR", 1
#: Frames that may wait in the socket: one that is read while the next is written, and one for a stall.
_FRAMES_WAITING = 3
#: The program's control thread has 80.
_PRIORITY = 40
#: Intervals and ages that are kept for the figures: the newest.
_KEPT = 100_000


class Frame(NamedTuple):
    """A frame with its number and times."""

    pixels: Array
    mid_exposure_ns: int
    frame_id: int


#: What serve_camera takes: an array, (array, mid_exposure_ns), or (array, mid_exposure_ns, frame_id).
FrameLike = Union[Array, Tuple[Array, int], Tuple[Array, int, int], Frame]


def pack_header(
    frame_id: int, mid_exposure_ns: int, sent_ns: int, exposure_ns: int, width: int, height: int, bits: int, length: int
) -> bytes:
    """The header of a frame."""
    head = _HEADER.pack(
        _MAGIC, _VERSION, _HEADER.size, frame_id, mid_exposure_ns, sent_ns, exposure_ns, width, height, bits, 0, length, 0
    )
    return head[:60] + struct.pack("<I", zlib.crc32(head[:60]))


class CameraStats(NamedTuple):
    """What a server did. Times in us."""

    #: Frames taken from the source.
    frames: int
    #: Frames handed over whole.
    sent: int
    #: Frames left out because the program had not read those before.
    dropped: int
    #: Frames that came while nobody was connected.
    unseen: int
    #: Connections so far.
    clients: int
    #: Frames per second, over all frames.
    rate_hz: float
    #: Interval between frames less 1/rate: standard deviation, and 99 % and largest of its size.
    jitter_us: Dict[str, float]
    #: From the middle of the exposure to the hand-over: median, 99 % and largest.
    age_us: Dict[str, float]
    #: Whether the operating system gave the serving thread real-time priority.
    real_time: bool

    def __str__(self) -> str:
        jitter, age = self.jitter_us, self.age_us
        degraded = "" if self.real_time else "; DEGRADED: no real-time priority"
        return (
            f"{self.frames} frames at {self.rate_hz:.1f} Hz, {self.sent} sent, {self.dropped} dropped, {self.unseen} with nobody"
            f" connected; jitter {jitter['sd']:.0f} us RMS (99 % {jitter['p99']:.0f}, largest {jitter['max']:.0f});"
            f" age at hand-over {age['p50']:.0f} us (99 % {age['p99']:.0f}, largest {age['max']:.0f}){degraded}"
        )


def listen(path: Path) -> socket.socket:
    """A Unix socket that listens; one that a server left behind is taken, one that is served is not."""
    try:
        with socket.socket(socket.AF_UNIX) as other:
            other.connect(str(path))
        raise OSError(f"{path} is served by another program")
    except (FileNotFoundError, ConnectionRefusedError):
        path.unlink(missing_ok=True)
    listener = socket.socket(socket.AF_UNIX)
    # It gets its name when it listens: who finds the name may connect.
    made = path.with_name(f".{os.getpid():x}.{threading.get_ident() & 0xFFFF:x}")
    try:
        listener.bind(str(made))
        listener.listen(1)
        made.rename(path)
    except OSError as error:
        listener.close()
        made.unlink(missing_ok=True)
        raise OSError(f"{path}: {error}; a socket's path has at most 100 bytes") from None
    listener.setblocking(False)
    return listener


class CameraServer:
    """Serves frames on a Unix socket for `[camera] kind = "socket"`. Use serve_camera, or this one with `with` to serve from a
    thread while the same process does something else."""

    def __init__(
        self,
        frames: Iterable[FrameLike],
        rate: float,
        socket_path: PathLike = "camera.sock",
        *,
        exposure_s: float = 0.0,
        bits: Optional[int] = None,
        pace: bool = False,
        real_time: bool = True,
    ) -> None:
        if not (np.isfinite(rate) and rate > 0):
            raise ValueError(f"rate = {rate}: must be the frames per second, above 0")
        if exposure_s < 0 or exposure_s > 4.0:
            raise ValueError(f"exposure_s = {exposure_s}: must be the exposure in seconds, 0 to 4")
        self._frames, self._rate, self._path = frames, float(rate), Path(socket_path)
        self._exposure_ns, self._bits, self._pace = int(exposure_s * 1e9), bits, pace
        self._ask_for_real_time, self._real_time = real_time, False
        self._stop = threading.Event()
        self._thread: Optional[threading.Thread] = None
        self._failure: Optional[BaseException] = None
        self._client: Optional[socket.socket] = None
        self._left = memoryview(b"")
        self._counts = {"frames": 0, "sent": 0, "dropped": 0, "unseen": 0, "clients": 0}
        self._times = np.zeros(_KEPT)
        self._ages = np.zeros(_KEPT)
        self._aged = 0
        self._first_s = self._last_s = 0.0
        self._listener = listen(self._path)

    # -- the loop

    def serve(self) -> CameraStats:
        """Serves until the source ends or `stop` is called."""
        number, due_s = 0, time.monotonic()
        self._real_time = self._ask_for_real_time and _real_time()
        try:
            for item in self._frames:
                if self._stop.is_set():
                    break
                if self._pace:
                    due_s = self._wait_until(due_s + 1.0 / self._rate)
                pixels, stamp_ns, frame_id = self._taken(item, number)
                number = frame_id + 1
                self._note()
                self._accept()
                self._hand_over(pixels, stamp_ns, frame_id)
        finally:
            self.close()
        return self.stats

    def _wait_until(self, due_s: float) -> float:
        now_s = time.monotonic()
        if due_s < now_s - 0.1:
            # A stall is not made up for in a burst.
            return now_s
        if due_s > now_s:
            time.sleep(due_s - now_s)
        return due_s

    def _taken(self, item: FrameLike, number: int) -> Tuple[Array, int, int]:
        if isinstance(item, tuple):
            pixels, stamp_ns = item[0], int(item[1])
            frame_id = int(item[2]) if len(item) > 2 else number
        else:
            # Without a stamp of the camera's: now, less half the exposure. The transfer time is not included.
            pixels, stamp_ns, frame_id = item, time.monotonic_ns() - self._exposure_ns // 2, number
        pixels = np.ascontiguousarray(pixels)
        if pixels.ndim != 2 or pixels.dtype not in (np.uint8, np.uint16):
            raise TypeError(
                f"a frame is an array of rows and columns of uint8 or uint16, this one is {pixels.dtype} of shape {pixels.shape}"
            )
        return pixels, stamp_ns, frame_id

    def _note(self) -> None:
        now_s = time.monotonic()
        count = self._counts["frames"]
        if count == 0:
            self._first_s = now_s
        else:
            self._times[(count - 1) % _KEPT] = now_s - self._last_s
        self._last_s = now_s
        self._counts["frames"] = count + 1

    def _accept(self) -> None:
        try:
            client, _ = self._listener.accept()
        except BlockingIOError:
            return
        # The newest client is served: a program that was killed may not have been noticed yet.
        self._forget()
        client.setblocking(False)
        self._client = client
        self._counts["clients"] += 1

    def _forget(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client, self._left = None, memoryview(b"")

    def _hand_over(self, pixels: Array, stamp_ns: int, frame_id: int) -> None:
        if self._client is None:
            self._counts["unseen"] += 1
            return
        until_s = time.monotonic() + 1.0 / self._rate
        if not self._flush(until_s):
            self._counts["dropped"] += 1
            return
        bits = self._bits or 8 * pixels.dtype.itemsize
        height, width = pixels.shape
        sent_ns = time.monotonic_ns()
        header = pack_header(frame_id, stamp_ns, sent_ns, self._exposure_ns, width, height, bits, pixels.nbytes)
        if self._counts["sent"] == 0 or self._counts["clients"] == 1:
            self._client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _FRAMES_WAITING * (pixels.nbytes + len(header)))
        self._left = memoryview(header + pixels.tobytes())
        self._counts["sent"] += 1
        self._ages[self._aged % _KEPT] = (sent_ns - stamp_ns) / 1e3
        self._aged += 1
        self._flush(until_s)

    def _flush(self, until_s: float) -> bool:
        """Writes the rest of a frame, for at most a period; a frame that was begun is always completed."""
        while len(self._left) and self._client is not None:
            try:
                self._left = self._left[self._client.send(self._left) :]
            except BlockingIOError:
                left_s = until_s - time.monotonic()
                if left_s <= 0:
                    return False
                select.select([], [self._client], [], left_s)
            except OSError:
                self._forget()
        return self._client is not None

    # -- beside it

    @property
    def stats(self) -> CameraStats:
        """Figures so far."""
        count = self._counts["frames"]
        intervals = self._times[: min(max(count - 1, 0), _KEPT)]
        off_us = (intervals - 1.0 / self._rate) * 1e6
        ages = self._ages[: min(self._aged, _KEPT)]
        over_s = self._last_s - self._first_s
        return CameraStats(
            rate_hz=(count - 1) / over_s if over_s > 0 else float("nan"),
            jitter_us=_quantiles(np.abs(off_us), sd=float(np.sqrt(np.mean(off_us**2))) if len(off_us) else float("nan")),
            age_us=_quantiles(ages),
            real_time=self._real_time,
            **self._counts,
        )

    def stop(self) -> None:
        """Ends serving after the present frame."""
        self._stop.set()

    def close(self) -> None:
        """Closes the socket and removes it."""
        self._forget()
        self._listener.close()
        try:
            os.unlink(self._path)
        except OSError:
            pass

    def __enter__(self) -> "CameraServer":
        self._thread = threading.Thread(target=self._served, name="cellpos-camera", daemon=True)
        self._thread.start()
        return self

    def _served(self) -> None:
        try:
            self.serve()
        except BaseException as failure:
            self._failure = failure

    def __exit__(self, kind: object, *error: object) -> None:
        self.stop()
        if self._thread is not None:
            self._thread.join(5.0)
        if self._failure is not None and kind is None:
            raise self._failure


def _real_time() -> bool:
    """Asks for real-time priority for this thread, below that of the program's own threads."""
    try:
        # Not for the threads that the camera's library starts from here: one that spins would take a CPU from the loop.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(_PRIORITY))
    except (AttributeError, OSError):
        return False
    return True


def _quantiles(values: Array, **more: float) -> Dict[str, float]:
    if not len(values):
        return {"p50": float("nan"), "p99": float("nan"), "max": float("nan"), **more}
    p50, p99 = np.percentile(values, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "max": float(np.max(values)), **more}


def serve_camera(
    frames: Iterable[FrameLike],
    rate: float,
    socket_path: PathLike = "camera.sock",
    *,
    exposure_s: float = 0.0,
    bits: Optional[int] = None,
    pace: bool = False,
    real_time: bool = True,
) -> CameraStats:
    """Serves an iterable of frames until it ends or Ctrl-C, and gives figures: losses, jitter, age.

    A frame is an array of uint8 or uint16 (rows, columns), or a tuple of it with `mid_exposure_ns` (the middle of the exposure, on
    time.monotonic_ns()'s clock) and, where the camera counts them, `frame_id`. `pace` takes frames at the rate, for sources that
    have none (a folder, a list). `bits`: how many of a uint16's are used (12 for Mono12). `real_time` asks for real-time priority for
    the calling thread; the figures say whether it was granted.
    """
    server = CameraServer(frames, rate, socket_path, exposure_s=exposure_s, bits=bits, pace=pace, real_time=real_time)
    try:
        return server.serve()
    except KeyboardInterrupt:
        return server.stats


def read_camera(socket_path: PathLike, timeout: float = 2.0) -> Iterator[Frame]:
    """The frames that a server on a socket delivers (firmware-sim's, or serve_camera's), until it goes away."""
    with socket.socket(socket.AF_UNIX) as stream:
        stream.settimeout(timeout)
        stream.connect(str(socket_path))
        while True:
            head = _exactly(stream, _HEADER.size)
            if head is None:
                return
            magic, version, length, frame_id, mid_ns, _, _, width, height, bits, _, size, check = _HEADER.unpack(head)
            if magic != _MAGIC or version != _VERSION or length != _HEADER.size or zlib.crc32(head[:60]) != check:
                raise ValueError(f"{socket_path}: not a camera's stream of version {_VERSION}")
            body = _exactly(stream, size)
            if body is None:
                return
            kind = np.uint8 if bits <= 8 else np.dtype("<u2")
            yield Frame(np.frombuffer(body, kind).reshape(height, width), mid_ns, frame_id)


def _exactly(stream: socket.socket, size: int) -> Optional[bytes]:
    parts: List[bytes] = []
    left = size
    while left:
        part = stream.recv(left)
        if not part:
            return None
        parts.append(part)
        left -= len(part)
    return b"".join(parts)
