"""The snippets of docs/python.md run, in their order, as one program; the module is typed."""

import builtins
import importlib.util
import json
import re
import shutil
import subprocess
import sys

import pytest
from conftest import ROOT


def blocks(page: str):
    return re.findall(r"```python( pandas)?\n(.*?)```", (ROOT / page).read_text(), re.S)


def test_the_snippets_of_the_page_run(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib", reason="the page plots")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    found = blocks("docs/python.md")
    assert len(found) >= 6
    space = {"open": builtins.open}
    for needs_pandas, code in found:
        if needs_pandas and importlib.util.find_spec("pandas") is None:
            continue
        exec(compile(code, "docs/python.md", "exec"), space)
    assert (tmp_path / "hold.png").stat().st_size > 5000


def test_the_page_plots_in_ten_lines():
    first = blocks("docs/python.md")[0][1]
    assert len([line for line in first.splitlines() if line.strip()]) <= 10


def test_the_module_is_typed():
    pytest.importorskip("mypy")
    words = [sys.executable, "-m", "mypy", "--config-file", ROOT / "python/pyproject.toml", "--cache-dir", ROOT / "target/mypy"]
    done = subprocess.run([*words, ROOT / "python/src/cellpos"], cwd=ROOT / "python", capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_the_notebook_runs(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib", reason="the notebook plots")
    (tmp_path / "python").mkdir()
    shutil.copytree(ROOT / "examples/scripts", tmp_path / "scripts")
    monkeypatch.chdir(tmp_path / "python")
    monkeypatch.setenv("MPLBACKEND", "Agg")
    cells = json.loads((ROOT / "examples/python/run.ipynb").read_text())["cells"]
    space: dict = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), "run.ipynb", "exec"), space)
    # Eq. (6) has 428 /s below its pair; the camera's path is 2 ms, and frames wait for their ticks as clocks drift.
    assert abs(space["delay"]["value"] - 2.0) < 0.2
    assert abs(space["gain"]["value"] - 428) < 10
