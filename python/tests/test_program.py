"""The program from Python: live rows, results, refusals, and Ctrl-C that parks."""

import os
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest

import cellpos


def test_live_rows_are_those_of_the_record(tmp_path):
    with cellpos.track("1um", "2s", best_effort=True, frames="off", cwd=tmp_path) as live:
        rows = [(row.seq, row.bead_um, row["error_um"]) for row in live]
    ticks = live.result.run.ticks
    assert live.result.ended == "done" and live.result.code == 0
    assert [row[0] for row in rows] == list(ticks["seq"])
    np.testing.assert_array_equal([row[1] for row in rows], ticks["bead_um"])
    np.testing.assert_allclose([row[2] for row in rows], ticks["error_um"], atol=1e-9)


def test_rows_come_while_the_run_goes_on(tmp_path):
    with cellpos.track("0um", best_effort=True, frames="off", cwd=tmp_path) as live:
        row = next(iter(live))
        assert live.running and row.seq == 0
        assert live.folder is not None and cellpos.open(live.folder).outcome is None
    assert live.result.ended == "operator"
    assert live.result.run.ticks["request"][-1] in ("freeze", "park")


def test_a_refusal_says_what_the_program_said(tmp_path):
    with pytest.raises(cellpos.Failed, match="--target 900um: outside what the camera sees.*choose") as failed:
        cellpos.track("900um", cwd=tmp_path).wait()
    assert failed.value.code == 2 and failed.value.error["kind"] == "bad-input"


def test_options_are_those_of_the_command_line(tmp_path):
    result = cellpos.track("-250nm", "2500ms", clock="virtual", frames="off", seed=3, name="minus", cwd=tmp_path).result
    assert result["target_um"] == -0.25
    assert result.run.name == "minus" and result.run.meta["seed"] == 3
    with pytest.raises(cellpos.Failed, match="--no-such"):
        cellpos.track("0um", no_such=1, cwd=tmp_path).wait()


PARKS = """
    import cellpos, sys
    live = cellpos.track("0um", best_effort=True, frames="off", cwd=sys.argv[1])
    try:
        for row in live:
            if row.seq == 0:
                print(live.pid, flush=True)
    except KeyboardInterrupt:
        print(live.result.ended, live.running, flush=True)
"""


def begun(tmp_path):
    env = dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path))
    words = [sys.executable, "-c", textwrap.dedent(PARKS), str(tmp_path)]
    child = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=env)
    assert child.stdout is not None
    return child, int(child.stdout.readline())


def test_ctrl_c_parks_waits_and_is_raised(tmp_path):
    child, _ = begun(tmp_path)
    child.send_signal(signal.SIGINT)
    said, _ = child.communicate(timeout=20)
    assert said.strip() == "operator False"


def test_a_python_that_dies_leaves_no_bead_behind(tmp_path):
    child, pid = begun(tmp_path)
    child.kill()
    child.wait()
    for _ in range(200):
        run = cellpos.open("latest", tmp_path / "runs")
        if run.outcome is not None:
            break
        time.sleep(0.05)
    assert run.meta["end"]["summary"]["end"] == "operator"
