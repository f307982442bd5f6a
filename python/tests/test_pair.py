"""A pair over firmware-sim: its board is the PZT, a function in Python the slow actuator.

The function moves no bead here: the interface is tested, not the physics (crates/workbench/tests/all/pair.rs)."""

import re
import threading
import time

import numpy as np
import pytest
from conftest import ROOT
from test_camera import box  # noqa: F401

import cellpos

pytestmark = pytest.mark.alone

PARTNER = """
[partner]
kind = "program"
socket = "pump.sock"
low_um = 0.0
high_um = 100.0
slew_um_per_s = 10.0
park_um = 50.0
gain = 1.0
gain_ci95 = 0.5
mid_um = 22.0
"""


def track(folder, duration):
    return cellpos.track("0um", duration, rig="pair.toml", cwd=folder).wait()


@pytest.fixture
def lab(box):  # noqa: F811
    (box / "pair.toml").write_text((box / "rig.toml").read_text() + PARTNER)
    return box


def test_a_missing_slow_actuator_is_named_and_the_pzt_goes_on(lab):
    result = track(lab, "4s")
    assert result.ended == "done", result.values_["ended"]
    assert result["partner_lost"] > 0.5 * result["ticks"]
    assert any("slow actuator is missing" in text for text in result["warnings"])


def test_a_function_in_python_is_moved_within_its_slew_and_parked(lab):
    calls = []
    server = cellpos.ActuatorServer(
        lambda um: calls.append((time.monotonic(), um)), 0.0, 100.0, 10.0, 0.02, lab / "pump.sock", park=50.0, real_time=False
    )
    with server:
        ran = []
        thread = threading.Thread(target=lambda: ran.append(track(lab, "8s")))
        thread.start()
        thread.join()
        time.sleep(0.5)
    result = ran[0]
    # The PZT makes up for moves that do nothing here: the bead may stray for it.
    assert result.ended in ("done", "not-kept"), result.values_["ended"]
    run = result.run
    sent = run.ticks["partner_command_um"]
    sent = sent[np.isfinite(sent)]
    # The PZT is at 20 um and must reach 22: the slow actuator goes down.
    assert sent[-1] < 49.9 and result["partner_lost"] < 0.2 * result["ticks"]
    values = np.array([um for _, um in calls])
    assert values.min() >= 0 and np.abs(np.diff(values)).max() <= 10.0 * 0.02 + 1e-6
    assert values[-1] == 50.0
