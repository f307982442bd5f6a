"""Serves a New Era NE-1000 syringe pump (basic mode of its RS-232 protocol) over pyserial (pip install pyserial).

    python examples/python/syringe_pump.py /dev/ttyUSB0 actuator.sock

A pump sets a flow, as the PZT does by its distance from the zero-flow displacement: -20 um withdraw, 0 rests, 20 um infuse.
"""

import sys

import serial

import cellpos

UL_PER_MIN_PER_UM = 0.05
pump = serial.Serial(sys.argv[1], 19200, timeout=0.5)
direction = None


def ask(command: str) -> str:
    """A command ends with CR; the answer is STX, address, state (A: alarm), data, ETX."""
    pump.write(f"{command}\r".encode())
    answer = pump.read_until(b"\x03")
    if len(answer) < 5 or answer[:1] != b"\x02":
        raise OSError(f"{command}: the pump does not answer ({answer!r})")
    state, said = chr(answer[3]), answer[4:-1].decode()
    if state == "A" or said.startswith("?"):
        raise OSError(f"{command}: the pump says {state}{said}")
    return said


def set(um: float) -> None:
    global direction
    rate = round(abs(um) * UL_PER_MIN_PER_UM, 3)
    wanted = None if rate == 0 else "INF" if um > 0 else "WDR"
    if wanted != direction:
        ask("STP") if direction else None
        ask(f"DIR {wanted}") if wanted else None
    if wanted:
        ask(f"RAT {rate:.3f} UM")
        ask("RUN") if wanted != direction else None
    direction = wanted


print(cellpos.serve_actuator(set, -20.0, 20.0, slew=400.0, period=0.05, socket_path=sys.argv[2], park=0.0))
