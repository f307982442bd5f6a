#!/usr/bin/env python3
"""Pages as a browser lays them out, 1400 and 400 px wide, on a light and on a dark screen.

    scripts/check_pages.py PICTURES PAGE.html...
    scripts/check_pages.py PICTURES target/debug/cellpos    # of pages that it makes: a page of each kind
    scripts/check_pages.py - target/debug/cellpos           # the same without pictures: much faster

Says which page does not show on the first screen what was done, what came out and how sure it is, which figure has no caption or cannot be taken along, what of a figure's text is cut off, lies upon another text or cannot be read against its ground, which name stands twice in one
legend, and what makes a page wider than its window; writes a picture of each into the folder PICTURES, to be looked at. Needs
Chromium. Exit code 1: something was found.
"""

import html
import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

WIDTHS = (1400, 400)
SCREENS = ("light", "dark")

# Runs in the page: what is seen of each figure, as the browser has placed it.
LOOK = r"""
<script>
addEventListener("load", () => {
  const found = [];
  const wide = document.documentElement.scrollWidth - innerWidth;
  if (wide > 0) {
    const least = [...document.querySelectorAll("body *")].filter(e => !e.closest(".scroll,pre") && e.getBoundingClientRect().right > innerWidth + 0.5);
    found.push(`the page is ${wide} px wider than its window: ${least.slice(0, 3).map(e => e.tagName + " " + e.textContent.slice(0, 40)).join("; ")}`);
  }
  // A reader of the first screen knows what was done and what came out: a sentence, and the beginning of a figure.
  const seen = [...document.querySelectorAll("p.result")].filter(e => e.getBoundingClientRect().bottom <= 850);
  if (!seen.length) found.push("the first screen has no result");
  const sure = [...document.querySelectorAll("p.sure")].filter(e => e.getBoundingClientRect().bottom <= 850);
  if (innerWidth > 1000 && !sure.length) found.push("the first screen does not say how sure the result is");
  const done = [...document.querySelectorAll("p.lead")].filter(e => e.getBoundingClientRect().bottom <= 400 && e.textContent.length > 10);
  if (!done.length) found.push("the first screen does not say what was done");
  const first = [...document.querySelectorAll("figure")].find(e => e.getBoundingClientRect().width)?.getBoundingClientRect();
  if (innerWidth > 1000 && !(first?.top <= 450)) found.push("the first screen has no figure");
  for (const figure of document.querySelectorAll("figure")) {
    const caption = figure.querySelector("figcaption")?.firstChild?.textContent.trim() ?? "";
    if (caption.length < 20) found.push(`a figure has the caption "${caption}"`);
    if (figure.querySelector("svg") && figure.querySelectorAll("a[download]").length < 3) found.push(`a figure cannot be taken along: ${caption.slice(0, 40)}`);
  }
  const names = [...document.querySelectorAll("figure a[download]")].map(a => a.download);
  names.filter((n, i) => names.indexOf(n) < i).forEach(n => found.push(`the figure ${n} stands twice`));
  if (innerWidth > 1000) for (const table of document.querySelectorAll(".scroll")) {
    if (table.scrollWidth > table.clientWidth + 1) found.push(`a table is wider than the page: ${table.textContent.trim().slice(0, 40)}`);
  }
  const unset = [...document.querySelectorAll("p, th, td, li, figcaption, text")].filter(e => !e.closest("pre") && /(^|[\s(])um([\s)/]|$)/.test(e.textContent) && !e.querySelector("p, th, td, li"));
  unset.slice(0, 3).forEach(e => found.push(`um for µm: ${e.textContent.trim().slice(0, 60)}`));
  const light = c => { const p = c.match(/[\d.]+/g).map(Number).slice(0, 3).map(v => v / 255).map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * p[0] + 0.7152 * p[1] + 0.0722 * p[2]; };
  const contrast = (a, b) => (Math.max(light(a), light(b)) + 0.05) / (Math.min(light(a), light(b)) + 0.05);
  let ground = getComputedStyle(document.body).backgroundColor;
  if (/, 0\)$/.test(ground)) ground = "rgb(255, 255, 255)";
  for (const svg of document.querySelectorAll("svg")) {
    const frame = svg.getBoundingClientRect();
    if (!frame.width) continue;
    const name = svg.querySelector("title")?.textContent ?? svg.getAttribute("aria-label") ?? "figure";
    const texts = [...svg.querySelectorAll("text")].filter(t => t.textContent.trim());
    const boxes = texts.map(t => [t, t.getBoundingClientRect()]);
    for (const [t, b] of boxes) {
      if (/\u2026|\.\.\.$/.test(t.textContent)) found.push(`${name}: "${t.textContent}" is shortened`);
      if (b.left < frame.left - 1 || b.right > frame.right + 1 || b.top < frame.top - 1 || b.bottom > frame.bottom + 1)
        found.push(`${name}: "${t.textContent}" is cut off`);
      // Its ground is the last area drawn before it and below its middle.
      const [x, y] = [(b.left + b.right) / 2, (b.top + b.bottom) / 2];
      const below = [...svg.querySelectorAll("rect")].filter(r => {
        const box = r.getBoundingClientRect();
        return r.compareDocumentPosition(t) & Node.DOCUMENT_POSITION_FOLLOWING && box.left <= x && x <= box.right && box.top <= y && y <= box.bottom
          && /^rgb\(/.test(getComputedStyle(r).fill) && +getComputedStyle(r).fillOpacity === 1;
      }).pop();
      const [ink, under] = [getComputedStyle(t).fill, below ? getComputedStyle(below).fill : ground];
      if (/^rgb\(/.test(ink) && contrast(ink, under) < 3) found.push(`${name}: "${t.textContent}" is ${ink} on ${under}`);
    }
    boxes.forEach(([t, a], i) => boxes.slice(i + 1).forEach(([u, b]) => {
      const across = Math.min(a.right, b.right) - Math.max(a.left, b.left), down = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
      if (across > 2 && down > 0.3 * Math.min(a.height, b.height)) found.push(`${name}: "${t.textContent}" lies upon "${u.textContent}"`);
    }));
    // A legend's name follows its stroke.
    const names = texts.filter(t => t.previousElementSibling?.matches("line.ln, circle, rect.bnd, rect.bar")).map(t => t.textContent);
    names.filter((n, i) => names.indexOf(n) < i).forEach(n => found.push(`${name}: "${n}" stands twice in the legend`));
  }
  parent.postMessage({ height: document.documentElement.scrollHeight, found }, "*");
});
</script>
"""

# A page at every width and on every screen at once, and what is said of each.
AROUND = """<!doctype html><body style="margin:0;background:{ground}">{frames}<pre id="said" hidden></pre><script>
const said = {{}}, frames = [...document.querySelectorAll("iframe")];
addEventListener("message", e => {{ const frame = frames.find(f => f.contentWindow === e.source); frame.height = e.data.height;
  said[frame.name] = e.data; document.getElementById("said").textContent = JSON.stringify(said); }});
</script>"""
FRAME = '<iframe name="{width}-{screen}" src="{screen}.html" width="{width}" height="900" style="border:0;display:block"></iframe>'


def chromium(*words) -> str:
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if program is None:
        print("check_pages: skipped: no Chromium")
        sys.exit(0)
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--allow-file-access-from-files", "--virtual-time-budget=4000"]
    return subprocess.run([program, *flags, *words], capture_output=True, text=True, check=True, timeout=300).stdout


CLIPS = '[clips]\ncycles = [1, 2, 3, 4]\nphases = [0.0, 0.25, 0.5, 0.75]\nbefore = "20ms"\nafter = "20ms"\n'


def step(do: str, **keys: str) -> str:
    return f'[[step.step]]\ndo = "{do}"\n' + "".join(f'{key} = "{value}"\n' for key, value in keys.items())


def made(program: Path, folder: Path) -> list[Path]:
    """Pages of every kind, made on the emulated rig."""
    rig = Path(__file__).resolve().parent.parent / "examples/cell.toml"
    cycle = step("move", to="8um", duration="200ms") + step("hold", duration="400ms") + step("move", to="0um", duration="200ms")
    repeat = f'[[step]]\ndo = "repeat"\nlabel = "cyclic"\ntimes = 30\n{cycle}{step("hold", duration="400ms")}'
    (folder / "tire.toml").write_text(repeat + '[[step]]\ndo = "static"\nlike = "cyclic"\nload = "mean"\n')
    fast = "--clock virtual --frames off"
    for line in (
        f"track --target 0um --duration 12s {fast} --seed 2 --name hold",
        f"track --target 0um --sine 5um@20Hz --controller lqg --learn --duration 8s {fast} --name sine",
        f"run tire.toml --rig {rig} {fast} --name tire",
        f"run tire.toml --rig {rig} {fast} --cells 3 --name queue",
        "report latest-hold --out hold.html",
        "report latest-sine --out sine.html",
        "report latest-tire --out tire.html",
        "reconcile --model eq6 --data latest-sine latest-hold --report gap.html",
        f"identify {fast} --seed 3 --out model.toml --report identify.html",
        "design --model eq6 --delay 2.5ms --report design.html",
        "check tire.toml --report check.html",
        "circle --effort 0.2 --duration 4s --rounds 0 --frames off --clock virtual --out circle.toml --report circle.html",
        "paper --report paper.html",
    ):
        subprocess.run([program, *line.split()], cwd=folder, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    cells = [str(run) for run in sorted(folder.glob("runs/*-queue-cells/*")) if (run / "run.toml").exists()]
    subprocess.run([program, "report", *cells, "--out", "comparison.html"], cwd=folder, check=True, stdout=subprocess.DEVNULL)
    # The montage is of the camera's pictures, which there are only in real time; a busy machine may be late as often as it likes.
    (folder / "film.toml").write_text(CLIPS + repeat.replace("times = 30", "times = 4"))
    (folder / "patient.toml").write_text("first_neutral_um = 20.0\n" + rig.read_text() + "\n[timing]\nfaults_in_a_row = 100000\n")
    film = "run film.toml --rig patient.toml --clock real --best-effort --name film"
    subprocess.run([program, *film.split()], cwd=folder, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    line = [program, "report", "latest-film", "--out", "film.html"]
    subprocess.run(line, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    return [*sorted(folder.glob("*.html")), *folder.glob("runs/*/cells.html")]


def main() -> None:
    pictures, given = Path(sys.argv[1]), [Path(word).resolve() for word in sys.argv[2:]]
    with tempfile.TemporaryDirectory() as folder:
        look(None if sys.argv[1] == "-" else pictures, given if given[0].suffix == ".html" else made(given[0], Path(folder)))


def around(folder: Path, frames: list[tuple[int, str]]) -> str:
    """Address of a page with the given frames."""
    ground = "#111" if frames[0][1] == "dark" else "#fff"
    shown = "".join(FRAME.format(width=width, screen=screen) for width, screen in frames)
    path = folder / "around.html"
    path.write_text(AROUND.format(frames=shown, ground=ground))
    return path.as_uri()


def look(pictures: Path | None, pages: list[Path]) -> None:
    bad = 0
    frames = [(width, screen) for screen in SCREENS for width in WIDTHS]
    for page in pages:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            for screen in SCREENS:
                # The browser follows this machine's screen: the page is shown as if its question had been answered.
                answer = "all" if screen == "dark" else "not all"
                text, times = re.subn(r"\(prefers-color-scheme:\s*dark\)", answer, page.read_text())
                assert times, f"{page} knows no dark screen"
                (folder / f"{screen}.html").write_text(text.replace("</head>", LOOK + "</head>", 1))
            dom = chromium(f"--window-size={max(WIDTHS)},900", "--dump-dom", around(folder, frames))
            said = json.loads(html.unescape(re.search(r'<pre id="said"[^>]*>(.*?)</pre>', dom, re.S)[1]))
            for width, screen in frames:
                one = said[f"{width}-{screen}"]
                for what in one["found"]:
                    print(f"{page}, {width} px, {screen}: {what}")
                bad += len(one["found"])
                if pictures is not None:
                    pictures.mkdir(parents=True, exist_ok=True)
                    picture = (pictures / f"{page.resolve().parent.name}-{page.stem}-{width}-{screen}.png").resolve()
                    size = f"--window-size={max(width, 500)},{one['height']}"
                    chromium(size, f"--screenshot={picture}", around(folder, [(width, screen)]))
    print(f"{len(pages)} pages at {WIDTHS} px, light and dark: {bad} findings")
    sys.exit(bad > 0)


if __name__ == "__main__":
    main()
