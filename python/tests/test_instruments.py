"""An instrument with a text protocol, served over pyserial, against a pseudo-terminal that speaks the pump's protocol."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
import tty

import pytest
from conftest import ROOT

from cellpos import _wire


class Pump:
    """A New Era NE-1000 in basic mode: its commands, and its flow, ul/min."""

    def __init__(self) -> None:
        self.line, other = os.openpty()
        tty.setraw(other)
        self.port = os.ttyname(other)
        self.heard, self.flows = [], [0.0]
        self.rate, self.direction, self.running = 0.0, "INF", False
        threading.Thread(target=self.run, daemon=True).start()

    def run(self) -> None:
        held = b""
        while True:
            try:
                held += os.read(self.line, 1024)
            except OSError:
                return
            while b"\r" in held:
                line, held = held.split(b"\r", 1)
                said = self.obey(line.decode())
                state = "S" if not self.running else "I" if self.direction == "INF" else "W"
                os.write(self.line, f"\x0200{state}{said}\x03".encode())
                self.flows.append((self.rate if self.direction == "INF" else -self.rate) * self.running)

    def obey(self, command: str) -> str:
        self.heard.append(command)
        rate = re.fullmatch(r"RAT ([\d.]{1,5}) UM", command)
        turn = re.fullmatch(r"DIR (INF|WDR)", command)
        if rate:
            self.rate = float(rate[1])
        elif turn and not self.running:
            self.direction = turn[1]
        elif command in ("RUN", "STP"):
            self.running = command == "RUN"
        else:
            return "?NA" if turn else "?"
        return ""


@pytest.fixture
def served(tmp_path):
    pytest.importorskip("serial")
    pump = Pump()
    env = dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path))
    words = [sys.executable, ROOT / "examples/python/syringe_pump.py", pump.port, "actuator.sock"]
    child = subprocess.Popen(words, cwd=tmp_path, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    for _ in range(500):
        if (tmp_path / "actuator.sock").exists() or child.poll() is not None:
            break
        time.sleep(0.01)
    assert child.poll() is None, child.communicate()
    yield pump, tmp_path / "actuator.sock", child
    if child.poll() is None:
        child.kill()
    child.wait()


class Host:
    """As much of the program as a session needs."""

    def __init__(self, path) -> None:
        import socket

        self.line = socket.socket(socket.AF_UNIX)
        self.line.connect(str(path))
        self.seq = 0
        self.say("Hello", protocol=2)
        asked = dict.fromkeys(("watchdog_ms", "hold_watchdog_ms", "park_pm", "limits"))
        self.say("Arm", session=3, interpolate=False, status_every=1, **asked)

    def say(self, name: str, **fields: object) -> None:
        self.line.sendall(_wire.encode(_wire.TO_BOARD, (name, fields)))

    def command(self, um: float) -> None:
        pm = round(um * 1e6)
        self.say("Command", session=3, seq=self.seq, time_us=self.seq * 50_000, displacement_pm=pm, neutral_pm=0)
        self.seq += 1
        time.sleep(0.05)


def test_a_syringe_pump_follows_and_rests_when_the_host_is_silent(served):
    pump, path, child = served
    host = Host(path)
    for um in [0.0] * 3 + [10.0] * 8 + [-10.0] * 8:
        host.command(um)
    time.sleep(0.1)
    assert max(pump.flows) == 0.5 and min(pump.flows) == -0.5
    assert pump.flows[-1] == -0.5
    # 400 um/s: 20 um a period, so from 10 to -10 um in one step, and never against a pump that runs.
    turns = [i for i, command in enumerate(pump.heard) if command.startswith("DIR")]
    assert len(turns) == 2 and pump.heard[turns[1] - 1] == "STP"
    # Silence: five periods, then the zero flow is held.
    time.sleep(0.6)
    assert pump.flows[-1] == 0.0 and not pump.running
    child.send_signal(signal.SIGINT)
    said, _ = child.communicate(timeout=10)
    assert "1 holds in 1 sessions" in said


def test_a_pump_in_alarm_ends_serving_with_what_it_says(served):
    pump, path, child = served
    pump.obey = lambda command: "?S"
    host = Host(path)
    try:
        for _ in range(10):
            host.command(5.0)
    except BrokenPipeError:
        pass
    pump.obey = lambda command: ""
    _, trouble = child.communicate(timeout=20)
    assert child.returncode == 1 and "the pump says" in trouble
