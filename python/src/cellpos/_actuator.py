"""A function as an actuator: the board's side of docs/board.md, with range, slew, watchdogs and sessions."""

from __future__ import annotations

import select
import socket
import threading
import time
from pathlib import Path
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Tuple

import numpy as np

from ._camera import _quantiles, _real_time, listen
from ._run import PathLike
from ._wire import PROTOCOL, TO_BOARD, TO_HOST, Decoder, encode

_STATUS_EVERY_US = 10_000
_LATE_US = 2_000
_LONGEST_WATCHDOG_MS = 10_000
_PM = 1e6
_KEPT = 100_000
#: Least share of a period between two calls. A host of the same period jitters by less than the rest, and a command that had to wait, as
#: after a late one, lets the next ones wait less: with a whole period between two calls all later commands would wait as long.
_NEARLY = 0.9


class ActuatorStats(NamedTuple):
    """What an actuator did."""

    #: Times that the function was called.
    sets: int
    #: From one due time to its call: median, 99 % and largest, us.
    late_us: Dict[str, float]
    #: What the function took: median, 99 % and largest, us.
    set_us: Dict[str, float]
    #: Periods that were left out because the function, or the machine, took longer than one.
    skipped: int
    #: Frames that could not be read, commands that were ignored (old, doubled, of another session), commands out of range.
    bad_frames: int
    ignored: int
    clipped: int
    #: Times that commands stopped and the zero-flow displacement was held.
    holds: int
    #: Sessions so far.
    sessions: int
    #: Whether the operating system gave the serving thread real-time priority.
    real_time: bool

    def __str__(self) -> str:
        late, took = self.late_us, self.set_us
        degraded = "" if self.real_time else "; DEGRADED: no real-time priority"
        return (
            f"{self.sets} calls, late by {late['p50']:.0f} us (99 % {late['p99']:.0f}, largest {late['max']:.0f}), each took"
            f" {took['p50']:.0f} us (99 % {took['p99']:.0f}, largest {took['max']:.0f}); {self.skipped} periods skipped,"
            f" {self.ignored} commands ignored, {self.clipped} clipped, {self.holds} holds in {self.sessions} sessions{degraded}"
        )


class _Session:
    def __init__(self, number: int, limits: Tuple[int, int, int], park: int, watchdog_us: int, hold_us: int, status_every: int):
        self.number, self.limits, self.park = number, limits, park
        self.watchdog_us, self.hold_us, self.status_every = watchdog_us, hold_us, status_every
        self.since_status = self.holds = self.last_time_us = self.last_command_us = 0
        self.last_seq: Optional[int] = None
        self.neutral: Optional[int] = None
        self.fastest: Optional[Tuple[int, int]] = None

    def within(self, pm: int) -> int:
        return min(max(pm, self.limits[0]), self.limits[1])

    def fresh(self, command: Dict[str, Any]) -> bool:
        if command["session"] != self.number:
            return False
        return self.last_seq is None or 0 < (command["seq"] - self.last_seq) % 2**32 < 2**31

    def late(self, command: Dict[str, Any], now_us: int) -> bool:
        """Whether it took longer on its way than the fastest one; two crystals differ by at most 200 ppm."""
        transit_ns = 1000 * (now_us - int(command["time_us"]))
        floor_ns = transit_ns
        if self.fastest is not None:
            floor_ns = self.fastest[0] + (now_us - self.fastest[1]) // 5
        self.fastest = (min(transit_ns, floor_ns), now_us)
        return transit_ns > floor_ns + 1000 * _LATE_US


class Board:
    """The state machine of docs/board.md, without a line: messages and times in, messages and displacements out."""

    def __init__(self, low: float, high: float, slew: float, period: float, park: float) -> None:
        self.low, self.high, self.own_park = round(low * _PM), round(high * _PM), round(park * _PM)
        self.slew, self.step_us = round(slew * 1e3), round(period * 1e6)
        # Five periods: a host that misses a frame or two is not silent yet.
        self.watchdog_ms = min(max(20, round(5e3 * period)), _LONGEST_WATCHDOG_MS)
        self.hold_watchdog_ms = 2000
        self.state, self.fault = "Disarmed", "None"
        self.greeted = self.led = self.commanded = self.owed = False
        self.ignored = self.late = self.clipped = self.bad_frames = self.sessions = 0
        self.applied = self.target = self.own_park
        self.held_since_us = self.next_status_us = self.stepped_us = self.now_us = 0
        limits = (self.low, self.high, self.slew)
        self.session = _Session(0, limits, self.own_park, 1000 * self.watchdog_ms, 1000 * self.hold_watchdog_ms, 1)
        self.out: List[Tuple[str, Dict[str, Any]]] = []

    # -- time

    def step(self, now_us: int) -> int:
        """The next displacement, pm: towards the wanted one, by at most the slew of one period."""
        self.watch(now_us)
        self.commanded = False
        elapsed_us = min(now_us - self.stepped_us, self.step_us)
        self.stepped_us = now_us
        slew = self.session.limits[2]
        within = self.session.within(self.target) if self.state in ("Running", "Frozen", "Holding") else self.target
        reach = slew * elapsed_us // 1000
        self.applied += max(-reach, min(reach, within - self.applied))
        if self.owed or (self.greeted and now_us >= self.next_status_us):
            self.send_status()
        return self.applied

    def watch(self, now_us: int) -> None:
        """Acts on watchdog times that have run out."""
        self.now_us = max(self.now_us, now_us)
        while True:
            session = self.session
            if self.state == "Running":
                end_us = session.last_command_us + session.watchdog_us
            elif self.state in ("Frozen", "Armed", "Holding"):
                end_us = self.held_since_us + session.hold_us
            else:
                return
            if self.now_us < end_us:
                return
            if self.state == "Running":
                session.holds += 1
                self.raise_fault("CommandTimeout")
                self.hold("Holding", end_us)
            else:
                if self.state != "Holding":
                    self.raise_fault("FreezeTimeout" if self.state == "Frozen" else "ArmTimeout")
                self.go_to_park("Safe")

    # -- what is said

    def raise_fault(self, fault: str) -> None:
        self.fault = fault
        self.out.append(("Fault", {"fault": fault, "board_time_us": self.now_us}))

    def status(self) -> Dict[str, Any]:
        session = self.session
        return {
            "session": session.number,
            "last_seq": session.last_seq,
            "last_time_us": session.last_time_us,
            "state": self.state,
            "applied_pm": self.applied,
            "neutral_pm": self.applied if session.neutral is None else session.neutral,
            "board_time_us": self.now_us,
            "fault": self.fault,
            "led": self.led,
            "bad_frames": self.bad_frames,
            "ignored": self.ignored,
            "late": self.late,
            "clipped": self.clipped,
            "unsent": 0,
            "holds": min(session.holds, 0xFFFF),
        }

    def send_status(self) -> None:
        self.next_status_us = self.now_us + _STATUS_EVERY_US
        self.session.since_status, self.owed = 0, False
        self.out.append(("Status", self.status()))

    # -- what is done

    def hold(self, state: str, since_us: int) -> None:
        self.target = self.applied if self.session.neutral is None else self.session.neutral
        self.state, self.held_since_us = state, since_us
        self.send_status()

    def go_to_park(self, state: str) -> None:
        self.target, self.state = self.session.park, state
        self.send_status()

    def obey(self, message: Tuple[str, Dict[str, Any]], now_us: int) -> None:
        self.watch(now_us)
        name, fields = message
        if name == "Hello":
            self.greeted = fields["protocol"] == PROTOCOL
            self.out.append(("Identity", self.identity()))
            if not self.greeted:
                self.out.append(("Refused", {"request": "Hello", "refusal": "Protocol"}))
        elif name == "Arm":
            self.answer("Arm", self.arm(fields))
        elif name == "Command":
            self.command(fields)
        elif name == "Freeze":
            refusal = None
            if self.state in ("Armed", "Running", "Holding"):
                self.hold("Frozen", self.now_us)
            elif self.state == "Frozen":
                self.held_since_us = self.now_us
            else:
                refusal = "State"
            self.answer("Freeze", refusal)
        elif name in ("Park", "Disarm"):
            self.answer(name, None)
            self.go_to_park("Safe" if name == "Park" else "Disarmed")
        elif name == "Led":
            self.led = fields["on"]
            self.answer("Led", None)
        elif name == "StatusRequest":
            self.send_status()
        else:
            self.out.append(("Pong", {"token": fields["token"], "board_time_us": self.now_us}))

    def answer(self, request: str, refusal: Optional[str]) -> None:
        kind, more = ("Ack", {}) if refusal is None else ("Refused", {"refusal": refusal})
        self.out.append((kind, {"request": request, **more}))

    def identity(self) -> Dict[str, Any]:
        return {
            "protocol": PROTOCOL,
            "firmware": [0, 1, 0],
            "serial": 0,
            "limits": {"low_pm": self.low, "high_pm": self.high, "slew_nm_per_s": self.slew},
            "ramp_nm_per_s": self.slew,
            "park_pm": self.own_park,
            "dac_bits": 16,
            "watchdog_ms": self.watchdog_ms,
            "hold_watchdog_ms": self.hold_watchdog_ms,
        }

    def arm(self, asked: Dict[str, Any]) -> Optional[str]:
        if not self.greeted:
            return "Protocol"
        if self.state == "Running" and asked["session"] != self.session.number:
            return "Busy"
        own = (self.low, self.high, self.slew)
        limits = own
        if asked["limits"] is not None:
            limits = (asked["limits"]["low_pm"], asked["limits"]["high_pm"], asked["limits"]["slew_nm_per_s"])
        if limits[0] >= limits[1] or limits[0] < self.low or limits[1] > self.high or not 0 < limits[2] <= self.slew:
            return "Limits"
        park = self.own_park if asked["park_pm"] is None else asked["park_pm"]
        if not self.low <= park <= self.high:
            return "Park"
        times = [
            own_ms if asked[key] is None else asked[key]
            for key, own_ms in (("watchdog_ms", self.watchdog_ms), ("hold_watchdog_ms", self.hold_watchdog_ms))
        ]
        if not all(1 <= ms <= _LONGEST_WATCHDOG_MS for ms in times):
            return "Watchdog"
        self.session = _Session(asked["session"], limits, park, 1000 * times[0], 1000 * times[1], asked["status_every"])
        self.session.last_command_us = self.now_us
        self.sessions += 1
        self.fault, self.state, self.held_since_us = "None", "Armed", self.now_us
        self.target = self.applied
        self.send_status()
        return None

    def command(self, command: Dict[str, Any]) -> None:
        session = self.session
        if self.state not in ("Armed", "Running", "Holding") or not session.fresh(command):
            self.ignored += 1
            return
        self.late += session.late(command, self.now_us)
        self.target = session.within(command["displacement_pm"])
        # By more than half a step of the converter that the identity names.
        self.clipped += abs(command["displacement_pm"] - self.target) > (self.high - self.low) // 131070
        session.last_seq, session.last_time_us = command["seq"], command["time_us"]
        session.last_command_us = self.now_us
        session.neutral = session.within(command["neutral_pm"])
        self.fault, self.state, self.commanded = "None", "Running", True
        session.since_status += 1
        # It is told of when it has been obeyed: a host that hears nothing more takes the last output that it heard of for the one in force.
        self.owed = self.owed or 0 < session.status_every <= session.since_status


class ActuatorServer:
    """Serves a function as an actuator, for `[actuator] kind = "program"`. Use serve_actuator, or this one with `with`."""

    def __init__(
        self,
        set: Callable[[float], Any],  # noqa: A002
        low: float,
        high: float,
        slew: float,
        period: float,
        socket_path: PathLike = "actuator.sock",
        *,
        park: Optional[float] = None,
        real_time: bool = True,
    ) -> None:
        park = low if park is None else park
        for name, value, sound, must in (
            ("high", high, -2000 <= low < high <= 2000, "above low, both within -2000 to 2000 um"),
            ("slew", slew, 0 < slew <= 4e6, "above 0 and at most 4000000 um/s"),
            ("period", period, 1e-3 <= period <= 1.0, "the seconds between two commands, 0.001 to 1"),
            ("park", park, low <= park <= high, "within low and high"),
        ):
            if not sound:
                raise ValueError(f"{name} = {value}: must be {must}")
        self.board = Board(low, high, slew, period, park)
        self._set, self._period_s, self._path = set, period, Path(socket_path)
        self._ask_for_real_time, self._real_time = real_time, False
        self._stop = threading.Event()
        self._thread: Optional[threading.Thread] = None
        self._failure: Optional[BaseException] = None
        self._client: Optional[socket.socket] = None
        self._decoder = Decoder(TO_BOARD)
        self._given: Optional[int] = None
        self._sets = self._skipped = 0
        self._called_s = 0.0
        self._ending = False
        self._late_us, self._set_us = np.zeros(_KEPT), np.zeros(_KEPT)
        self._start_ns = time.monotonic_ns()
        self._listener = listen(self._path)

    def _now_us(self) -> int:
        return (time.monotonic_ns() - self._start_ns) // 1000

    def serve(self) -> ActuatorStats:
        """Serves until `stop`, Ctrl-C or an error of the function; then ramps to park."""
        self._real_time = self._ask_for_real_time and _real_time()
        due_s = time.monotonic()
        try:
            self._call(self.board.applied, 0.0)
            while not self._stop.is_set():
                due_s = self._turn(due_s)
        finally:
            self._park(due_s)
            self._forget()
            self._listener.close()
            self._path.unlink(missing_ok=True)
        return self.stats

    def _park(self, due_s: float) -> None:
        """Ramps to park and stays there; an error of the function that ended serving may be the device's own, so each step is tried."""
        self._ending = True
        self.board.go_to_park("Safe")
        while self.board.applied != self.board.session.park:
            try:
                due_s = self._turn(due_s)
            except KeyboardInterrupt:
                continue
            except Exception:
                time.sleep(self._period_s)

    def _turn(self, due_s: float) -> float:
        """Listens until a command comes or the next period begins, then moves: at most one call a period."""
        due_s += self._period_s
        behind = int((time.monotonic() - due_s) / self._period_s)
        if behind > 0:
            self._skipped += behind
            due_s += behind * self._period_s
        # A call that came late in its period puts off the next one.
        due_s = max(due_s, self._called_s + _NEARLY * self._period_s)
        while True:
            now_s = time.monotonic()
            if self.board.commanded:
                due_s = min(due_s, max(now_s, self._called_s + _NEARLY * self._period_s))
            left_s = due_s - now_s
            if left_s <= 0:
                break
            wanted = [self._listener] + ([self._client] if self._client is not None else [])
            ready, _, _ = select.select(wanted, [], [], left_s)
            self._listen(ready)
        late_us = (time.monotonic() - due_s) * 1e6
        self._listen(select.select([self._client], [], [], 0)[0] if self._client is not None else [])
        self._call(self.board.step(self._now_us()), late_us)
        self._send()
        return due_s

    def _listen(self, ready: List[Any]) -> None:
        if self._listener in ready:
            # The newest host is heard; a session of another one ends by its own watchdog.
            self._forget()
            self._client, _ = self._listener.accept()
            self._client.setblocking(False)
            self._decoder = Decoder(TO_BOARD)
        if self._client is not None and self._client in ready:
            try:
                data = self._client.recv(4096)
            except OSError:
                data = b""
            if not data:
                self._forget()
                return
            for message in self._decoder.messages(data):
                if self._ending:
                    # Nobody arms it any more.
                    continue
                self.board.bad_frames = self._decoder.bad_frames
                self.board.obey(message, self._now_us())
            self._send()

    def _send(self) -> None:
        out, self.board.out = self.board.out, []
        for message in out:
            if self._client is None:
                return
            try:
                # A host that does not read never stops the actuator: what finds no room is left out whole.
                self._client.send(encode(TO_HOST, message))
            except BlockingIOError:
                return
            except OSError:
                self._forget()

    def _call(self, pm: int, late_us: float) -> None:
        if pm == self._given:
            return
        begun = self._called_s = time.monotonic()
        self._set(pm / _PM)
        self._given = pm
        self._late_us[self._sets % _KEPT] = late_us
        self._set_us[self._sets % _KEPT] = (time.monotonic() - begun) * 1e6
        self._sets += 1

    def _forget(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    @property
    def stats(self) -> ActuatorStats:
        """Figures so far."""
        board, kept = self.board, min(self._sets, _KEPT)
        return ActuatorStats(
            self._sets, _quantiles(self._late_us[:kept]), _quantiles(self._set_us[:kept]), self._skipped,
            board.bad_frames, board.ignored, board.clipped, board.session.holds, board.sessions, self._real_time,
        )  # fmt: skip

    def stop(self) -> None:
        """Ramps to park and ends."""
        self._stop.set()

    def __enter__(self) -> "ActuatorServer":
        self._thread = threading.Thread(target=self._served, name="cellpos-actuator", daemon=True)
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
            self._thread.join(30.0)
        if self._failure is not None and kind is None:
            raise self._failure


def serve_actuator(
    set: Callable[[float], Any],  # noqa: A002
    low: float,
    high: float,
    slew: float,
    period: float,
    socket_path: PathLike = "actuator.sock",
    *,
    park: Optional[float] = None,
    real_time: bool = True,
) -> ActuatorStats:
    """Serves a function as an actuator until Ctrl-C, ramps to park, and gives figures.

    `set(um)` is called at most once a `period` (s) with a displacement from `low` to `high` (um) that moves by at most `slew` (um/s);
    it may take a part of the period. If the device has another unit, such as pressure or flow, `set` converts.
    `park` (`low` unless said) is where it goes at the start, at the end, and when the program falls silent.
    """
    server = ActuatorServer(set, low, high, slew, period, socket_path, park=park, real_time=real_time)
    try:
        return server.serve()
    except KeyboardInterrupt:
        return server.stats
