// Traces over time: panels on one canvas, each pixel column drawn from the least to the greatest of its rows, so that no
// excursion of a single tick is lost whatever the time base.

import { RMS_S } from "/wire.js";
import { isRed } from "/theme.js";

export function sharp(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
  return context;
}

export function colour(name) { return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim(); }

// Round steps of an axis: about `most` of them between low and high.
export function steps(low, high, most) {
  const raw = (high - low) / most;
  if (!(raw > 0) || !isFinite(raw)) return [];
  const power = Math.pow(10, Math.floor(Math.log10(raw)));
  const sizes = [0.5, 1, 2, 5, 10].map(n => n * power), round = sizes.findIndex(s => s >= raw * (1 - 1e-9));
  const at = step => {
    const found = [];
    for (let n = Math.ceil(low / step - 1e-9); n * step <= high + 1e-9 * step; n++) found.push(n * step);
    return found;
  };
  // One value alone says nothing of the scale.
  const found = at(sizes[round]);
  return found.length > 1 || round < 1 ? found : at(sizes[round - 1]);
}

// Powers of ten of a logarithmic axis, short enough for a phone.
export function short(value) {
  if (value >= 1e6) return `${+(value / 1e6).toPrecision(1)}M`;
  if (value >= 1e4) return `${+(value / 1e3).toPrecision(1)}k`;
  return String(+value.toPrecision(1));
}

export function number(value, span) {
  if (!isFinite(value)) return "-";
  const digits = Math.max(0, Math.min(6, 2 - Math.floor(Math.log10(Math.max(span, 1e-9)))));
  return (Math.abs(value) < 1e-12 ? 0 : value).toFixed(digits);
}

const LEFT = 74, RIGHT = 10, TOP = 8, BOTTOM = 26, GAP = 12, LINE = 15;
// What can be drawn. A panel that is bound to zero keeps it in its middle or at its foot.
export const PANELS = [
  { id: "position", name: "Position", unit: "µm", share: 1.4, series: [["measured", "position", "position"], ["target", "target", "target"]] },
  { id: "error", name: "Error", unit: "nm", share: 1, zero: true, series: [["error", "error", "position"]] },
  { id: "pzt", name: "PZT", unit: "µm", share: 1, series: [["command", "PZT", "pzt"], ["zeroFlow", "zero flow", "zero-flow"]] },
  { id: "gain", name: "Gain", unit: "of the model's", share: 1, series: [["gain", "estimated gain", "pzt"]] },
  { id: "length", name: "Length", unit: "µm", share: 1, series: [["length", "length of the cell", "position"]] },
  { id: "area", name: "Area", unit: "µm²", share: 1, series: [["area", "area of the cell", "position"]] },
  { id: "lateness", name: "Lateness", unit: "µs", share: 1, foot: true, series: [["wake", "wake-up", "target"], ["compute", "computing", "position"]] },
];
// While the target rests, the error is the position once more: its running RMS says what the position does not.
const HOLDING = { id: "error", name: "Error", unit: "nm", share: 1, foot: true, series: [["rms", `error, RMS of ${1e3 * RMS_S} ms`, "position"]] };

export class Traces {
  constructor(canvas, rows) {
    this.canvas = canvas; this.rows = rows; this.cursor = null; this.bound = null;
    this.chosen = new Set(["position", "error", "pzt"]);
    this.scales = {}; // a panel's own [low, high]; without one it follows its data
    this.drawn = []; // panels as they were drawn: {id, top, bottom, low, high}
  }
  // Seconds of the run at a place of the canvas.
  timeAt(x) {
    const width = this.canvas.clientWidth - LEFT - RIGHT;
    return this.from + (x - LEFT) / width * (this.to - this.from);
  }
  get perPixel() { return (this.to - this.from) / Math.max(1, this.canvas.clientWidth - LEFT - RIGHT); }
  onAxis(x) { return x < LEFT; }
  panelAt(y) { return this.drawn.find(panel => y >= panel.top && y <= panel.bottom); }
  // Makes a panel's scale finer or coarser about a value of it.
  zoom(panel, y, factor) {
    const value = panel.low + (panel.bottom - y) / (panel.bottom - panel.top) * (panel.high - panel.low);
    this.scales[panel.id] = [value + (panel.low - value) * factor, value + (panel.high - value) * factor];
  }
  // The panels that are drawn of a span of time.
  panels(from, to) {
    const holding = this.chosen.has("position") && this.rows.atRest(from, to);
    return PANELS.filter(panel => this.chosen.has(panel.id)).map(panel => panel.id === "error" && holding ? HOLDING : panel);
  }
  draw(from, to, mark) {
    const { rows } = this;
    const context = sharp(this.canvas);
    const width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    this.from = from; this.to = to;
    const plotWidth = width - LEFT - RIGHT, columns = Math.max(1, Math.floor(plotWidth));
    const first = rows.after(from), last = rows.after(to);
    const x = time => LEFT + (time - from) / (to - from) * plotWidth;
    context.font = "12px system-ui, sans-serif";
    const panels = this.panels(from, to), shares = panels.reduce((sum, panel) => sum + panel.share, 0);
    const room = height - TOP - BOTTOM - GAP * (panels.length - 1);
    let top = TOP;
    this.drawn = [];
    for (const panel of panels) {
      const tall = room * panel.share / shares;
      const found = panel.series.map(([key]) => reduce(rows, rows[key], first, last, from, to, columns));
      const bound = panel === HOLDING && this.bound !== null ? this.bound : null;
      const [low, high] = this.scales[panel.id] ?? limits(panel, found, bound);
      const names = panel.series.map(([, label, paint]) => [label, paint]);
      if (bound !== null) names.push([`lowest possible RMS, ${bound.toFixed(1)} nm`, "target"]);
      // The names have lines of their own: a curve is never behind them.
      const told = legend(context, names, width), head = told.lines * LINE + 2;
      const upper = top + head, plot = tall - head;
      this.drawn.push({ id: panel.id, top: upper, bottom: top + tall, low, high });
      const y = value => top + tall - (value - low) / (high - low) * plot;
      grid(context, panel, { low, high, y, top: upper, tall: plot, width });
      context.save();
      context.beginPath(); context.rect(LEFT, upper, plotWidth, plot); context.clip();
      if (bound !== null) {
        context.strokeStyle = colour("target"); context.lineWidth = 1.2; context.setLineDash([6, 4]); context.beginPath();
        context.moveTo(LEFT, y(bound)); context.lineTo(width - RIGHT, y(bound)); context.stroke(); context.setLineDash([]);
      }
      panel.series.forEach(([, , paint], n) => stroke(context, found[n], colour(paint), y, isRed() && ["target", "zero-flow"].includes(paint)));
      context.restore();
      context.textAlign = "left"; context.textBaseline = "top";
      for (const { label, paint, at, line } of told.placed) {
        context.fillStyle = colour(paint); context.fillText(label, at, top + line * LINE);
      }
      top += tall + GAP;
    }
    context.fillStyle = colour("quiet"); context.textAlign = "center"; context.textBaseline = "top";
    for (const time of steps(from, to, Math.max(2, plotWidth / 90))) {
      context.fillText(`${number(time, to - from)} s`, Math.min(width - 24, Math.max(LEFT + 10, x(time))), height - BOTTOM + 7);
    }
    for (const [time, paint] of [[mark, "alarm"], [this.cursor, "ink"]]) {
      if (time === null || time === undefined || time < from || time > to) continue;
      context.strokeStyle = colour(paint); context.lineWidth = 1;
      context.beginPath(); context.moveTo(x(time), TOP); context.lineTo(x(time), height - BOTTOM); context.stroke();
    }
  }
  // The row at the cursor, in words.
  read() {
    const { rows } = this;
    if (this.cursor === null || !rows.count) return null;
    const i = Math.min(rows.count - 1, rows.after(this.cursor));
    const k = rows.at(i);
    const say = (value, digits) => isFinite(value) ? value.toFixed(digits) : "-";
    return `${rows.time[k].toFixed(3)} s: position ${say(rows.measured[k], 3)} µm, target ${say(rows.target[k], 3)} µm, `
      + `error ${say(rows.error[k], 0)} nm, PZT ${say(rows.command[k], 3)} µm, zero flow ${say(rows.zeroFlow[k], 3)} µm`
      + (isFinite(rows.gain[k]) ? `, gain ${say(rows.gain[k], 2)} of the model's` : "")
      + (isFinite(rows.length[k]) ? `, length ${say(rows.length[k], 3)} µm` : "")
      + (isFinite(rows.area[k]) ? `, area ${say(rows.area[k], 2)} µm²` : "")
      + `, wake-up ${say(rows.wake[k], 0)} µs, computing ${say(rows.compute[k], 0)} µs`;
  }
}

// Places of a panel's names, in as many lines as a narrow screen needs.
function legend(context, names, width) {
  const placed = [];
  let at = LEFT + 6, line = 0;
  for (const [label, paint] of names) {
    const long = context.measureText(label).width;
    if (at + long > width - RIGHT && at > LEFT + 6) { at = LEFT + 6; line += 1; }
    placed.push({ label, paint, at, line });
    at += long + 14;
  }
  return { placed, lines: line + 1 };
}

// Ends of a panel's scale, from its data.
function limits(panel, found, bound) {
  let low = Math.min(...found.map(f => f.low)), high = Math.max(...found.map(f => f.high), bound ?? -Infinity);
  if (!(low <= high)) { low = -1; high = 1; }
  if (panel.zero) { high = Math.max(high, -low, 1e-3); low = -high; }
  const margin = Math.max(0.08 * (high - low), panel.unit === "nm" ? 5 : 0.01);
  return panel.foot ? [0, high + margin] : [low - margin, high + margin];
}

function grid(context, panel, { low, high, y, top, tall, width }) {
  context.strokeStyle = colour("line"); context.fillStyle = colour("quiet"); context.lineWidth = 1;
  context.textAlign = "right"; context.textBaseline = "middle";
  const marks = steps(low, high, Math.max(2, tall / 42)), step = marks.length > 1 ? marks[1] - marks[0] : (high - low) / 10;
  for (const value of marks) {
    context.beginPath(); context.moveTo(LEFT, y(value)); context.lineTo(width - RIGHT, y(value)); context.stroke();
    context.fillText(number(value, 100 * step), LEFT - 6, y(value)); // the digits that tell two marks apart
  }
  context.save();
  context.translate(13, top + tall / 2); context.rotate(-Math.PI / 2); context.textAlign = "center";
  context.fillText(panel.unit, 0, 0); context.restore();
}

// Least and greatest of each pixel column; where columns outnumber rows, the rows themselves.
function reduce(rows, values, first, last, from, to, columns) {
  const found = { points: [], low: Infinity, high: -Infinity };
  const scale = columns / (to - from);
  let column = -1, low = Infinity, high = -Infinity, firstValue = NaN, lastValue = NaN, broken = true;
  const close = () => {
    if (column >= 0 && low <= high) found.points.push([column, firstValue, low, high, lastValue, broken]);
    broken = !(low <= high); low = Infinity; high = -Infinity; firstValue = NaN;
  };
  for (let i = first; i < last; i++) {
    const k = rows.at(i), value = values[k];
    const here = Math.floor((rows.time[k] - from) * scale);
    if (here !== column) { close(); column = here; }
    if (value !== value) continue; // no bead in that frame
    if (firstValue !== firstValue) firstValue = value;
    lastValue = value;
    if (value < low) low = value;
    if (value > high) high = value;
  }
  close();
  for (const [, , least, greatest] of found.points) {
    if (least < found.low) found.low = least;
    if (greatest > found.high) found.high = greatest;
  }
  return found;
}

// In red light colours say nothing: then a second curve is dashed.
function stroke(context, found, paint, y, dashed) {
  context.setLineDash(dashed ? [5, 4] : []);
  context.strokeStyle = paint; context.lineWidth = 1.4; context.lineJoin = "round";
  context.beginPath();
  for (const [column, first, low, high, last, broken] of found.points) {
    const x = LEFT + column + 0.5;
    if (broken) context.moveTo(x, y(first)); else context.lineTo(x, y(first));
    if (high > low) { context.lineTo(x, y(high)); context.lineTo(x, y(low)); }
    context.lineTo(x, y(last));
  }
  context.stroke();
  context.setLineDash([]);
}
