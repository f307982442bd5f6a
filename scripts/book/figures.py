"""Every figure of the book and of the README, written into docs/images by commands.

    scripts/book-figures                    # all of them, some minutes
    scripts/book-figures hold identify      # some groups
    scripts/book-figures --list             # which group makes which file

Needs the built programs (target/release, else target/debug, or CELLPOS_BIN). Screenshots need chromium and chromium-driver; the moving picture needs
Pillow; the case studies need the measured records in ../shared/data. A group whose needs are not met is skipped, with the reason.
"""

import io
import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import drawings
import plot
from bench import DATA, ROOT, Bench, Skip
from browser import Browser

IMAGES = ROOT / "docs/images"


def keep(name: str, content: str | bytes):
    IMAGES.mkdir(exist_ok=True)
    (IMAGES / name).write_bytes(content.encode() if isinstance(content, str) else content)
    print(f"docs/images/{name}: {(IMAGES / name).stat().st_size / 1000:.0f} kB", flush=True)


def lighter(svg: str) -> str:
    """Coordinates to a tenth of a pixel: a third of the bytes, nothing to be seen. Texts, such as the numbers at the axes, stay."""
    return re.sub(r"<[^>]+>", lambda tag: re.sub(r"(\d+\.\d)\d+", r"\1", tag.group(0)), svg)


def copy(path: Path, name: str):
    keep(name, lighter(path.read_text()))


def of_page(page: Path, title: str, name: str):
    """A figure out of a report that holds its figures inline."""
    text = page.read_text()
    rules = re.findall(r"@media \(prefers[^{]*\{(?:[^{}]*\{[^}]*\})*\}|\.fg[^{}]*\{[^}]*\}", re.search(r"<style>(.*?)</style>", text, re.S).group(1))
    figure, depth, begin = "", 0, 0
    for tag in re.finditer(r"<svg\b|</svg>", text):
        begin = tag.start() if depth == 0 else begin
        depth += 1 if tag.group(0) == "<svg" else -1
        if depth == 0 and title in text[begin : tag.end()]:
            figure = text[begin : tag.end()]
            break
    else:
        sys.exit(f"{page.name} has no figure with '{title}': {name} stays as it was")
    if "xmlns" not in figure.split(">")[0]:
        figure = figure.replace("<svg", '<svg xmlns="http://www.w3.org/2000/svg"', 1)
    if "<style>" not in figure:
        figure = figure.replace(">", "><style>" + "".join(rule for rule in rules if ".fg" in rule) + "</style>", 1)
    keep(name, lighter(figure))


def screen(page: Path, name: str, width: int, height: int):
    with Browser(width, height) as browser:
        browser.open(page.resolve().as_uri())
        time.sleep(1)
        keep(name, browser.screenshot())


def draw(_bench: Bench):
    for name, drawing in drawings.ALL.items():
        keep(f"{name}.svg", drawing())


def hold(bench: Bench):
    bench.cellpos("track --target 0um --duration 10s --clock virtual --seed 7 --name hold")
    bench.cellpos("report latest-hold")
    folder = bench.latest("hold") / "report-figures"
    copy(folder / "excerpt.svg", "hold-excerpt.svg")
    copy(folder / "error-spectrum.svg", "hold-spectrum.svg")
    screen(bench.latest("hold") / "report.html", "report-page.png", 1000, 1500)


def sine(bench: Bench):
    curves = []
    for law, more in (("pi", ""), ("lqg", "--learn")):
        bench.cellpos(f"track --target 0um --sine 5um@50Hz --controller {law} {more} --duration 3s --clock virtual --seed 3 --frames off --name sine-{law}")
        at, target, bead = bench.column(f"sine-{law}", "target_um", "true_um", more="--from 2.9s --to 2.98s")
        if not curves:
            curves.append(("reference", at, target, True))
        curves.append((law.upper() + (" with learning" if more else ""), at, bead, False))
    keep("sine.svg", plot.lines("A sine of 5 um at 50 Hz", [{"y": "position, um", "curves": curves}], "time, s", panel_height=240))


def steps(bench: Bench):
    curves = []
    for law in ("pi", "lead", "lqg", "mpc"):
        bench.cellpos(f"track --target 10um --controller {law} --duration 2s --clock virtual --seed 3 --frames off --name step-{law}")
        at, target, bead = bench.column(f"step-{law}", "target_um", "true_um")
        jump = next(k for k, um in enumerate(bead) if um > 4.0) - 2
        rows = slice(max(0, jump - 10), jump + 80)
        ms = [1000 * (t - at[jump]) for t in at[rows]]
        if not curves:
            curves.append(("reference", ms, target[rows], True))
        curves.append((law, ms, bead[rows], False))
    keep("steps.svg", plot.lines("A step of 10 um with the four controllers", [{"y": "position, um", "curves": curves}], "time, ms", panel_height=240))


def adapt(bench: Bench):
    plant = '[plant]\nnum = [0.01123, 227.577, 19600.3]\nden = [1.0, 76.3, 0.13]\n'
    (bench.folder / "weak.toml").write_text('name = "a clogged channel"\nworking_point_um = 20.0\n' + plant)
    (bench.folder / "weak-rig.toml").write_text('[emulator]\nmodel = "weak.toml"\n')
    bench.cellpos("track --target 0um --rig weak-rig.toml --controller lqg --duration 12s --clock virtual --seed 4 --frames off --name adapt")
    at, gain, sd, force, bead = bench.column("adapt", "adapt_gain_estimate", "adapt_gain_sd", "adapt_gain", "true_um", more="--every 10")
    good = [k for k in range(len(at)) if gain[k] == gain[k] and sd[k] < 0.5]
    take = lambda xs: [xs[k] for k in good]
    panels = [{"y": "gain over the model's", "low": 0.3, "high": 1.3,
               "curves": [("estimate", take(at), take(gain), False), ("+- 2 sd", take(at), [gain[k] + 2 * sd[k] for k in good], True), ("in force", at, force, False), ("truth", [at[0], at[-1]], [0.6, 0.6], True)]},
              {"y": "position, um", "curves": [("true position", at, bead, False)]}]
    keep("adaptation.svg", plot.lines("A plant with 0.6 of the model's gain", panels, "time, s", panel_height=160))


def identify(bench: Bench):
    bench.cellpos("identify --clock virtual --seed 3 --out model.toml --report identify.html --force")
    folder = bench.folder / "identify-figures"
    copy(folder / "bode.svg", "identify-bode.svg")
    copy(folder / "nyquist.svg", "identify-nyquist.svg")
    copy(folder / "residuals.svg", "identify-residuals.svg")


def script(bench: Bench):
    bench.cellpos("check examples/scripts/staircase.toml --report check.html --force")
    copy(bench.folder / "check-figures/reference.svg", "check-reference.svg")
    bench.cellpos("run examples/scripts/staircase.toml --dry --frames off --name staircase")
    bench.cellpos("report latest-staircase")
    copy(bench.latest("staircase") / "report-figures/cycles.svg", "staircase-cycles.svg")


def fatigue(bench: Bench):
    bench.cellpos("run examples/scripts/fatigue.toml --rig examples/cell.toml --clock virtual --frames off --name fatigue")
    bench.cellpos("report latest-fatigue")
    folder = bench.latest("fatigue") / "report-figures"
    for name in ("fatigue", "cycles-over-each-other", "length"):
        copy(folder / f"{name}.svg", f"{'fatigue-trend' if name == 'fatigue' else 'fatigue-' + name}.svg")


def paper(bench: Bench):
    bench.cellpos("paper --report paper.html --force")
    for name in ("fig7-bode", "fig5b-amplitude", "fig-a1-complex-plane"):
        copy(bench.folder / f"paper-figures/{name}.svg", f"paper-{name}.svg")


def circle(bench: Bench):
    bench.cellpos("circle --hidden examples/hidden.toml --controller lqg --frames off --effort 0.5 --duration 4s --report circle.html --force")
    copy(bench.folder / "circle-figures/responses.svg", "circle-responses.svg")
    copy(bench.folder / "circle-figures/tracking-errors.svg", "circle-errors.svg")


def cases(bench: Bench):
    if not DATA.is_dir():
        raise Skip("the measured records are not in ../shared/data")
    piezo, box = DATA / "piezo-picma", DATA / "measured/silverbox"
    bench.cellpos(f"reconcile --model fit --data {piezo}/Model_Vi_Do.dat {piezo}/Test_Vi_Do_Di.dat --rows 0:5051 --input-column 1 --output-column 5 "
                  "--rate 200Hz --out piezo.toml --report piezo.html --force")
    of_page(bench.folder / "piezo.html", "by frequency band", "piezo-bands.svg")
    of_page(bench.folder / "piezo.html", "Test_Vi_Do_Di: position", "piezo-residual.svg")
    bench.cellpos(f"identify --data {box}/sb_ms10.csv --input V1 --output V2 --rate 610.35Hz --order 2 --hold none --out base.toml --force")
    records = " ".join(str(box / f"{name}.csv") for name in ("sb_sch", "sb_sch2", "sb_ms10"))
    bench.cellpos(f"reconcile --model base.toml --data {records} --input-column V1 --output-column V2 --rate 610.35Hz --rows 0:3000 --max-effects 1 "
                  "--out augmented.toml --report unknown.html --force")
    bench.cellpos(f"reconcile --model base.toml --data {records} --input-column V1 --output-column V2 --rate 610.35Hz --rows 0:3000 --max-effects 1 "
                  "--effects augmented.effects.toml --out named.toml --report named.html --force")
    of_page(bench.folder / "unknown.html", "by frequency band", "silverbox-unknown.svg")
    of_page(bench.folder / "named.html", "by frequency band", "silverbox-named.svg")


def vision(bench: Bench):
    if not DATA.is_dir():
        raise Skip("the recordings are not in ../shared/data")
    bench.cellpos(f"vision {DATA}/beads-brightfield --out beads")
    try:
        from PIL import Image
    except ImportError as error:
        raise Skip("the contact sheet needs Pillow: pip install pillow") from error
    sheet = Image.open(bench.folder / "beads/sheet.png").convert("RGB")
    # Its first two frames: small enough for the repository, large enough to see the marks.
    first = sheet.crop((0, 0, 2 * sheet.width // 3, min(sheet.height, sheet.width // 3)))
    keep("contact-sheet.png", png(first.resize((900, 900 * first.height // first.width), Image.LANCZOS)))


def proof(_bench: Bench):
    """The README's figure, from the figures that scripts/book-measure has written; that command draws it, too."""
    keep("proof.svg", plot.proof(json.loads((ROOT / "docs/measurements.json").read_text())["figures"]))


def live(bench: Bench):
    """A bead that is held, stepped and frozen, on the live page: stills and the moving picture of the README."""
    try:
        from PIL import Image
    except ImportError as error:
        raise Skip("the moving picture needs Pillow: pip install pillow") from error
    if not shutil.which("chromedriver"):
        raise Skip("screenshots need chromium and chromium-driver")
    with Browser(1180, 980) as browser:
        browser.open("about:blank")
        run = subprocess.Popen(["cellpos", "track", "--target", "0um", "--view", "--name", "live", "--duration", "120s"], cwd=bench.folder, stderr=subprocess.PIPE,
                               stdout=subprocess.DEVNULL, text=True)
        link = next(found.group(0) for found in (re.search(r"http://\S+", line) for line in run.stderr) if found)
        browser.open(link)
        browser.wait_for("return document.body.dataset.state === 'running'")
        go = lambda um: browser.run(f"const t = document.getElementById('target'); t.value = '{um}'; t.form.requestSubmit();")
        press = lambda name: browser.run(f"document.getElementById('{name}').click()")
        time.sleep(3)
        # By pictures and not by the clock, so that a slow browser shows every act.
        acts = [(lambda: None, 4), (lambda: go(6), 5), (lambda: go(-4), 5), (lambda: press("freeze"), 4), (lambda: press("resume"), 3), (lambda: go(0), 4)]
        pictures = []
        for act, count in acts:
            act()
            time.sleep(0.2)
            pictures += [Image.open(io.BytesIO(browser.screenshot())).convert("RGB") for _ in range(count)]
        run.terminate()
        run.wait()
    keep("live-page.png", png(pictures[7]))
    keep("live-frozen.png", png(pictures[16]))
    small = [picture.resize((820, 820 * picture.height // picture.width), Image.LANCZOS) for picture in pictures]
    for quality in (60, 40, 25, 15):
        film = io.BytesIO()
        small[0].save(film, "WEBP", save_all=True, append_images=small[1:], duration=350, loop=0, quality=quality, method=4)
        if film.tell() < 1_900_000:
            break
    print(f"{len(small)} pictures, quality {quality}")
    keep("live.webp", film.getvalue())


def png(picture) -> bytes:
    """A screenshot in 64 colours: a quarter of the bytes."""
    out = io.BytesIO()
    picture.quantize(64).save(out, "PNG", optimize=True)
    return out.getvalue()


def tui(bench: Bench):
    if not shutil.which("tmux"):
        raise Skip("the terminal's picture needs tmux")
    if not shutil.which("chromedriver"):
        raise Skip("screenshots need chromium and chromium-driver")
    tmux = ["tmux", "-L", "cellpos-book"]
    subprocess.run([*tmux, "new-session", "-d", "-x", "110", "-y", "34", f"cd {bench.folder} && cellpos track --target 2um --tui --duration 30s"], check=True)
    time.sleep(14)
    text = subprocess.run([*tmux, "capture-pane", "-p", "-t", "0"], capture_output=True, text=True).stdout
    subprocess.run([*tmux, "kill-server"])
    lines = "".join(f'<text x="12" y="{22 + 17 * n}" xml:space="preserve">{drawings.escape(line)}</text>' for n, line in enumerate(text.rstrip().splitlines()))
    rows = len(text.rstrip().splitlines())
    keep("terminal.svg", f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1000 {17 * rows + 24}" width="1000" height="{17 * rows + 24}"><title>The run on the terminal</title>'
         f'<rect width="1000" height="{17 * rows + 24}" rx="8" fill="#14171b"/><g font-family="\'DejaVu Sans Mono\',Menlo,Consolas,monospace" font-size="14" fill="#e4e7eb">{lines}</g></svg>')


GROUPS = {
    "draw": (draw, [f"{name}.svg" for name in drawings.ALL]),
    "hold": (hold, ["hold-excerpt.svg", "hold-spectrum.svg", "report-page.png"]),
    "sine": (sine, ["sine.svg"]),
    "steps": (steps, ["steps.svg"]),
    "adapt": (adapt, ["adaptation.svg"]),
    "identify": (identify, ["identify-bode.svg", "identify-nyquist.svg", "identify-residuals.svg"]),
    "script": (script, ["check-reference.svg", "staircase-cycles.svg"]),
    "fatigue": (fatigue, ["fatigue-trend.svg", "fatigue-cycles-over-each-other.svg", "fatigue-length.svg"]),
    "paper": (paper, ["paper-fig7-bode.svg", "paper-fig5b-amplitude.svg", "paper-fig-a1-complex-plane.svg"]),
    "circle": (circle, ["circle-responses.svg", "circle-errors.svg"]),
    "cases": (cases, ["piezo-bands.svg", "piezo-residual.svg", "silverbox-unknown.svg", "silverbox-named.svg"]),
    "vision": (vision, ["contact-sheet.png"]),
    "proof": (proof, ["proof.svg"]),
    "live": (live, ["live-page.png", "live-frozen.png", "live.webp"]),
    "tui": (tui, ["terminal.svg"]),
}


def main(words: list[str]):
    if "--list" in words:
        for name, (_, files) in GROUPS.items():
            print(f"{name}: {' '.join(files)}")
        return
    unknown = [word for word in words if word not in GROUPS]
    if unknown:
        sys.exit(f"no group {', '.join(unknown)}; there are {', '.join(GROUPS)}")
    with Bench() as bench:
        for name in words or GROUPS:
            try:
                GROUPS[name][0](bench)
            except Skip as why:
                print(f"{name}: skipped: {why}")


main(sys.argv[1:])
