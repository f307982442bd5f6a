// Spectrum of the error, histogram of lateness, trend over cycles.

import { colour, number, sharp, short, steps } from "/trace.js";

const SEGMENT = 1024;

// Fast Fourier transform in place, radix 2.
function transform(re, im) {
  const n = re.length;
  for (let i = 1, j = 0; i < n; i++) {
    let bit = n >> 1;
    for (; j & bit; bit >>= 1) j ^= bit;
    j ^= bit;
    if (i < j) { [re[i], re[j]] = [re[j], re[i]]; [im[i], im[j]] = [im[j], im[i]]; }
  }
  for (let length = 2; length <= n; length <<= 1) {
    const angle = -2 * Math.PI / length;
    for (let start = 0; start < n; start += length) {
      for (let k = 0; k < length / 2; k++) {
        const c = Math.cos(angle * k), s = Math.sin(angle * k);
        const a = start + k, b = a + length / 2;
        const x = re[b] * c - im[b] * s, y = re[b] * s + im[b] * c;
        re[b] = re[a] - x; im[b] = im[a] - y; re[a] += x; im[a] += y;
      }
    }
  }
}

// Welch's estimate over the newest rows (Hann, half overlap): amplitude spectral density, nm/sqrt(Hz), one-sided. Rows without
// a position are bridged by the last one.
export function density(values, rate) {
  const window = Float64Array.from({ length: SEGMENT }, (_, n) => 0.5 - 0.5 * Math.cos(2 * Math.PI * n / SEGMENT));
  const power = window.reduce((sum, w) => sum + w * w, 0);
  const sum = new Float64Array(SEGMENT / 2);
  let segments = 0;
  for (let start = 0; start + SEGMENT <= values.length; start += SEGMENT / 2) {
    const re = new Float64Array(SEGMENT), im = new Float64Array(SEGMENT);
    let mean = 0;
    for (let n = 0; n < SEGMENT; n++) mean += values[start + n] / SEGMENT;
    for (let n = 0; n < SEGMENT; n++) re[n] = (values[start + n] - mean) * window[n];
    transform(re, im);
    for (let n = 0; n < SEGMENT / 2; n++) sum[n] += 2 * (re[n] ** 2 + im[n] ** 2) / (power * rate);
    segments++;
  }
  if (!segments) return [];
  return Array.from({ length: SEGMENT / 2 - 1 }, (_, n) => [(n + 1) * rate / SEGMENT, Math.sqrt(sum[n + 1] / segments)]);
}

export function newestErrors(rows, count) {
  const last = rows.count, first = Math.max(rows.first, last - count);
  const found = new Float64Array(last - first);
  let held = 0;
  for (let i = first; i < last; i++) {
    const value = rows.error[rows.at(i)];
    if (value === value) held = value;
    found[i - first] = held;
  }
  return found;
}

function axes(canvas, [xLow, xHigh], [yLow, yHigh], xLabel, yLabel) {
  const context = sharp(canvas);
  const width = canvas.clientWidth, height = canvas.clientHeight;
  const left = 58, right = 12, top = 8, bottom = 36;
  const x = v => left + (Math.log10(v) - Math.log10(xLow)) / (Math.log10(xHigh) - Math.log10(xLow)) * (width - left - right);
  const y = v => height - bottom - (Math.log10(v) - Math.log10(yLow)) / (Math.log10(yHigh) - Math.log10(yLow)) * (height - top - bottom);
  context.font = "12px system-ui, sans-serif"; context.fillStyle = colour("quiet"); context.strokeStyle = colour("line"); context.lineWidth = 1;
  for (let p = Math.ceil(Math.log10(yLow) - 1e-9); p <= Math.log10(yHigh) + 1e-9; p++) {
    const v = 10 ** p;
    context.beginPath(); context.moveTo(left, y(v)); context.lineTo(width - right, y(v)); context.stroke();
    context.textAlign = "right"; context.textBaseline = "middle"; context.fillText(short(v), left - 6, y(v));
  }
  for (let p = Math.ceil(Math.log10(xLow) - 1e-9); p <= Math.log10(xHigh) + 1e-9; p++) {
    const v = 10 ** p;
    context.beginPath(); context.moveTo(x(v), top); context.lineTo(x(v), height - bottom); context.stroke();
    context.textAlign = "center"; context.textBaseline = "top"; context.fillText(short(v), Math.min(width - 18, x(v)), height - bottom + 4);
  }
  context.textAlign = "center"; context.textBaseline = "bottom"; context.fillText(xLabel, (left + width - right) / 2, height - 1);
  context.save(); context.translate(13, (top + height - bottom) / 2); context.rotate(-Math.PI / 2);
  context.textBaseline = "middle"; context.fillText(yLabel, 0, 0); context.restore();
  return { context, x, y, left, right: width - right, bottom: height - bottom };
}

// The error's spectrum and what the loop's own linear model predicts of it.
export function drawSpectrum(canvas, rows, rate, predicted, noise) {
  const errors = newestErrors(rows, Math.min(16 * SEGMENT, Math.round(8 * rate)));
  const found = density(errors, rate);
  const within = predicted.map(([f, walk, fix]) => [f, Math.hypot(walk, fix * (noise ?? 0))]).filter(([f, a]) => f >= rate / SEGMENT && f <= rate / 2 && a > 0);
  const all = [...found, ...within].map(([, a]) => a).filter(a => a > 0);
  const peak = Math.max(1, ...all), least = Math.min(peak / 100, ...all);
  const frame = axes(canvas, [rate / SEGMENT, rate / 2], [Math.max(1e-3, peak / 1e4, least / 1.5), peak * 1.5], "Hz", "nm/√Hz");
  const line = (points, paint, dash) => {
    frame.context.strokeStyle = paint; frame.context.lineWidth = 1.6; frame.context.setLineDash(dash);
    frame.context.save(); frame.context.beginPath(); frame.context.rect(frame.left, 0, frame.right - frame.left, frame.bottom); frame.context.clip();
    frame.context.beginPath();
    points.forEach(([f, a], n) => n ? frame.context.lineTo(frame.x(f), frame.y(a)) : frame.context.moveTo(frame.x(f), frame.y(a)));
    frame.context.stroke(); frame.context.restore(); frame.context.setLineDash([]);
  };
  line(found, colour("position"), []);
  line(within, colour("target"), [6, 4]);
  frame.context.textAlign = "left"; frame.context.textBaseline = "top";
  [["error", "position"], ...(within.length ? [["predicted for this loop while it holds", "target"]] : [])].forEach(([name, paint], n) => {
    frame.context.fillStyle = colour("card"); frame.context.fillRect(frame.left + 5, frame.bottom - 37 + 15 * n, frame.context.measureText(name).width + 6, 15);
    frame.context.fillStyle = colour(paint); frame.context.fillText(name, frame.left + 8, frame.bottom - 36 + 15 * n);
  });
}

const BINS = 60, LEAST_US = 1, MOST_US = 1e5;

// Counts since the page was opened; a bin a twelfth of a decade.
export class Lateness {
  constructor() { this.wake = new Float64Array(BINS); this.compute = new Float64Array(BINS); this.taken = 0; this.most = 0; }
  take(rows) {
    for (let i = Math.max(this.taken, rows.first); i < rows.count; i++) {
      const k = rows.at(i);
      this.wake[bin(rows.wake[k])]++;
      this.compute[bin(rows.compute[k])]++;
      this.most = Math.max(this.most, rows.wake[k] + rows.compute[k]);
    }
    this.taken = rows.count;
  }
  draw(canvas, budget) {
    const most = Math.max(10, ...this.wake, ...this.compute);
    const frame = axes(canvas, [LEAST_US, MOST_US], [0.7, most * 1.5], "µs", "ticks");
    const { context } = frame;
    [[this.wake, "target", "wake-up"], [this.compute, "position", "computing"]].forEach(([counts, paint, label], n) => {
      context.strokeStyle = colour(paint); context.lineWidth = 1.8; context.beginPath();
      let open = false;
      counts.forEach((count, b) => {
        const from = frame.x(edge(b)), to = frame.x(edge(b + 1)), y = frame.y(Math.max(0.7, count));
        if (open) context.lineTo(from, y); else if (count) context.moveTo(from, frame.bottom);
        if (open || count) { context.lineTo(from, y); context.lineTo(to, y); }
        open = count > 0;
      });
      context.stroke();
      context.fillStyle = colour(paint); context.textAlign = "right"; context.textBaseline = "top";
      context.fillText(label, frame.right - 6, 10 + 15 * n);
    });
    if (budget > LEAST_US && budget < MOST_US) {
      context.strokeStyle = colour("alarm"); context.setLineDash([4, 4]); context.beginPath();
      context.moveTo(frame.x(budget), 8); context.lineTo(frame.x(budget), frame.bottom); context.stroke(); context.setLineDash([]);
      context.fillStyle = colour("alarm"); context.textAlign = "right"; context.fillText("budget", frame.x(budget) - 4, 10);
    }
  }
}

function edge(b) { return LEAST_US * (MOST_US / LEAST_US) ** (b / BINS); }
function bin(us) {
  if (!(us > LEAST_US)) return 0;
  return Math.min(BINS - 1, Math.floor(BINS * Math.log(us / LEAST_US) / Math.log(MOST_US / LEAST_US)));
}

// Amplitude, stretch and recovery over the cycles, each in a strip of its own.
export function drawCycles(canvas, cycles) {
  const strips = [["amplitude_um", "amplitude, µm", "position"], ["stretch", "stretch", "pzt"], ["recovery_s", "recovery, s", "target"]]
    .map(([key, label, paint]) => ({ label, paint, points: cycles.filter(c => c[key] !== null).map(c => [c.cycle, c[key]]) }))
    .filter(strip => strip.points.length > 1);
  const context = sharp(canvas);
  const width = canvas.clientWidth, height = canvas.clientHeight, left = 52;
  context.font = "12px system-ui, sans-serif";
  const tall = (height - 20) / Math.max(1, strips.length);
  const end = Math.max(2, ...cycles.map(c => c.cycle));
  strips.forEach((strip, n) => {
    const values = strip.points.map(([, v]) => v);
    let low = Math.min(...values), high = Math.max(...values);
    const margin = Math.max(0.1 * (high - low), 1e-3 * Math.abs(high), 1e-6);
    low -= margin; high += margin;
    const top = n * tall + 3;
    const x = c => left + (c - 1) / (end - 1) * (width - left - 8), y = v => top + (high - v) / (high - low) * (tall - 8);
    context.strokeStyle = colour("line"); context.fillStyle = colour("quiet"); context.textAlign = "right"; context.textBaseline = "middle";
    const marks = steps(low, high, 3), step = marks.length > 1 ? marks[1] - marks[0] : (high - low) / 10;
    for (const v of marks) {
      context.beginPath(); context.moveTo(left, y(v)); context.lineTo(width - 8, y(v)); context.stroke();
      context.fillText(number(v, 100 * step), left - 5, Math.max(top + 4, y(v))); // the digits that tell two marks apart
    }
    context.fillStyle = colour(strip.paint);
    for (const [c, v] of strip.points) context.fillRect(x(c) - 2, y(v) - 2, 4, 4);
    context.textAlign = "right"; context.textBaseline = "top";
    const room = context.measureText(strip.label).width;
    context.fillStyle = colour("card"); context.fillRect(width - room - 12, top, room + 6, 14);
    context.fillStyle = colour(strip.paint); context.fillText(strip.label, width - 9, top);
  });
  context.fillStyle = colour("quiet"); context.textAlign = "center"; context.textBaseline = "bottom";
  context.fillText(`cycle 1 to ${end}`, (left + width) / 2, height);
}
