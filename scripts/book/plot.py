"""Line plots and bar charts as SVG, in the style of the program's own figures. Standard library alone."""

import math
from html import escape

COLOURS = ["#0072b2", "#d55e00", "#009e73", "#b2589a", "#b98200", "#3f9bd1", "#6b5fc7"]
STYLE = """.fg{font-family:system-ui,'DejaVu Sans','Segoe UI',Helvetica,Arial,sans-serif;font-size:13px}.fg text{fill:#2b2f36}
.fg .mut{fill:#5c6470}.fg .ttl{font-weight:600}.fg .bg{fill:#fff}.fg .frm{fill:none;stroke:#9aa3ae}.fg .grd{stroke:#e3e7ec;fill:none}
.fg .ln{fill:none;stroke-width:1.6;stroke-linejoin:round}.fg .dsh{stroke-dasharray:6 4}"""


def ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Round numbers between two limits."""
    raw = (high - low) / most
    step = 10 ** math.floor(math.log10(raw))
    step *= next(f for f in (1, 2, 5, 10) if f * step >= raw)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def number(value: float) -> str:
    return f"{value:.6g}"


def svg(width: int, height: int, title: str, body: list[str]) -> str:
    return (f'<svg xmlns="http://www.w3.org/2000/svg" class="fg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img">'
            f"<title>{escape(title)}</title><style>{STYLE}</style>"
            f'<rect class="bg" width="{width}" height="{height}"/>' + "\n".join(body) + "</svg>\n")


def lines(title: str, panels: list[dict], x_label: str, width: int = 760, panel_height: int = 190) -> str:
    """Panels one below the other. A panel: `y` (label), `curves` (name, xs, ys, dashed), optionally `low` and `high`."""
    left, right, top, gap, bottom = 66, 16, 34, 26, 44
    height = top + len(panels) * panel_height + (len(panels) - 1) * gap + bottom
    every_x = [x for panel in panels for curve in panel["curves"] for x in curve[1]]
    x_low, x_high = min(every_x), max(every_x)
    px = lambda x: left + (x - x_low) / (x_high - x_low) * (width - left - right)
    body = [f'<text class="ttl" x="{left}" y="20">{escape(title)}</text>']
    for n, panel in enumerate(panels):
        y0 = top + n * (panel_height + gap)
        ys = [y for curve in panel["curves"] for y in curve[2] if y == y]
        low, high = panel.get("low", min(ys)), panel.get("high", max(ys))
        margin = 0.06 * (high - low) or 1.0
        low, high = (low if "low" in panel else low - margin), (high if "high" in panel else high + margin)
        py = lambda y: y0 + panel_height - (min(max(y, low), high) - low) / (high - low) * panel_height
        for tick in ticks(low, high, 5):
            body.append(f'<path class="grd" d="M{left} {py(tick):.1f}H{width - right}"/><text class="mut" text-anchor="end" x="{left - 6}" y="{py(tick) + 4:.1f}">{number(tick)}</text>')
        for tick in ticks(x_low, x_high, 8):
            body.append(f'<path class="grd" d="M{px(tick):.1f} {y0}V{y0 + panel_height}"/>')
            if n == len(panels) - 1:
                body.append(f'<text class="mut" text-anchor="middle" x="{px(tick):.1f}" y="{y0 + panel_height + 17}">{number(tick)}</text>')
        body.append(f'<rect class="frm" x="{left}" y="{y0}" width="{width - left - right}" height="{panel_height}"/>')
        body.append(f'<text transform="translate(16 {y0 + panel_height / 2}) rotate(-90)" text-anchor="middle">{escape(panel["y"])}</text>')
        at = left + 8
        for k, (name, xs, curve, dashed) in enumerate(panel["curves"]):
            colour = COLOURS[k % len(COLOURS)]
            points = [f"{px(x):.1f} {py(y):.1f}" for x, y in zip(xs, curve) if y == y]
            body.append(f'<path class="ln{" dsh" if dashed else ""}" stroke="{colour}" d="M{"L".join(points)}"/>')
            body.append(f'<path class="ln{" dsh" if dashed else ""}" stroke="{colour}" d="M{at} {y0 + 12}h18"/><text x="{at + 22}" y="{y0 + 16}">{escape(name)}</text>')
            at += 36 + 7.2 * len(name)
    body.append(f'<text text-anchor="middle" x="{(left + width) / 2}" y="{height - 8}">{escape(x_label)}</text>')
    return svg(width, height, title, body)


def bars(title: str, groups: list[dict], width: int = 860, height: int = 300) -> str:
    """Groups of horizontal bars side by side. A group: `title`, `bars` (name, value, its text, colour index), optionally `limit` (name, value, its text)."""
    body = [f'<text class="ttl" x="16" y="22">{escape(title)}</text>']
    each = width / len(groups)
    for n, group in enumerate(groups):
        x0, y0 = n * each + 118, 74
        room = each - 118 - 70
        most = max([bar[1] for bar in group["bars"]] + [group.get("limit", ("", 0.0))[1]])
        body.append(f'<text x="{n * each + 16}" y="48">{escape(group["title"])}</text>')
        step = (height - y0 - 30) / len(group["bars"])
        for k, (name, value, text, colour) in enumerate(group["bars"]):
            y = y0 + k * step
            body.append(f'<text text-anchor="end" x="{x0 - 8}" y="{y + step / 2 + 1:.1f}">{escape(name)}</text>'
                        f'<rect fill="{COLOURS[colour]}" fill-opacity="0.85" x="{x0}" y="{y + 3:.1f}" width="{value / most * room:.1f}" height="{step - 12:.1f}"/>'
                        f'<text x="{x0 + value / most * room + 6:.1f}" y="{y + step / 2 + 1:.1f}">{escape(text)}</text>')
        if "limit" in group:
            name, value, text = group["limit"]
            x = x0 + value / most * room
            body.append(f'<path class="ln dsh" stroke="#2b2f36" d="M{x:.1f} {y0 - 6}V{height - 26}"/><text class="mut" text-anchor="middle" x="{x:.1f}" y="{height - 10}">{escape(name)} {escape(text)}</text>')
    return svg(width, height, title, body)


def proof(figures: list[dict]) -> str:
    """Hold error of the four laws against the limit, and a fix compared with trackpy: figures of docs/measurements.json, with their texts."""
    found = {entry["id"]: (entry["value"], entry["shown"]) for entry in figures}
    laws = [(name, *found[f"hold.{name}"], k) for k, name in enumerate(("pi", "lead", "lqg", "mpc"))]
    beads = [("cellpos", *found["vision.cellpos"], 2), ("trackpy", *found["vision.trackpy"], 1)]
    return bars("How close to the limit", [{"title": "Bead held on the emulated rig: RMS error", "bars": laws, "limit": ("physical limit", *found["hold.bound"])},
                                           {"title": "Bead located, SNR 10: RMS error", "bars": beads}])
