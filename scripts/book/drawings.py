"""The drawings of the book: parts of a rig, threads, order of events. Each function returns one SVG."""

import tomllib
from html import escape
from pathlib import Path

STYLE = """.dr{font-family:system-ui,'DejaVu Sans','Segoe UI',Helvetica,Arial,sans-serif;font-size:13px}.dr text{fill:#2b2f36}.dr .mut{fill:#5c6470;font-size:12px}
.dr .ttl{font-weight:600}.dr .bg{fill:#fff}.dr .box{fill:#eef4f9;stroke:#0072b2}.dr .alt{fill:#fdf0e6;stroke:#d55e00}.dr .grn{fill:#e8f6f1;stroke:#009e73}
.dr .gry{fill:#f1f3f6;stroke:#9aa3ae}.dr .ar{fill:none;stroke:#444b55;stroke-width:1.6;marker-end:url(#a)}.dr .ln{fill:none;stroke:#444b55;stroke-width:1.6}
.dr .dsh{stroke-dasharray:5 4}.dr .hot{fill:none;stroke:#d55e00;stroke-width:2}"""
HEAD = '<defs><marker id="a" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" orient="auto"><path d="M0 0L10 5L0 10z" fill="#444b55"/></marker></defs>'


def page(width: int, height: int, title: str, body: list[str]) -> str:
    return (f'<svg xmlns="http://www.w3.org/2000/svg" class="dr" viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img">'
            f'<title>{escape(title)}</title><style>{STYLE}</style>{HEAD}<rect class="bg" width="{width}" height="{height}"/>' + "\n".join(body) + "</svg>\n")


def box(x: float, y: float, w: float, h: float, name: str, more: str = "", kind: str = "box") -> str:
    lines = more.split("\n") if more else []
    top = y + h / 2 + 5 - 8 * len(lines)
    text = f'<text class="ttl" text-anchor="middle" x="{x + w / 2}" y="{top}">{escape(name)}</text>'
    text += "".join(f'<text class="mut" text-anchor="middle" x="{x + w / 2}" y="{top + 16 * (n + 1)}">{escape(line)}</text>' for n, line in enumerate(lines))
    return f'<rect class="{kind}" x="{x}" y="{y}" width="{w}" height="{h}" rx="6"/>{text}'


def arrow(d: str, text: str = "", x: float = 0, y: float = 0, anchor: str = "middle", dashed: bool = False) -> str:
    label = f'<text class="mut" text-anchor="{anchor}" x="{x}" y="{y}">{escape(text)}</text>' if text else ""
    return f'<path class="ar{" dsh" if dashed else ""}" d="{d}"/>{label}'


def loop() -> str:
    """The loop in one line."""
    body = [box(10, 60, 110, 56, "camera", "1000 frames/s", "grn"), box(170, 60, 110, 56, "vision", "position, sd"), box(330, 60, 120, 56, "estimator", "position, zero flow"),
            box(500, 60, 110, 56, "control law", "PI, LQG, MPC"), box(660, 60, 130, 56, "PZT board", "limits, watchdogs", "alt"), box(330, 180, 280, 50, "syringe, chip, bead", "flow moves the bead", "grn")]
    for x, w in ((120, 50), (280, 50), (450, 50), (610, 50)):
        body.append(arrow(f"M{x} 88h{w - 2}"))
    body += [arrow("M725 116V205H614", "displacement, um", 735, 165, "start"), arrow("M330 205H65V120", "light", 56, 165, "end"),
             arrow("M555 30V58", "reference: target, sine or script", 555, 22)]
    return page(860, 245, "The loop: camera, vision, estimator, control law, PZT board, bead", body)


def rig() -> str:
    """Parts of a rig."""
    body = [box(20, 180, 120, 60, "syringe", "gas-tight glass", "grn"), box(20, 90, 120, 60, "PZT stack", "moves plunger", "alt"),
            '<path class="hot" d="M80 150V180"/>', '<path class="ln" stroke-width="4" d="M140 210H270"/><text class="mut" text-anchor="middle" x="205" y="200">stiff tube</text>',
            '<rect class="gry" x="270" y="180" width="300" height="60" rx="4"/><rect fill="#cfe6f5" x="270" y="202" width="300" height="16"/><circle cx="420" cy="210" r="5" fill="#d55e00"/>'
            '<text class="ttl" text-anchor="middle" x="420" y="262">PDMS chip: channel, cell or bead</text>',
            '<path class="ln" stroke-width="4" d="M570 210H650"/>', box(650, 180, 120, 60, "outlet", "open reservoir", "gry"),
            box(360, 20, 120, 46, "lamp", "bright field", "grn"), '<path class="ln dsh" d="M420 66V180"/>', '<path class="ln dsh" d="M420 240V300"/>',
            box(360, 300, 120, 46, "objective", "20x to 60x", "grn"), '<path class="ln dsh" d="M420 346V370"/>', box(345, 370, 150, 50, "camera", "1000 frames/s, region", "grn"),
            box(560, 370, 210, 50, "computer: cellpos", "Linux, 2 cores", "box"), arrow("M495 395H556", "frames", 526, 386),
            box(20, 370, 150, 50, "PZT board", "converter, watchdogs", "alt"), arrow("M560 412C480 470 250 470 172 410", "commands, serial or USB", 370, 466),
            box(20, 280, 150, 46, "amplifier", "0 to 10 V in", "alt"), arrow("M95 370V329", "0 to 10 V", 104, 354, "start"), arrow("M20 303H8V120H18"),
            box(560, 60, 120, 46, "LED", "in the picture", "alt"), arrow("M170 388H250V130H620V108", "on, off: delay test", 262, 122, "start", True), '<path class="ln dsh" d="M560 90L480 180"/>']
    return page(800, 490, "A rig: syringe and PZT, chip, lamp, objective, camera, board, computer", body)


def threads() -> str:
    """Which thread does what."""
    lanes = [("camera thread", "frame, vision: position", "grn", "FIFO 70"), ("control thread", "one tick: estimate, law, limits", "box", "FIFO 80"),
             ("board thread", "encode, send, read reports", "alt", "FIFO 75"), ("recorder thread", "rows to disk, sync", "gry", "ordinary"), ("page threads", "live page, terminal", "gry", "ordinary")]
    body = []
    for n, (name, what, kind, policy) in enumerate(lanes):
        y = 30 + n * 78
        body.append(box(40 if n < 3 else 460, y if n < 3 else 30 + (n - 2.5) * 92, 300, 56, name, f"{what} ({policy})", kind))
    body += [arrow("M190 86V106", "ring of positions", 200, 101, "start"), arrow("M190 164V184", "ring of commands", 200, 179, "start"),
             arrow("M340 130C400 130 400 105 456 105", "ring of records", 400, 92), arrow("M340 142C400 142 400 196 456 196", "feed for display", 400, 168)]
    return page(800, 270, "Threads: each ring refuses when full, the refusal is counted, no tick waits", body)


def tick() -> str:
    """Where the delay of the loop comes from."""
    body = ['<path class="ln" d="M30 150H780"/>']
    for n in range(4):
        x = 60 + 200 * n
        body.append(f'<path class="ln" d="M{x} 144V156"/><text class="mut" text-anchor="middle" x="{x}" y="172">{n} ms</text>')
    body += ['<rect class="grn" x="10" y="70" width="100" height="30"/><text class="mut" text-anchor="middle" x="60" y="62">exposure</text>',
             box(110, 70, 330, 30, "read out, transfer, vision"), box(460, 70, 60, 30, "tick", "", "alt"), box(520, 70, 200, 30, "command is held", "", "gry"),
             '<path class="ln dsh" d="M60 40V150"/><path class="ln dsh" d="M460 40V150"/><path class="ln dsh" d="M560 40V70"/>',
             arrow("M64 46H456", "camera delay: 2 ms", 260, 38), '<text class="mut" x="566" y="48">+ half a period of hold:</text><text class="mut" x="566" y="64">loop delay 2.5 ms</text>']
    return page(800, 185, "The loop delay: from the middle of an exposure to the middle of the hold", body)


def silence() -> str:
    """What the board does when nobody speaks."""
    body = [box(20, 50, 150, 56, "running", "follows commands", "grn"), box(260, 50, 170, 56, "holding", "zero-flow displacement", "box"), box(530, 50, 170, 56, "safe", "ramp to park, latched", "alt"),
            arrow("M170 68H256", "20 ms silence", 214, 60), arrow("M260 92H174", "fresh command", 216, 124), arrow("M430 78H526", "2 s more", 478, 68), arrow("M615 106V150H95V110", "new session", 360, 166)]
    return page(720, 180, "Silence on the line: the board holds after 20 ms and parks after 2 s more", body)


def reconcile() -> str:
    """How a missing effect gets its name."""
    steps = [("records", "free run of the model", "grn"), ("noise floor", "from rest or repeats", "box"), ("screening", "each effect, each form", "box"), ("joint fit", "add, replace, remove", "box"), ("held-out check", "other time, other records", "alt"), ("verdict", "one of five", "grn")]
    body = []
    for n, (name, what, kind) in enumerate(steps):
        x, y = 20 + (n % 3) * 260, 30 + (n // 3) * 110
        body.append(box(x, y, 200, 60, name, what, kind))
        if n % 3 < 2:
            body.append(arrow(f"M{x + 200} {y + 30}h56"))
    body += [arrow("M640 90V115H120V138"), arrow("M640 200V232H8V60H18", "ambiguous: the experiment that would decide is run on the rig", 330, 248, "middle", True)]
    return page(780, 255, "Reconcile: from records to a verdict", body)


def crates() -> str:
    """The crates by depth, from the manifests: an arrow between two crates always points down."""
    root = Path(__file__).resolve().parents[2] / "crates"
    names = sorted(path.parent.name for path in root.glob("*/Cargo.toml") if path.parent.name != "counting-alloc")
    needs = {}
    for name in names:
        manifest = tomllib.loads((root / name / "Cargo.toml").read_text())
        needs[name] = [need.removeprefix("cellpos-") for need in manifest.get("dependencies", {}) if need.removeprefix("cellpos-") in names]
    depth = {}

    def depth_of(name: str) -> int:
        if name not in depth:
            depth[name] = 1 + max((depth_of(need) for need in needs[name]), default=-1)
        return depth[name]

    levels = 1 + max(map(depth_of, names))
    body = []
    for level in range(levels):
        y = 14 + (levels - 1 - level) * 50
        members = [name for name in names if depth[name] == level]
        each = min(110.0, 780 / len(members))
        for k, member in enumerate(members):
            x = 395 + (k - len(members) / 2) * each
            body.append(box(x, y, each - 8, 36, member, "", ("gry", "box", "grn")[level % 3]))
    return page(790, 14 + levels * 50, "Crates: each row knows rows below it, and nothing above", body)


ALL = {"loop": loop, "rig": rig, "threads": threads, "tick": tick, "silence": silence, "reconcile-steps": reconcile, "crates": crates}
