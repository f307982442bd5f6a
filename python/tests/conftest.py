"""Runs that the tests look at, made once by the program itself."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
try:
    import cellpos
except ImportError:
    sys.path.insert(0, str(ROOT / "python/src"))
    import cellpos

# What a shell starts in the background ignores Ctrl-C, and so would the programs that the tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

LONG = """name = "long"
[[step]]
do = "sine"
amplitude = "1um"
frequency = "20Hz"
cycles = 1200
"""


def kept_for(good: np.ndarray, ticks: int) -> np.ndarray:
    """Ticks that end a stretch of more than so many good ones."""
    last = np.where(good, -1, np.arange(len(good)))
    return np.arange(len(good)) - np.maximum.accumulate(last) > ticks


def started(folder: Path, *words: str) -> None:
    done = subprocess.run([cellpos.program(), *map(str, words)], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="session")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with runs: `hold` (pictures), `long` (killed and resumed)."""
    folder = tmp_path_factory.mktemp("lab")
    hold = "track --target 1um --duration 4s --clock virtual --ideal --seed 7 --name hold"
    started(folder, *hold.split())
    (folder / "long.toml").write_text(LONG)
    words = [cellpos.program(), "run", "long.toml", "--clock", "virtual", "--frames", "off"]
    first = subprocess.Popen(words, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while first.poll() is None:
        tables = list((folder / "runs").glob("*-long/cycles.csv"))
        if tables and tables[0].read_bytes().count(b"\n") > 200:
            first.kill()
            first.wait()
            break
        time.sleep(0.002)
    long = next((folder / "runs").glob("*-long"))
    subprocess.run([cellpos.program(), "run", "--resume", long], cwd=folder, stdout=subprocess.DEVNULL, check=False)
    return folder


@pytest.fixture
def here(lab: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(lab)
    os.environ.setdefault("MPLBACKEND", "Agg")
    return lab
