"""A folder to work in, with the examples and the built programs."""

import csv
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared/data"


class Skip(Exception):
    """What a group needs and this machine lacks."""


class Bench:
    """Removed when the `with` block is left."""

    def __init__(self):
        folders = [Path(os.environ["CELLPOS_BIN"])] if "CELLPOS_BIN" in os.environ else [ROOT / "target/release", ROOT / "target/debug"]
        found = next((folder for folder in folders if (folder / "cellpos").is_file()), None)
        if found is None:
            sys.exit("no program: cargo build --release --workspace --bins")
        self.programs = found.resolve()
        self.folder = Path(tempfile.mkdtemp(prefix="cellpos-book-"))
        shutil.copytree(ROOT / "examples", self.folder / "examples")
        os.environ["PATH"] = str(self.programs) + os.pathsep + os.environ["PATH"]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        shutil.rmtree(self.folder)

    def program(self, name: str) -> Path:
        return self.programs / name

    def shell(self, line: str) -> str:
        done = subprocess.run(["bash", "-o", "pipefail", "-c", line], cwd=self.folder, capture_output=True, text=True)
        if done.returncode:
            sys.exit(f"{line}\n{done.stdout}{done.stderr}")
        return done.stdout

    def cellpos(self, line: str) -> str:
        return self.shell(f"cellpos {line}")

    def latest(self, name: str) -> Path:
        return sorted(self.folder.glob(f"runs/*-{name}"))[-1]

    def column(self, run: str, *names: str, more: str = "") -> list[list[float]]:
        """The time and columns of a run, empty cells as not-a-number."""
        self.cellpos(f"export latest-{run} --format csv --out out.csv --columns time_s,{','.join(names)} {more} --force")
        with open(self.folder / "out.csv", newline="") as file:
            rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
        return [[float(row[name]) if row[name] else float("nan") for row in rows] for name in ("time_s", *names)]
