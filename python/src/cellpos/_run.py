"""A run folder as tables."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any, Callable, Dict, Iterable, Iterator, List, Mapping, Optional, Sequence, Union

import numpy as np

from ._arrow import Stream
from ._columns import FLAGS, HIDDEN, MADE, ORDER, TIMES, WORDS
from ._tiff import Clip

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Array = Any
PathLike = Union[str, Path]


class Table(Mapping[str, Array]):
    """Columns by name. A column is read when it is first asked for and then kept."""

    def __init__(self, names: Sequence[str], read: Callable[[str], Array]) -> None:
        self._names, self._read = tuple(names), read
        self._kept: Dict[str, Array] = {}

    @property
    def columns(self) -> Sequence[str]:
        """Names of the columns."""
        return self._names

    @property
    def rows(self) -> int:
        """How many rows there are."""
        return len(self[self._names[0]]) if self._names else 0

    def __getitem__(self, name: str) -> Array:
        if name not in self._kept:
            if name not in self._names:
                raise KeyError(f"no column {name!r}; there are: {', '.join(self._names)}")
            self._kept[name] = self._read(name)
        return self._kept[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __repr__(self) -> str:
        return f"<Table of {len(self._names)} columns: {', '.join(self._names)}>"

    def to_numpy(self, columns: Optional[Iterable[str]] = None) -> Array:
        """A structured array."""
        names = list(self._names if columns is None else columns)
        values = [np.asarray(self[name]) for name in names]
        out = np.empty(len(values[0]) if values else 0, [(n, v.dtype) for n, v in zip(names, values)])
        for name, value in zip(names, values):
            out[name] = value
        return out

    def to_pandas(self, columns: Optional[Iterable[str]] = None) -> Any:
        """A pandas DataFrame; words are categories."""
        import pandas  # type: ignore[import-untyped,unused-ignore]

        names = list(self._names if columns is None else columns)
        frame = {}
        for name in names:
            value = np.asarray(self[name])
            words = name in WORDS and value.dtype == object
            frame[name] = pandas.Categorical(value, categories=list(WORDS[name].values())) if words else value
        return pandas.DataFrame(frame)

    def to_arrow(self, columns: Optional[Iterable[str]] = None) -> Any:
        """A pyarrow Table."""
        import pyarrow  # type: ignore[import-untyped,import-not-found,unused-ignore]

        names = list(self._names if columns is None else columns)
        return pyarrow.table({name: pyarrow.array(self[name]) for name in names})


def _read_toml(path: Path) -> Dict[str, Any]:
    with path.open("rb") as file:
        loaded: Dict[str, Any] = tomllib.load(file)
    return loaded


class Session:
    """One session of a run: the run's own folder, or one below sessions/."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.meta: Dict[str, Any] = {}
        try:
            self.meta = _read_toml(folder / "run.toml")
        except (OSError, tomllib.TOMLDecodeError):
            # Damaged metadata are no reason not to read the rows.
            pass
        if self.meta.get("format", 2) > 2:
            raise ValueError(
                f"{folder / 'run.toml'}: format {self.meta['format']}, this module reads up to 2: update the package cellpos"
            )
        self.stream = Stream(folder / "ticks.arrow")
        of = self.meta.get("config", {}).get("session", {})
        #: Number of the session, from 1.
        self.number = int(of.get("number", 1))
        #: From the end of the session before to the start of this one, ns.
        self.pause_ns = int(max(float(of.get("gap_s", 0.0)), 0.0) * 1e9)
        #: From the start of the run to the start of this session, ns.
        self.offset_ns = 0

    def last_ns(self) -> int:
        times = self.stream.column("time_ns") if self.stream.batches else np.empty(0, np.int64)
        return int(times[-1]) if len(times) else 0

    def column(self, name: str, since: int = 0) -> Array:
        """A column of docs/data.md, from a batch of the file on."""
        stream = self.stream
        if name in TIMES:
            return (stream.column(TIMES[name], since) + self.offset_ns) / 1e9
        if name == "session":
            return np.full(len(stream.column("seq", since)), self.number)
        if name == "error_um" and name not in stream.columns:
            return self._errors(since)
        if name in MADE:
            raw, make = MADE[name]
            return make(*(stream.column(part, since) for part in raw))
        values = stream.column(name, since)
        if name in WORDS:
            table = np.full(256, None, object)
            for number, word in WORDS[name].items():
                table[number] = word
            return table[values]
        return values

    def _errors(self, since: int) -> Array:
        """Error of a run from before it was recorded: position less the reference at its exposure."""
        # The reference of an exposure that is older than the first row asked for is in the rows before.
        before = max(since - 1, 0)
        ns, target = self.stream.column("time_ns", before), self.stream.column("target_um", before)
        bead, exposed = self.column("bead_um", since), self.stream.column("mid_exposure_ns", since)
        if not len(ns):
            return bead
        # From a common start, so that nanoseconds stay exact as floating-point numbers.
        start = ns[0]
        then = np.interp((exposed - start).astype(float), (ns - start).astype(float), target, left=np.nan)
        return bead - then

    def names(self) -> List[str]:
        raw = set(self.stream.columns)
        made = {name for name, column in MADE.items() if raw.issuperset(column.raw)}
        known = raw | made | {"time_s", "mid_exposure_s", "error_um", "session"}
        law = [name for name in self.stream.columns if name not in ORDER and name not in HIDDEN]
        return [name for name in ORDER if name in known] + law


class Run:
    """A run, with all its sessions. Nothing is read before it is asked for."""

    def __init__(self, folder: PathLike) -> None:
        #: The run folder.
        self.folder = Path(folder)
        if not (self.folder / "ticks.arrow").is_file():
            raise FileNotFoundError(f"{self.folder} is no run folder: it has no ticks.arrow")
        first = Session(self.folder)
        below = self.folder / "sessions"
        found = [Session(p) for p in sorted(below.glob("*")) if (p / "ticks.arrow").is_file()] if below.is_dir() else []
        #: The sessions: the first, and one for each time that the run was resumed.
        self.sessions: List[Session] = [first, *sorted(found, key=lambda session: session.number)]
        end_ns = 0
        for index, session in enumerate(self.sessions):
            session.offset_ns = session.pause_ns + end_ns if index else 0
            if len(self.sessions) > 1:
                end_ns = session.offset_ns + session.last_ns()
        self._kept: Dict[str, Any] = {}

    def __repr__(self) -> str:
        outcome = self.outcome or "not ended"
        return f"<Run {self.folder.name}: {outcome}, {len(self.sessions)} session(s)>"

    @property
    def name(self) -> str:
        """Name of the run."""
        return str(self.meta.get("name", ""))

    @property
    def meta(self) -> Dict[str, Any]:
        """run.toml of the first session: command line, configuration, model, controller, versions, conditions, end."""
        return self.sessions[0].meta

    @property
    def outcome(self) -> Optional[str]:
        """How the last session ended; None while it runs, or if it was cut off."""
        outcome: Optional[str] = self.sessions[-1].meta.get("end", {}).get("outcome")
        return outcome

    @property
    def summary(self) -> Dict[str, Any]:
        """Figures of the last session, as the program had them at its end."""
        return dict(self.sessions[-1].meta.get("end", {}).get("summary", {}))

    @property
    def ticks(self) -> Table:
        """One row a tick, columns as in docs/data.md, and error_um."""
        if "ticks" not in self._kept:
            names = list(dict.fromkeys(name for session in self.sessions for name in session.names()))
            self._kept["ticks"] = Table(names, self._column)
        table: Table = self._kept["ticks"]
        return table

    def _column(self, name: str) -> Array:
        parts = []
        for session in self.sessions:
            if name in session.names():
                parts.append(session.column(name))
            else:
                # A law of another session has it, this one has not.
                parts.append(np.full(len(session.stream.column("seq")), np.nan))
        return np.concatenate(parts)

    @property
    def error_um(self) -> Array:
        """Measured position less the reference of the time of its exposure, a number a tick; NaN without a bead."""
        return self.ticks["error_um"]

    def settled(self, after_s: float = 2.0) -> Array:
        """Ticks that the program's error figures count: from `after_s` after the loop was closed, or continued after a
        freeze by the operator, until the operator froze the bead or the PZT parked."""
        parts = []
        for session in self.sessions:
            ns, request = session.stream.column("time_ns"), session.stream.column("request")
            # A skipped step (3) asks for no freeze. A bead that was not seen is no less far off for that.
            frozen = (session.stream.column("flags") & FLAGS["freeze"] != 0) & (request != 0) & (request != 3)
            held = (session.stream.column("life") == 2) & ~frozen
            # The time at which each stretch of holding began; a stretch ends with a freeze alone.
            first = np.flatnonzero(held)[:1]
            begins = np.zeros(len(ns), bool)
            begins[first] = True
            after_freeze = np.flatnonzero(frozen[:-1] & ~frozen[1:]) + 1
            begins[after_freeze] = True
            since = np.maximum.accumulate(np.where(begins, ns, np.iinfo(np.int64).min // 2))
            parts.append(held & (ns - since >= int(after_s * 1e9)))
        return np.concatenate(parts)

    @property
    def rms_nm(self) -> float:
        """RMS of error_um over the settled ticks, nm; NaN without any.

        Ticks without a fix do not count here; summary["rms_measured_nm"] counts them by the estimate.
        """
        errors = self.error_um[self.settled()]
        errors = errors[np.isfinite(errors)]
        return float(np.sqrt(np.mean(errors**2)) * 1e3) if len(errors) else float("nan")

    @property
    def cycles(self) -> Table:
        """One row a cycle of a script, of all sessions; no rows without a script."""
        if "cycles" not in self._kept:
            self._kept["cycles"] = read_csv(self.folder / "cycles.csv")
        table: Table = self._kept["cycles"]
        return table

    @property
    def events(self) -> Table:
        """What happened: session, time_s (on the axis of the ticks), event, data (a dict), text."""
        if "events" not in self._kept:
            rows: Dict[str, List[Any]] = {name: [] for name in ("session", "time_s", "event", "text", "data")}
            for session in self.sessions:
                for line in _lines(session.folder / "events.jsonl"):
                    try:
                        event = json.loads(line)
                        time_s = float(event["time_s"]) + session.offset_ns / 1e9
                        word, data = str(event["event"]), dict(event.get("data", {}))
                    except (ValueError, KeyError, TypeError):
                        continue
                    rows["session"].append(session.number)
                    rows["time_s"].append(time_s)
                    rows["event"].append(word)
                    rows["text"].append(data.get("text"))
                    rows["data"].append(data)
            arrays: Dict[str, Array] = {
                name: np.array(values, {"session": int, "time_s": float}.get(name, object)) for name, values in rows.items()
            }
            self._kept["events"] = _table(arrays)
        table: Table = self._kept["events"]
        return table

    @property
    def clips(self) -> Dict[str, Clip]:
        """Pictures kept with the run, by name; frames are read when they are asked for."""
        clips: Dict[str, Clip] = {}
        for session in self.sessions:
            for path in sorted((session.folder / "clips").glob("*.tif")):
                name = path.stem if path.stem not in clips else f"{session.number}/{path.stem}"
                clips[name] = Clip(path, session.offset_ns / 1e9)
        return clips

    @property
    def lost(self) -> Dict[str, int]:
        """Missing parts of the run: rows missing in the numbering, damaged rows and bytes."""
        missing = 0
        for session in self.sessions:
            seq = session.stream.column("seq").astype(np.int64) if session.stream.batches else np.empty(0, np.int64)
            missing += int(np.sum(np.maximum(np.diff(seq) - 1, 0)))
        return {
            "rows": missing,
            "damaged_rows": sum(session.stream.damaged_rows for session in self.sessions),
            "damaged_bytes": sum(session.stream.damaged_bytes for session in self.sessions),
        }


def _table(columns: Dict[str, Array]) -> Table:
    return Table(list(columns), columns.__getitem__)


def _lines(path: Path) -> List[str]:
    try:
        return path.read_text("utf-8", "replace").splitlines()
    except OSError:
        return []


def read_csv(path: PathLike) -> Table:
    """A table of the program's (cycles.csv, an export): columns of numbers as numbers, empty fields as NaN, else words."""
    try:
        text = Path(path).read_text("utf-8")
    except FileNotFoundError:
        return _table({})
    # The last line of a running run may be incomplete.
    rows = list(csv.reader(text[: text.rfind("\n") + 1].splitlines()))
    if not rows:
        return _table({})
    names, body = rows[0], [row for row in rows[1:] if len(row) == len(rows[0])]
    columns: Dict[str, Array] = {}
    for name, values in zip(names, zip(*body) if body else [()] * len(names)):
        columns[name] = _numbers(values)
    return _table(columns)


def _numbers(values: Sequence[str]) -> Array:
    try:
        numbers = np.array([float(value) if value else np.nan for value in values], float)
    except ValueError:
        return np.array([value or None for value in values], object)
    if any(values) or not values:
        whole = len(values) > 0 and all(value.lstrip("-").isdigit() for value in values)
        return numbers.astype(np.int64) if whole else numbers
    return numbers


def _latest(runs: Path, name: Optional[str]) -> Path:
    """The newest run folder, of a name if one is given: <UTC time>-<name>, with -2, -3 behind it where a second had more."""
    best = None
    for folder in runs.iterdir() if runs.is_dir() else ():
        time, _, rest = folder.name.partition("-")
        if len(time) != 16 or not time.endswith("Z") or not (folder / "run.toml").exists():
            continue
        of, dash, tail = rest.rpartition("-")
        number = int(tail) if dash and tail.isdigit() and name in (None, of) else None
        if name is None or name == rest or (name == of and number is not None):
            key = (time, number or 1, folder)
            best = key if best is None or key > best else best
    if best is None:
        raise FileNotFoundError(f"{runs} holds no run" + (f" named {name}" if name else ""))
    return best[2]


def open(run: PathLike = "latest", runs: PathLike = "runs") -> Run:  # noqa: A001
    """Opens a run: a folder, `latest` for the newest below `runs`, `latest-NAME` for the newest of a name."""
    text = str(run)
    if not Path(run).exists() and (text == "latest" or text.startswith("latest-")):
        return Run(_latest(Path(runs), text[len("latest-") :] or None))
    return Run(run)


def runs(folder: PathLike = "runs") -> Table:
    """The runs below a folder, the oldest first: folder, name, started_utc, clock, controller, outcome, sessions, rows,
    duration_s, rms_measured_nm, rms_true_nm."""
    names = (
        "folder", "name", "started_utc", "clock", "controller", "outcome", "sessions", "rows", "duration_s",
        "rms_measured_nm", "rms_true_nm",
    )  # fmt: skip
    rows: Dict[str, List[Any]] = {name: [] for name in names}
    for path in sorted(Path(folder).glob("*/run.toml")):
        metas = []
        for toml in [path, *sorted(path.parent.glob("sessions/*/run.toml"))]:
            try:
                metas.append(_read_toml(toml))
            except (OSError, tomllib.TOMLDecodeError):
                continue
        if not metas:
            continue
        ends = [meta.get("end", {}) for meta in metas]
        summary = ends[-1].get("summary", {})
        rows["folder"].append(str(path.parent))
        rows["name"].append(metas[0].get("name"))
        rows["started_utc"].append(metas[0].get("started_utc"))
        rows["clock"].append(metas[0].get("clock"))
        rows["controller"].append(metas[0].get("controller", {}).get("controller"))
        rows["outcome"].append(ends[-1].get("outcome"))
        rows["sessions"].append(len(metas))
        rows["rows"].append(sum(end.get("rows", 0) for end in ends))
        rows["duration_s"].append(sum(end.get("summary", {}).get("duration_s", 0.0) for end in ends))
        for key in ("rms_measured_nm", "rms_true_nm"):
            value = summary.get(key)
            rows[key].append(np.nan if value is None else float(value))
    kinds = {"sessions": int, "rows": int, "duration_s": float, "rms_measured_nm": float, "rms_true_nm": float}
    arrays: Dict[str, Array] = {name: np.array(values, kinds.get(name, object)) for name, values in rows.items()}
    return _table(arrays)
