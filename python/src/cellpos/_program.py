"""Starts the program, passes on rows as they are recorded, and returns its final output."""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, Mapping, Optional, Sequence, Union

import numpy as np

from ._run import PathLike, Run, Session

Option = Union[None, bool, str, float, int, Path, Sequence[Any]]
_LOOK_EVERY_S = 0.05
#: What notices one Ctrl-C does so within this time, s; a person needs longer for the next.
_ONE_CTRL_C_S = 0.1
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None) if sys.platform.startswith("linux") else None


class Failed(RuntimeError):
    """The program refused or failed the request. `error` is its JSON object, `code` its exit code."""

    def __init__(self, message: str, code: int, error: Dict[str, Any]) -> None:
        super().__init__(message)
        self.code, self.error = code, error


def program() -> str:
    """The program that is started: CELLPOS_PROGRAM, or the one of this package, or the one on the path."""
    named = os.environ.get("CELLPOS_PROGRAM")
    if named:
        return named
    own = Path(sysconfig.get_path("scripts")) / "cellpos"
    found = str(own) if own.is_file() else shutil.which("cellpos")
    if not found:
        raise FileNotFoundError(
            "the program cellpos is neither in this environment nor on the path: pip install ./python, or set CELLPOS_PROGRAM"
        )
    return found


class Result(Mapping[str, Any]):
    """What the program printed at its end, as a mapping, with its run and its exit code."""

    def __init__(self, values: Dict[str, Any], code: int, folder: Optional[Path]) -> None:
        self.values_, self.code, self._folder = values, code, folder

    def __getitem__(self, key: str) -> Any:
        return self.values_[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self.values_)

    def __len__(self) -> int:
        return len(self.values_)

    def __repr__(self) -> str:
        return f"<Result {self.values_.get('schema')}: {self.ended or 'exit code %d' % self.code}>"

    @property
    def ended(self) -> str:
        """Kind of the end of a run: done, reference-over, operator, arming-refused, safe, unrecorded, failed."""
        ended = self.values_.get("ended")
        return str(ended.get("kind")) if isinstance(ended, dict) else ""

    @property
    def run(self) -> Run:
        """The run that was recorded."""
        if self._folder is None:
            raise LookupError("nothing was recorded")
        return Run(self._folder)


class Row(Mapping[str, Any]):
    """One tick: row["bead_um"] or row.bead_um."""

    __slots__ = ("_columns", "_index")

    def __init__(self, columns: Dict[str, Any], index: int) -> None:
        self._columns, self._index = columns, index

    def __getitem__(self, name: str) -> Any:
        value = self._columns[name][self._index]
        return value.item() if isinstance(value, np.generic) else value

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(name) from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)

    def __repr__(self) -> str:
        return "<Row at %.3f s: bead %.3f um>" % (self["time_s"], self["bead_um"])


class Live:
    """A command that runs. Iterating gives the ticks as they are recorded (each half second); a command that records no
    ticks gives none. Ctrl-C, leaving a `with` block early, and the end of this process freeze the bead and park the PZT."""

    def __init__(self, words: Sequence[str], cwd: Optional[PathLike], echo: bool) -> None:
        self._cwd = Path(cwd) if cwd is not None else Path.cwd()
        self._out = tempfile.TemporaryFile("w+b")
        self._errors = tempfile.TemporaryFile("w+b")
        self._started = threading.Event()
        self._failure: Optional[BaseException] = None
        self._process: Optional[subprocess.Popen[bytes]] = None
        self._folder: Optional[Path] = None
        self._folders: List[Path] = []
        self._result: Optional[Result] = None
        self._echo = echo
        self._asked_s = -np.inf
        # Linux signals the child when the thread that started it ends: this one lasts as long as the child, or this process.
        self._thread = threading.Thread(target=self._keep, args=(list(words),), name="cellpos", daemon=True)
        self._thread.start()
        self._started.wait()
        if self._failure is not None:
            raise self._failure

        _RUNNING.append(self)
        _watch_ctrl_c()

    def _keep(self, words: List[str]) -> None:
        try:
            self._process = subprocess.Popen(
                words,
                cwd=self._cwd,
                stdin=subprocess.DEVNULL,
                stdout=self._out,
                stderr=None if self._echo else self._errors,
                # A Ctrl-C of the terminal is for this process, which passes it on.
                start_new_session=True,
                preexec_fn=_park_with_parent,
            )
        except BaseException as failure:
            self._failure = failure
        self._started.set()
        if self._process is not None:
            self._process.wait()

    @property
    def running(self) -> bool:
        """Whether the program still runs."""
        return self._thread.is_alive()

    @property
    def pid(self) -> int:
        """Process id of the program."""
        assert self._process is not None
        return self._process.pid

    @property
    def folder(self) -> Optional[Path]:
        """The run folder; None before there is one."""
        self._look()
        return self._folder

    def _look(self) -> None:
        """Finds the run folder: the program has its ticks.arrow open."""
        here = Path("/proc") / str(self.pid) / "fd"
        try:
            opened = [os.readlink(link) for link in here.iterdir()]
        except OSError:
            return
        for name in opened:
            path = Path(name)
            if path.name == "ticks.arrow" and path.parent not in self._folders:
                self._folder = path.parent
                self._folders.append(path.parent)

    def stop(self) -> None:
        """Freezes the bead, then parks the PZT; the second time it parks at once."""
        self._signal(signal.SIGINT)

    def _interrupted(self) -> None:
        """What Ctrl-C does: stop, once for each Ctrl-C, however many places notice it."""
        now = time.monotonic()
        if now - self._asked_s > _ONE_CTRL_C_S:
            self._asked_s = now
            self.stop()

    def pause(self) -> None:
        """Freezes the bead until the next call."""
        self._signal(signal.SIGUSR1)

    def skip(self) -> None:
        """A script continues with its next step."""
        self._signal(signal.SIGUSR2)

    def _signal(self, number: int) -> None:
        if self.running and self._process is not None and self._process.returncode is None:
            self._process.send_signal(number)

    def __enter__(self) -> "Live":
        return self

    def __exit__(self, *error: object) -> None:
        if self.running:
            self._interrupted()
        self._join()

    def _join(self, timeout: Optional[float] = None) -> None:
        """Waits for the end. Ctrl-C parks, waits until that is done, and is then raised."""
        asked: Optional[KeyboardInterrupt] = None
        until = None if timeout is None else time.monotonic() + timeout
        while self._thread.is_alive():
            try:
                left = 0.2 if until is None else min(0.2, until - time.monotonic())
                if left <= 0:
                    break
                self._thread.join(left)
            except KeyboardInterrupt as interrupt:
                asked, until = interrupt, None
                self._interrupted()
        if asked is not None:
            raise asked

    def batches(self) -> Iterator[Dict[str, Any]]:
        """The ticks as they come, some at a time: arrays by the names of docs/data.md."""
        session: Optional[Session] = None
        given = 0
        try:
            while True:
                alive = self.running
                self._look()
                if session is None and self._folder is not None:
                    try:
                        session, given = Session(self._folder), 0
                    except OSError:
                        session = None
                if session is not None:
                    session.stream.more()
                    if len(session.stream.batches) > given:
                        yield {name: session.column(name, given) for name in session.names()}
                        given = len(session.stream.batches)
                        continue
                    if self._folder != session.folder:
                        # identify records one folder after the other.
                        session = None
                        continue
                if not alive:
                    return
                time.sleep(_LOOK_EVERY_S)
        except KeyboardInterrupt:
            self._interrupted()
            self._join()
            raise

    def __iter__(self) -> Iterator[Row]:
        for columns in self.batches():
            for index in range(len(columns["time_s"])):
                yield Row(columns, index)

    @property
    def result(self) -> Result:
        """Waits for the end and gives the program's result."""
        return self.wait()

    def wait(self, timeout: Optional[float] = None) -> Result:
        """Waits for the end. A run that ended in Safe is a result (`ended`, `code`); a refusal raises Failed."""
        if self._result is not None:
            return self._result
        self._join(timeout)
        if self.running:
            raise TimeoutError(f"the program still runs after {timeout} s")
        assert self._process is not None
        self._out.seek(0)
        text = self._out.read().decode("utf-8", "replace")
        self._errors.seek(0)
        said = self._errors.read().decode("utf-8", "replace").strip()
        code = int(self._process.returncode)
        try:
            values: Dict[str, Any] = json.loads(text)
        except ValueError:
            raise Failed(said or f"the program ended with code {code} and said nothing", code, {}) from None
        if values.get("schema") == "cellpos.error":
            error = values.get("error", {})
            words = [error.get("message"), *error.get("causes", []), error.get("help")]
            raise Failed("; ".join(word for word in words if word), code, error)
        named = values.get("run") or values.get("folder")
        folder = self._cwd / str(named) if isinstance(named, str) else self._folder
        self._result = Result(values, code, folder)
        return self._result


def _watch_ctrl_c() -> None:
    """Passes each Ctrl-C on to what runs, wherever this process is when it comes; then what was to happen happens."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or getattr(before, "passes_on", False) or not callable(before):
        return

    def pass_on(number: int, frame: Any) -> None:
        for live in [live for live in _RUNNING if live.running]:
            live._interrupted()
        _RUNNING[:] = [live for live in _RUNNING if live.running]
        before(number, frame)

    pass_on.passes_on = True  # type: ignore[attr-defined]
    signal.signal(signal.SIGINT, pass_on)


def _park_with_parent() -> None:
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGINT)


#: What was started and may still run.
_RUNNING: List[Live] = []


def _words(options: Mapping[str, Option]) -> List[str]:
    words: List[str] = []
    for name, value in options.items():
        flag = "--" + name.rstrip("_").replace("_", "-")
        if value is None or value is False:
            continue
        if value is True:
            words.append(flag)
        elif isinstance(value, (list, tuple)):
            words.append(flag)
            words.extend(str(each) for each in value)
        else:
            # With "=", a value that begins with a minus is no option.
            words.append(f"{flag}={value}")
    return words


def command(*words: Union[str, Path], cwd: Optional[PathLike] = None, echo: bool = False, **options: Option) -> Live:
    """Starts any command of the program that knows --json. Options are those of the command line, with _ for -."""
    start: Callable[[Sequence[str], Optional[PathLike], bool], Live] = Live
    return start([program(), *map(str, words), *_words(options), "--json"], cwd, echo)


def track(
    target: str = "0um", duration: Optional[str] = None, *, cwd: Optional[PathLike] = None, echo: bool = False, **options: Option
) -> Live:
    """Holds a bead: `track("0um", "10s", rig="rig.toml", controller="lqg")`. Options as `cellpos track --help` names them."""
    return command("track", cwd=cwd, echo=echo, target=target, duration=duration, **options)


def run(script: Union[None, str, Path] = None, *, cwd: Optional[PathLike] = None, echo: bool = False, **options: Option) -> Live:
    """Runs a setpoint script, or continues a run (`resume="latest"`)."""
    return command("run", *([] if script is None else [script]), cwd=cwd, echo=echo, **options)


def identify(*, cwd: Optional[PathLike] = None, echo: bool = False, **options: Option) -> Live:
    """Measures the plant, or fits a model to records (`data=[...]`)."""
    return command("identify", cwd=cwd, echo=echo, **options)


def reconcile(
    data: Union[str, Path, Sequence[Any]], model: Union[str, Path] = "eq6", *,
    cwd: Optional[PathLike] = None, echo: bool = False, **options: Option,
) -> Live:  # fmt: skip
    """Finds where simulation and measurement disagree."""
    listed = list(data) if isinstance(data, (list, tuple)) else [data]
    return command("reconcile", cwd=cwd, echo=echo, model=model, data=listed, **options)
