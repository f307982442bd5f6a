"""Every figure that the project claims, measured: docs/measurements.json, docs/measurements.md, the README's table, the README's figure, outputs shown on pages.

    scripts/book-measure                # all, some minutes
    scripts/book-measure hold vision    # some groups; the others keep their figures and dates
    scripts/book-measure --write        # writes the pages again from docs/measurements.json, without measuring

Closed loops run on the virtual clock: a seed fixes every bit, so the figures do not depend on the machine. Times do, and say on which.
"""

import csv
import datetime
import json
import os
import platform
import re
import statistics
import subprocess
import sys
from pathlib import Path

import plot
from bench import DATA, ROOT, Bench, Skip

FILE = ROOT / "docs/measurements.json"
SEEDS = range(1, 6)


def shown(value: float, unit: str, digits: int) -> str:
    return f"{value:.{digits}f} {unit}".strip()


class Figures:
    """What was measured, by id."""

    def __init__(self, program: str):
        self.program = program
        self.all = {entry["id"]: entry for entry in json.loads(FILE.read_text())["figures"]} if FILE.is_file() else {}

    def put(self, name: str, what: str, value: float, unit: str, digits: int, command: str, text: str | None = None):
        today = datetime.datetime.now(datetime.timezone.utc).date().isoformat()
        self.all[name] = {"id": name, "what": what, "value": round(value, digits + 2), "shown": text or shown(value, unit, digits), "command": command, "date": today, "program": self.program}
        print(f"{name}: {self.all[name]['shown']}", flush=True)

    def save(self):
        FILE.write_text(json.dumps({"figures": list(self.all.values())}, indent=1, ensure_ascii=False) + "\n")


def track(bench: Bench, more: str, seeds=SEEDS) -> list[dict]:
    return [json.loads(bench.cellpos(f"track {more} --clock virtual --seed {seed} --no-record --json")) for seed in seeds]


def mean(runs: list[dict], key: str) -> float:
    return statistics.fmean(run[key] for run in runs)


def hold(bench: Bench, figures: Figures):
    for law in ("pi", "lead", "lqg", "mpc"):
        line = f"--target 0um --controller {law} --duration 20s"
        runs = track(bench, line)
        figures.put(f"hold.{law}", f"{law}, with pictures: true RMS error", mean(runs, "rms_true_nm"), "nm", 1, "cellpos track --target 0um --controller LAW --duration 20s --clock virtual, seeds 1 to 5")
    figures.put("hold.bound", "lowest possible (Brownian motion, 2.5 ms of delay)", mean(runs, "bound_rms_nm"), "nm", 1, "cellpos track --target 0um --controller LAW --duration 20s --clock virtual, seeds 1 to 5")


def sine(bench: Bench, figures: Figures):
    for name, law in (("pi", "--controller pi"), ("lqg", "--controller lqg"), ("pi-learned", "--controller pi --learn"), ("learned", "--controller lqg --learn")):
        line = f"--target 0um --sine 5um@50Hz {law} --duration 6s --frames off"
        runs = track(bench, line)
        figures.put(f"sine.{name}", f"{law.removeprefix('--controller ').replace(' --', ', ')}: RMS error", mean(runs, "rms_true_nm"), "nm", 1,
                    "cellpos track --target 0um --sine 5um@50Hz --controller LAW --duration 6s --frames off --clock virtual, seeds 1 to 5")


def adapt(bench: Bench, figures: Figures):
    """A plant whose gain is not the model's."""
    for factor in (0.5, 2.0):
        num = [0.01872 * factor, 379.29528 * factor, 32667.16752 * factor]
        (bench.folder / "other.toml").write_text(f'name = "other gain"\nworking_point_um = 20.0\n[plant]\nnum = {num}\nden = [1.0, 76.3, 0.13]\n')
        (bench.folder / "other-rig.toml").write_text('[emulator]\nmodel = "other.toml"\n')
        for state in ("on", "off"):
            runs = track(bench, f"--target 0um --rig other-rig.toml --controller lqg --adapt {state} --duration 20s --frames off")
            figures.put(f"adapt.{factor:g}-{state}", f"hold on a plant of {factor:g} times the model's gain, adaptation {state}", mean(runs, "rms_true_nm"), "nm", 1,
                        "cellpos track --controller lqg --adapt STATE --rig other-rig.toml, 20 s, seeds 1 to 5")


def cell(bench: Bench, figures: Figures):
    command = "run examples/scripts/fatigue.toml --rig examples/cell.toml --clock virtual --frames off --name fatigue"
    bench.cellpos(command)
    with open(bench.latest("fatigue") / "cycles.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["arm"] == "cyclic"]
    first = float(rows[0]["length_start_um"])
    stretch = [float(row["length_peak_um"]) / first for row in rows]
    recovery = [float(row["recovery_s"]) for row in rows if row["recovery_s"]]
    for name, values, hidden, unit, digits in (("stretch", stretch, "3.80 to 2.86", "", 2), ("recovery", recovery, "0.16 to 0.37 s", "s", 3)):
        text = f"{values[0]:.{digits}f} to {values[-1]:.{digits}f} {unit}".strip()
        figures.put(f"cell.{name}", f"{name}, first to last of 180 passages (hidden: {hidden})", values[-1], unit, digits, f"cellpos {command}", text)


def identify(bench: Bench, figures: Figures):
    found = [json.loads(bench.cellpos(f"identify --clock virtual --ideal --frames off --seed {seed} --out model.toml --force --json")) for seed in SEEDS]
    for key, label, unit, digits, truth in (("gain_per_s", "gain", "1/s", 1, None), ("delay_ms", "camera delay", "ms", 3, 2.0)):
        values = [run["parameters"][key]["value"] for run in found]
        more = f" (hidden: {truth})" if truth else ""
        figures.put(f"identify.{key}", f"{label}, mean{more}", statistics.fmean(values), unit, digits, "cellpos identify --clock virtual --ideal --frames off, seeds 1 to 5")


def reconcile(bench: Bench, figures: Figures):
    line = "circle --hidden examples/hidden.toml --controller lqg --frames off --effort 0.5 --duration 4s"
    found = json.loads(bench.cellpos(f"{line} --out augmented.toml --force --json"))
    effect = next(e for e in walk(found, "effects") if e["id"] == "driver-lag")
    number = effect["parameters"]["bandwidth_hz"]
    low, high = number["ci95"]
    figures.put("reconcile.driver-lag", "bandwidth of an amplifier (hidden: 80 Hz), 95 % interval", number["value"], "Hz", 1, f"cellpos {line}", f"{number['value']:.1f} Hz ({low:.1f} to {high:.1f})")
    if not DATA.is_dir():
        raise Skip("the measured records are not in ../shared/data")
    piezo = DATA / "piezo-picma"
    result = json.loads(bench.cellpos(f"reconcile --model fit --data {piezo}/Model_Vi_Do.dat {piezo}/Test_Vi_Do_Di.dat --rows 0:5051 --input-column 1 --output-column 5 --rate 200Hz --json"))
    gap = result["gap"]
    figures.put("reconcile.piezo", "error on held-out records, before and after", gap["free_run_after"], "um", 2,
                "cellpos reconcile, see [the case study](case-piezo.md)", f"{gap['free_run_before']:.2f} µm, {gap['free_run_after']:.2f} µm")


def labelled(bench: Bench, figures: Figures):
    """Records of another simulator, each with one or two hidden effects or none."""
    if not DATA.is_dir():
        raise Skip("the measured records are not in ../shared/data")
    named = 0
    cases = sorted(path for path in (DATA / "hidden-effects").iterdir() if path.is_dir())
    (bench.folder / "four.toml").write_text('name = "four"\nworking_point_um = 4.0\n[plant]\nnum = [0.01872, 379.29528, 32667.16752]\nden = [1.0, 76.3, 0.13]\n'
                                            "[noise]\ndiffusion_um2_per_s = 0.33\nlocalisation_um = 0.03\n")
    for case in cases:
        result = json.loads(bench.cellpos(f"reconcile --model four.toml --data {case} --json"))
        names = sorted(effect["id"] for effect in result["effects"])
        hidden = [] if case.name.startswith("none") else sorted(case.name.split("+"))
        named += names == hidden
        print(f"    {case.name}: {result['verdict']} {names}", flush=True)
    figures.put("reconcile.labelled", "labelled records of another simulator with exactly the hidden effects named", named, "", 0,
                "cellpos reconcile, one run per case", f"{named} of {len(cases)}")


def walk(value, key: str):
    """Every element of every list of that name, however deep."""
    if isinstance(value, dict):
        for name, inner in value.items():
            if name == key and isinstance(inner, list):
                yield from (entry for entry in inner if isinstance(entry, dict) and "parameters" in entry)
            yield from walk(inner, key)
    elif isinstance(value, list):
        for inner in value:
            yield from walk(inner, key)


def vision(bench: Bench, figures: Figures):
    script = ROOT / "scripts/vision-beside-trackpy.py"
    done = subprocess.run([sys.executable, script, "--cellpos", bench.program("cellpos"), "--data", DATA], capture_output=True, text=True)
    if done.returncode:
        raise Skip(f"pip install trackpy pillow tifffile ({done.stderr.strip().splitlines()[-1] if done.stderr else 'no reason'})")
    for line in done.stdout.splitlines()[2:]:
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) < 6 or not cells[2]:
            continue
        frames, program, recall, error = cells[0], cells[1].split()[0], cells[2], float(cells[3])
        short = {"rendered, SNR 10": "", "rendered, SNR 40": "-snr40", "beads-brightfield": "-beads", "trapped-bead": "-trapped"}.get(frames)
        if short is not None:
            figures.put(f"vision.{program}{short}", f"{program}, {frames}: RMS error, recall {recall}", error, "px", 4, "scripts/vision-beside-trackpy.py")


def times(bench: Bench, figures: Figures):
    machine = f"{os.cpu_count()} virtual cores, Linux {platform.release().split('-')[0]}, {'release' if 'release' in str(bench.program('cellpos')) else 'debug'} build, load {os.getloadavg()[0]:.0f}"
    for law in ("pi", "lqg", "mpc"):
        run = json.loads(bench.cellpos(f"track --target 0um --controller {law} --duration 20s --clock virtual --frames off --no-record --json"))
        figures.put(f"time.{law}", f"computing time of a tick with {law}, median ({machine})", run["tick_us"]["p50"], "us", 1, f"cellpos track --controller {law} --clock virtual --frames off")


GROUPS = {"hold": hold, "sine": sine, "adapt": adapt, "cell": cell, "identify": identify, "reconcile": reconcile, "labelled": labelled, "vision": vision, "times": times}

LONG = [
    ("cargo run --release -p cellpos-benches --bin hold-table", "hold, steps and sines of the four laws"),
    ("cargo run --release -p cellpos-benches --bin adapt-table", "adaptation to changes of gain and delay; `--hours 10` for false alarms"),
    ("cargo run --release -p cellpos-tests --bin reconcile-table all SEED", "hundreds of drawn hidden effects, nulls and strangers"),
    ("cargo test --release -p cellpos-vision -- --nocapture", "error against the Cramér-Rao bound, cells against masks"),
    ("cargo bench -p cellpos-benches --bench solvers", "the solvers of MPC"),
]


def write(figures: Figures, bench: Bench):
    entries = list(figures.all.values())
    figures.save()
    page = ["# Measurements", "", "Every figure that the project claims. `scripts/book-measure` writes this page.", "",
            "Measured with " + ", ".join(sorted({f"{e['program']} on {e['date']}" for e in entries})) + ".", "",
            "Closed loops run on the emulated rig, on the virtual clock. See [Limits](limits.md).", ""]
    for line in dict.fromkeys(e["command"] for e in entries):
        alike = [e for e in entries if e["command"] == line]
        page += [f"**{command(line)}**", "", "| figure | what | value |", "|---|---|---|"]
        page += [f"| `{e['id']}` | {e['what']} | {e['shown']} |" for e in alike] + [""]
    page += ["## Long tables", "", "| command | shows |", "|---|---|"]
    page += [f"| `{line}` | {what} |" for line, what in LONG]
    (ROOT / "docs/measurements.md").write_text("\n".join(page) + "\n")
    (ROOT / "docs/images/proof.svg").write_text(plot.proof(entries))
    readme = ROOT / "README.md"
    text = readme.read_text()

    before, rest = text.split("<!-- measured -->\n", 1)
    table, after = rest.split("<!-- end -->", 1)
    rows = []
    for line in table.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        entry = figures.all.get(cells[0].strip("`"))
        rows.append(f"| {cells[0]} | {cells[1]} | {entry['shown']} |" if entry else line)
    readme.write_text(before + "<!-- measured -->\n" + "\n".join(rows) + "\n<!-- end -->" + after)
    for path in sorted((ROOT / "docs").glob("*.md")):
        text = path.read_text()
        new = re.sub(r"<!-- output: (.*?) -->\n```text\n.*?```", lambda m: f"<!-- output: {m.group(1)} -->\n```text\n{bench.shell(m.group(1))}```", text, flags=re.S)
        if new != text:
            path.write_text(new)


def command(text: str) -> str:
    head, comma, tail = text.partition(", ")
    return f"`{head}`{comma}{tail}"


def main(words: list[str]):
    chosen = [] if "--write" in words else (words or list(GROUPS))
    unknown = [word for word in chosen if word not in GROUPS]
    if unknown:
        sys.exit(f"no group {', '.join(unknown)}; there are {', '.join(GROUPS)}")
    with Bench() as bench:
        figures = Figures(bench.cellpos("--version").strip())
        for name in chosen:
            try:
                GROUPS[name](bench, figures)
            except Skip as why:
                print(f"{name}: skipped: {why}")
            figures.save()
        write(figures, bench)


main(sys.argv[1:])
