#!/usr/bin/env python3
"""Runs, exports them, and reads them as others would: the recipes of docs/data.md, all forms compared, dclab's own check.

    scripts/check_readers.py target/debug/cellpos [CYCLES]

CYCLES of 50 ticks each, 2000 if left out; with 20000 it is a run of a million ticks. No export and no report may take more than
300 MB, nor the report more than 10 s. Needs pandas, pyarrow, polars, h5py, scipy, dclab and jsonschema; R and Octave are used if they are installed. Exit code 1: something
cannot be read, or is not what another form says.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

import dclab
import jsonschema

ROOT = Path(__file__).resolve().parent.parent
SCRIPT = """name = "long"
[[step]]
do = "sine"
amplitude = "1um"
frequency = "20Hz"
cycles = %s
"""
SAMPLE = """
[sample]
sample = "emulated cell"
medium = "PBS"
channel_width = "20um"
"""


def newest(folder: Path, name: str) -> Path:
    return sorted((folder / "runs").glob(f"*-{name}"))[-1]


def measured(program: str, folder: Path, *words) -> None:
    """Runs a command, with its time and the most memory that it had."""
    begun = time.monotonic()
    child = subprocess.Popen([program, *words], cwd=folder, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    took_s, most_mb = time.monotonic() - begun, used.ru_maxrss / 1000
    print(f"{words[0]} {words[-1]}: {took_s:.1f} s, {most_mb:.0f} MB")
    assert child.returncode == 0, words
    assert most_mb <= 300, f"{words}: {most_mb:.0f} MB"
    assert words[0] != "report" or took_s < 10, f"report: {took_s:.1f} s"


def two_sessions(program: str, folder: Path, cycles: int) -> Path:
    """A run that was killed on its way and gone on with."""
    (folder / "long.toml").write_text(SCRIPT % cycles)
    begun = subprocess.Popen(
        [program, "run", "long.toml", "--clock", "virtual", "--frames", "off"],
        cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )
    while begun.poll() is None:
        tables = list((folder / "runs").glob("*-long/cycles.csv"))
        if tables and tables[0].read_bytes().count(b"\n") > cycles // 10:
            begun.kill()
            begun.wait()
            break
        time.sleep(0.005)
    run = newest(folder, "long")
    subprocess.run([program, "run", "--resume", run], cwd=folder, check=False, stdout=subprocess.DEVNULL)
    return run


def exports(program: str, folder: Path, run: Path) -> None:
    for form in ("csv", "parquet", "h5", "mat"):
        measured(program, folder, "export", run, "--out", f"track.{form}")
    measured(program, folder, "report", run, "--json")
    subprocess.run([sys.executable, ROOT / "scripts/check_exports.py", "track"], cwd=folder, check=True)


def cell(program: str, folder: Path) -> None:
    rig = (ROOT / "examples/cell.toml").read_text() + SAMPLE
    (folder / "cell.toml").write_text(rig)
    track = "track --target 0um --rig cell.toml --duration 2s --clock virtual --name cell".split()
    subprocess.run([program, *track], cwd=folder, check=True, stdout=subprocess.DEVNULL)
    subprocess.run(
        [program, "export", newest(folder, "cell"), "--out", "cell.rtdc"], cwd=folder, check=True, stdout=subprocess.DEVNULL
    )
    violations, alerts, _ = dclab.rtdc_dataset.check_dataset(folder / "cell.rtdc")
    assert not violations, violations
    with dclab.new_dataset(folder / "cell.rtdc") as data:
        assert len(data) > 1900 and 10 < data["area_um"].mean() < 200, len(data)
    print(f"dclab-verify-dataset: no violation, {len(alerts)} alerts: {alerts}")


def recipes(folder: Path, run: Path) -> None:
    text = (ROOT / "docs/data.md").read_text()
    text = re.sub(r"runs/\d{8}T\d{6}Z-track", str(run), text)
    blocks = re.findall(r"```python\n(.*?)```", text, re.S)
    assert len(blocks) >= 5, "are the recipes still marked with python?"
    for block in blocks:
        subprocess.run([sys.executable, "-c", block], cwd=folder, check=True, stdout=subprocess.DEVNULL)
    print(f"{len(blocks)} recipes in Python run")
    others = {"Rscript": ("r", "-e"), "octave-cli": ("matlab", "--eval"), "julia": ("julia", "-e")}
    for program, (language, flag) in others.items():
        blocks = re.findall(rf"```{language}\n(.*?)```", text, re.S)
        if not blocks:
            sys.exit(f"docs/data.md has no recipe marked {language}")
        if not shutil.which(program):
            print(f"skipped: {program} is not installed")
            continue
        # Only formats that the program reads without packages; Parquet needs one.
        plain = [block for block in blocks if "arrow::" not in block and "parquet" not in block.lower()]
        for block in plain:
            subprocess.run([program, flag, block], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        print(f"{len(plain)} recipes in {program} run")


def schemas() -> None:
    """The files of examples/ against docs/schemas, by somebody else's reading of JSON Schema."""
    files = {"script": (ROOT / "examples/scripts").glob("*.toml")}
    files["rig"] = [ROOT / "examples/rig.toml", ROOT / "examples/cell.toml"]
    files["model"] = [ROOT / "examples/model.toml", ROOT / "examples/hidden.toml"]
    checked = 0
    for name, paths in files.items():
        schema = json.loads((ROOT / f"docs/schemas/{name}.json").read_text())
        for path in paths:
            text = path.read_text()
            jsonschema.validate(tomllib.loads(text), schema)
            try:
                jsonschema.validate(tomllib.loads("no_such_key = 1\n" + text), schema)
            except jsonschema.ValidationError:
                checked += 1
            else:
                sys.exit(f"{name}.json takes a key that {path.name} may not have")
    for path in (ROOT / "docs/schemas").glob("*.json"):
        jsonschema.Draft7Validator.check_schema(json.loads(path.read_text()))
    print(f"{checked} files fit their schemas")


def main(program: str, cycles: int = 2000) -> None:
    program = os.path.abspath(program)
    schemas()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run = two_sessions(program, folder, cycles)
        assert len(list((run / "sessions").iterdir())) == 1, "the run was over before it could be killed"
        exports(program, folder, run)
        cell(program, folder)
        recipes(folder, run)


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:3]))
