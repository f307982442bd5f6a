"""The columns of a run: docs/data.md, as code. A test compares the two."""

from __future__ import annotations

from typing import Any, Callable, Dict, NamedTuple, Tuple

import numpy as np

Array = Any

WORDS: Dict[str, Dict[int, str]] = {
    "verdict": dict(enumerate(("good", "no-signal", "bad-fit", "at-border", "not-converged"))),
    "life": dict(enumerate(("disarmed", "armed", "running", "safe"))),
    "request": dict(enumerate(("none", "freeze", "park", "skip", "pause", "unrecorded"))),
    "board": dict(enumerate(("disarmed", "armed", "running", "frozen", "safe", "holding"))),
    "partner": dict(enumerate(("disarmed", "armed", "running", "frozen", "safe", "holding"))),
    "board_fault": dict(enumerate(("none", "command-timeout", "freeze-timeout", "arm-timeout", "device"))),
    "track": dict(enumerate(("searching", "tracking", "coasting", "lost"))),
    "decision": dict(
        enumerate(
            (
                "accepted",
                "nothing-found",
                "confirming",
                "no-signal",
                "merged",
                "at-border",
                "not-converged",
                "outside-gate",
                "other-bead",
                "ambiguous",
                "regained",
                "reacquired",
                "no-frame",
                "stale",
                "stays",
                "in-contact",
                "near-limit",
                "passed-over",
            )
        )
    ),
    "stage": {
        **dict(enumerate(("none", "approach", "running", "waiting", "paused", "done"))),
        **dict(
            enumerate(
                ("stopped-lost", "stopped-error", "stopped-length", "stopped-time", "stopped-cycles", "stopped-wait"),
                start=10,
            )
        ),
    },
    "solver_status": dict(enumerate(("not-used", "solved", "previous-plan", "fallback-pi"))),
}


class Column(NamedTuple):
    """A column: the raw ones that it is made of, and how."""

    raw: Tuple[str, ...]
    make: Callable[..., Array]


def _same(values: Array) -> Array:
    return values


def _seconds(ns: Array, offset_ns: int) -> Array:
    return (ns + offset_ns) / 1e9


def _bead(measured: Array, verdict: Array) -> Array:
    return np.where(verdict == 0, measured, np.nan)


def _plan(ns: Array) -> Array:
    return np.where(ns < 0, np.nan, ns / 1e9)


def _us(ns: Array) -> Array:
    return ns / 1e3


#: Columns that are not in the file as they are. Those of time count from the start of the run.
MADE: Dict[str, Column] = {
    "bead_um": Column(("measured_um", "verdict"), _bead),
    "sigma_um": Column(("variance_um2",), np.sqrt),
    "pzt_um": Column(("command_um",), _same),
    "wake_us": Column(("wake_ns",), _us),
    "compute_us": Column(("compute_ns",), _us),
    "solver_us": Column(("solver_ns",), _us),
    "plan_s": Column(("plan_ns",), _plan),
}
TIMES: Dict[str, str] = {"time_s": "time_ns", "mid_exposure_s": "mid_exposure_ns"}

#: Names in the order of docs/data.md.
ORDER: Tuple[str, ...] = (
    "time_s",
    "pzt_um",
    "bead_um",
    "error_um",
    "seq",
    "frame_id",
    "mid_exposure_s",
    "sigma_um",
    "target_um",
    "estimate_um",
    "estimate_sd_um",
    "neutral_um",
    "requested_um",
    "applied_um",
    "true_um",
    "verdict",
    "life",
    "request",
    "board",
    "board_fault",
    "flags",
    "drained",
    "wake_us",
    "compute_us",
    "obeyed_before_us",
    "obeyed_at_us",
    "track",
    "decision",
    "plan_s",
    "stage",
    "length_um",
    "area_um2",
    "length_sd_um",
    "area_sd_um2",
    "measured_um",
    "solver_status",
    "solver_iterations",
    "solver_active",
    "solver_us",
    "partner_command_um",
    "partner_applied_um",
    "partner_effect_um",
    "partner",
    "session",
)

FLAGS: Dict[str, int] = {
    name: 1 << bit
    for bit, name in enumerate(
        (
            "timer",
            "late",
            "stale",
            "dropped-frame",
            "doubled-frame",
            "lost",
            "coasting",
            "range-limited",
            "slew-limited",
            "not-finite",
            "gated",
            "actuator-ring-full",
            "freeze",
            "records-lost",
            "board-heard",
            "stuck",
            "early",
            "board-trouble",
            "between",
            "command-lost",
            "clipped",
            "partner-heard",
            "partner-lost",
            "partner-limited",
            "vision-slow",
        )
    )
}

#: Raw columns that stand under another name.
HIDDEN = {
    "time_ns", "mid_exposure_ns", "variance_um2", "command_um", "wake_ns", "compute_ns", "solver_ns", "plan_ns", "check",
}  # fmt: skip
