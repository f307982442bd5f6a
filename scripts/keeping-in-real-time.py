#!/usr/bin/env python3
"""Rows of the keeping table in real time: firmware-sim in a process of its own (board on a pseudo-terminal, camera on a socket), and `track`.

    cargo build --release -p cellpos -p cellpos-firmware-sim
    scripts/keeping-in-real-time.py                  every row, once under each law; four minutes
    scripts/keeping-in-real-time.py --only flow --laws lqg,pi --times 3

Each row is judged by firmware-sim's log of where the bead truly was, and by state and exit code of `track`. Bounds: a step of the flow
1.3 v (delay + 2 ticks) + 4 x 57 nm, as in the table (crates/session/tests/all/keeping). Needs a machine that does nothing else, with
real-time rights (docs/real-time.md). The programs are looked for in target/release, or in $CELLPOS_BIN. Exit code 1: a bound was broken.
"""
import argparse
import csv
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time

EVENT_S = 5.0
RIG = """[actuator]
kind = "serial"
port = "pzt"
[camera]
kind = "socket"
socket = "camera.sock"
[vision]
window_px = 21
[vision.profile]
kind = "ring"
edge_px = 5.0
[calibration]
pixel_um = 0.1
origin_px = 127.5
sign = 1.0
[emulator]
seed = SEED
"""


def step(um):
    """Speed by the gain of Eq. (6) at once, 379 /s; delay 2.5 ms and two ticks of 1 ms."""
    words = ["--flow-step", f"{EVENT_S}s,0.7s", f"--flow-step-size={um}um"]
    return words, 1.3 * 379.3 * abs(um) * 4.5e-3 + 4 * 0.057, "running", 0


def fault(kind, for_s, state="running", code=0):
    # What a bead walks meanwhile, four standard deviations, and 0.3 um.
    walk_um = 4 * (0.66 * min(for_s, 1.0) + 0.057**2) ** 0.5 + 0.3
    return [f"--{kind}", f"{EVENT_S}s,{for_s}s"], walk_um if code == 0 else None, state, code


ROWS = {
    **{f"flow {379.3 * um:.0f} um/s": step(um) for um in (0.1, -0.3, 0.5, -1.0, 1.5, -2.6)},
    **{f"silent line {s} s": fault("link-loss", s) for s in (0.005, 0.05, 0.19)},
    **{f"{kind} {s} s": fault(kind, s) for kind in ("stall-camera", "frozen-picture", "drop-frames") for s in (0.02, 0.1)},
    "gain-flip": fault("gain-flip", 9, "safe", 1),
    "lose-bead to the end": fault("lose-bead", 9, "safe", 1),
}


def run(programs, law, words, seed):
    """What `track` said, its exit code, and the largest true distance from the event on, um."""
    with tempfile.TemporaryDirectory() as folder:
        (pathlib.Path(folder) / "rig.toml").write_text(RIG.replace("SEED", str(seed)))
        box = subprocess.Popen(
            [programs / "firmware-sim", "--rig", "rig.toml", "--pty-link", "pzt", "--socket", "camera.sock", "--log", "truth.csv", *words],
            cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )
        try:
            begun = time.monotonic()
            while not (pathlib.Path(folder) / "camera.sock").exists() and box.poll() is None and time.monotonic() - begun < 10:
                time.sleep(0.02)
            track = subprocess.run(
                [programs / "cellpos", "track", "--target", "0um", "--rig", "rig.toml", "--controller", law, "--duration", "6s", "--json"],
                cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, check=False, timeout=60,
            )
        finally:
            box.terminate()
            box.wait()
        said = json.loads(track.stdout) if track.stdout.startswith("{") else {"state": track.stderr.strip()[-200:]}
        with open(pathlib.Path(folder) / "truth.csv", encoding="utf-8") as text:
            rows = list(csv.DictReader(text))
    return said, track.returncode, rows


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="")
    parser.add_argument("--laws", default="lqg,pi,mpc")
    parser.add_argument("--times", default=1, type=int)
    args = parser.parse_args()
    root = pathlib.Path(__file__).resolve().parent.parent
    programs = pathlib.Path(os.environ.get("CELLPOS_BIN", root / "target/release")).resolve()
    broken = total = 0
    for name, (words, most_um, state, code) in ROWS.items():
        if args.only not in name:
            continue
        for law in args.laws.split(","):
            for seed in range(1, args.times + 1):
                said, exit_code, rows = run(programs, law, words, seed)
                ended_s = EVENT_S + 1.2
                after = [r for r in rows if EVENT_S <= float(r["time_s"]) <= ended_s and r["state"] in ("Running", "Holding", "Frozen")]
                worst_um = max((abs(float(r["bead_um"])) for r in after), default=float("nan"))
                bad = (said.get("state"), exit_code) != (state, code) or (most_um is not None and not worst_um <= most_um)
                broken, total = broken + bad, total + 1
                limit = "" if most_um is None else f" of {most_um:.2f}"
                print(f"{name}, {law}, seed {seed}: {worst_um:.2f}{limit} um, {said.get('state')}, exit {exit_code}", flush=True)
                if bad:
                    print(f"    BROKEN: {said.get('ended', '')}", flush=True)
    print(f"{broken} of {total} runs broke a bound")
    sys.exit(broken > 0)


if __name__ == "__main__":
    main()
