// The camera's picture with what the tracker sees, an enlarged part of it that follows the bead, and the PZT's gauge.

import { colour, number, sharp } from "/trace.js";
import { isRed } from "/theme.js";

const INSET = 5; // times the picture's own scale
const INK = { bead: "#5ad1ff", target: "#ff9d5c", gate: "rgba(255,255,255,.5)", ruler: "#ffe14a" };
const RED = { bead: "#ff5a4a", target: "#c42a1e", gate: "rgba(255,60,40,.5)", ruler: "#ff8a78" };

export class PictureView {
  constructor(canvas, inset) {
    this.canvas = canvas; this.inset = inset; this.picture = null; this.target = NaN;
    this.overlay = true; this.stretch = true; this.ruler = null; this.range = null; this.about = null;
    this.small = document.createElement("canvas");
  }
  show(picture) { this.picture = picture; this.draw(); }
  // Place in px of the picture, of a place of the canvas.
  pxAt(event) {
    const { width, height } = this.picture, box = this.canvas.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width * width - 0.5, (event.clientY - box.top) / box.height * height - 0.5];
  }
  // Position along the channel at a place of the canvas, um.
  umAt(event) {
    if (!this.picture) return NaN;
    const { upright, umPerPx, firstUm } = this.picture, [x, y] = this.pxAt(event);
    return firstUm + (upright ? y : x) * umPerPx;
  }
  // A ruler from one place to another, and what it measures, in words.
  measure(from, to) {
    this.ruler = from ? { from, to, umPerPx: this.picture.umPerPx } : null;
    this.draw();
    if (!from) return "";
    const [dx, dy] = [to[0] - from[0], to[1] - from[1]], px = Math.hypot(dx, dy), um = Math.abs(this.picture.umPerPx);
    if (!(um > 0)) return `Ruler: ${px.toFixed(1)} px.`;
    const along = Math.abs(this.picture.upright ? dy : dx) * um;
    return `Ruler: ${(px * um).toFixed(2)} µm (${px.toFixed(1)} px), ${along.toFixed(2)} µm of it along the channel.`;
  }
  // Whole device pixels for each pixel of the camera: as many as the page is wide, fewer if it would be higher than it can be seen at once.
  scale() {
    const { width, height, upright } = this.picture, ratio = window.devicePixelRatio || 1;
    const room = this.canvas.parentElement.clientWidth * ratio, tall = 0.7 * innerHeight * ratio;
    let scale = Math.floor(room / width);
    if (scale < 1) return null; // a narrow screen: the picture is as wide as that
    while (scale > 1 && scale * height > tall && (upright || (scale - 1) * width >= 0.6 * innerWidth * ratio)) scale--;
    return scale;
  }
  // The picture in grey (red on a dark-adapted screen), its contrast stretched so that a bead on a bright field is seen.
  develop() {
    const { width, height, pixels } = this.picture;
    if (this.small.width !== width || this.small.height !== height) { this.small.width = width; this.small.height = height; }
    const counts = new Uint32Array(256);
    for (const value of pixels) counts[value]++;
    // All but one pixel in a thousand on either side: a dead pixel does not set the scale.
    const spare = pixels.length / 1000, end = (from, by) => {
      let value = from, seen = 0;
      while ((seen += counts[value]) <= spare && value + by >= 0 && value + by <= 255) value += by;
      return value;
    };
    const wanted = this.stretch ? [end(0, 1), end(255, -1)] : [0, 255];
    // It follows slowly, so that the picture does not flicker with its noise.
    this.range = this.range && this.stretch ? this.range.map((value, n) => value + 0.2 * (wanted[n] - value)) : wanted;
    const [low, high] = this.range, gain = 255 / Math.max(1, high - low), red = isRed();
    const image = new ImageData(width, height), out = image.data;
    for (let n = 0; n < pixels.length; n++) {
      const value = Math.max(0, Math.min(255, (pixels[n] - low) * gain));
      out[4 * n] = value; out[4 * n + 1] = red ? 0 : value; out[4 * n + 2] = red ? 0 : value; out[4 * n + 3] = 255;
    }
    this.small.getContext("2d").putImageData(image, 0, 0);
  }
  draw() {
    const { picture, canvas } = this;
    if (!picture) return;
    const { width, height } = picture, ratio = window.devicePixelRatio || 1, whole = this.scale();
    const scale = whole ?? 2;
    if (canvas.width !== width * scale || canvas.height !== height * scale) { canvas.width = width * scale; canvas.height = height * scale; }
    const shown = whole ? `${width * whole / ratio}px` : "100%";
    if (canvas.style.width !== shown) canvas.style.width = shown;
    this.develop();
    const context = canvas.getContext("2d"), pen = isRed() ? RED : INK;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.imageSmoothingEnabled = false;
    context.drawImage(this.small, 0, 0, width * scale, height * scale);
    const line = Math.max(1, Math.round(1.5 * ratio));
    if (this.overlay) this.drawOverlay(context, pen, (x, y) => [(x + 0.5) * scale, (y + 0.5) * scale], scale, line);
    if (this.ruler) {
      const [a, b] = [this.ruler.from, this.ruler.to].map(([x, y]) => [(x + 0.5) * scale, (y + 0.5) * scale]);
      context.strokeStyle = pen.ruler; context.lineWidth = line; context.beginPath(); context.moveTo(...a); context.lineTo(...b);
      const long = Math.hypot(b[0] - a[0], b[1] - a[1]) || 1, [nx, ny] = [-(b[1] - a[1]) / long * 7 * ratio, (b[0] - a[0]) / long * 7 * ratio];
      for (const [x, y] of [a, b]) { context.moveTo(x - nx, y - ny); context.lineTo(x + nx, y + ny); }
      context.stroke();
    }
    scaleBar(context, picture, scale, ratio, canvas);
    this.drawInset(scale, pen, ratio);
  }
  drawOverlay(context, pen, place, scale, line) {
    const { upright, umPerPx, firstUm, centre, half, gate, outline } = this.picture, { canvas } = context;
    context.lineWidth = line;
    const across = at => {
      const [x, y] = place(at, at);
      context.beginPath();
      if (upright) { context.moveTo(0, y); context.lineTo(canvas.width, y); } else { context.moveTo(x, 0); context.lineTo(x, canvas.height); }
      context.stroke();
    };
    if (isFinite(this.target) && umPerPx) { context.strokeStyle = pen.target; context.setLineDash([6, 5]); across((this.target - firstUm) / umPerPx); context.setLineDash([]); }
    if (!isFinite(centre[0])) return;
    context.strokeStyle = pen.bead; context.beginPath();
    if (outline.length) {
      for (let n = 0; n < outline.length; n += 2) context.lineTo(...place(outline[n], outline[n + 1]));
      context.closePath();
    } else {
      // Marks outside of the bead, so that the bead itself is seen.
      const [x, y] = place(...centre), reach = [Math.max(3, half[0]) * scale + 4 * line, Math.max(3, half[1]) * scale + 4 * line], arm = 8 * line;
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        context.moveTo(x + dx * reach[0], y + dy * reach[1]); context.lineTo(x + dx * (reach[0] + arm), y + dy * (reach[1] + arm));
      }
    }
    context.stroke();
    if (isFinite(gate)) {
      context.strokeStyle = pen.gate; context.setLineDash([2, 4]);
      const along = upright ? centre[1] : centre[0]; across(along - gate); across(along + gate); context.setLineDash([]);
    }
  }
  // The part about the bead, or about where it was last, five times as large.
  drawInset(scale, pen, ratio) {
    const { picture, inset } = this, context = sharp(inset);
    if (!inset.clientWidth) return;
    if (isFinite(picture.centre[0])) this.about = picture.centre;
    const [wide, tall] = [inset.clientWidth, inset.clientHeight];
    const about = this.about ?? [picture.width / 2, picture.height / 2];
    // All of a cell fits.
    const most = Math.min(wide / (2.1 * Math.max(3, picture.half[0] || 0)), tall / (2.1 * Math.max(3, picture.half[1] || 0)));
    const times = Math.min(INSET * scale / ratio, most);
    context.fillStyle = "#000"; context.fillRect(0, 0, wide, tall);
    context.imageSmoothingEnabled = false;
    const [left, top] = [wide / 2 - (about[0] + 0.5) * times, tall / 2 - (about[1] + 0.5) * times];
    context.drawImage(this.small, left, top, picture.width * times, picture.height * times);
    if (this.overlay) {
      context.save(); context.translate(left, top);
      const { outline, upright, umPerPx, firstUm, centre } = picture;
      context.lineWidth = 1.5;
      if (isFinite(this.target) && umPerPx) {
        const at = ((this.target - firstUm) / umPerPx + 0.5) * times;
        context.strokeStyle = pen.target; context.setLineDash([6, 5]); context.beginPath();
        if (upright) { context.moveTo(-left, at); context.lineTo(wide - left, at); } else { context.moveTo(at, -top); context.lineTo(at, tall - top); }
        context.stroke(); context.setLineDash([]);
      }
      if (isFinite(centre[0])) {
        context.strokeStyle = pen.bead; context.beginPath();
        if (outline.length) {
          for (let n = 0; n < outline.length; n += 2) context.lineTo((outline[n] + 0.5) * times, (outline[n + 1] + 0.5) * times);
          context.closePath();
        } else {
          const [x, y] = [(centre[0] + 0.5) * times, (centre[1] + 0.5) * times];
          context.moveTo(x - 5, y); context.lineTo(x + 5, y); context.moveTo(x, y - 5); context.lineTo(x, y + 5);
        }
        context.stroke();
      }
      context.restore();
    }
    context.font = "12px system-ui, sans-serif"; context.textBaseline = "top"; context.textAlign = "right";
    inset.dataset.times = number(times * ratio / scale, 10);
    outlined(context, `×${inset.dataset.times}`, wide - 6, 5);
    if (picture.umPerPx) {
      const pxPerUm = times / Math.abs(picture.umPerPx), um = roundLength(wide / 2 / pxPerUm);
      context.fillStyle = "#000"; context.fillRect(7, tall - 13, um * pxPerUm + 2, 6);
      context.fillStyle = isRed() ? "#ff8a78" : "#fff"; context.fillRect(8, tall - 12, um * pxPerUm, 4);
      context.textAlign = "left"; context.textBaseline = "bottom"; outlined(context, `${um} µm`, 8, tall - 14);
    }
  }
}

function outlined(context, text, x, y) {
  context.lineWidth = 3; context.strokeStyle = "#000"; context.fillStyle = isRed() ? "#ff8a78" : "#fff";
  context.strokeText(text, x, y); context.fillText(text, x, y);
}

// The longest of 1, 2, 5, 10, ... µm that is not longer than `most`.
function roundLength(most) {
  const power = 10 ** Math.floor(Math.log10(most));
  return +([1, 2, 5].map(n => n * power).filter(n => n <= most).pop() ?? power).toPrecision(1);
}

// A scale bar of a round length, about a fifth of the picture.
function scaleBar(context, { width, height, upright, umPerPx }, scale, ratio, canvas) {
  const span = Math.abs(umPerPx) * (upright ? height : width);
  if (!(span > 0)) return; // nothing is calibrated
  const bar = roundLength(span / 4);
  const length = bar / Math.abs(umPerPx) * scale, x = 10 * ratio, y = canvas.height - x, thick = Math.max(3, 4 * ratio);
  context.fillStyle = isRed() ? "#ff8a78" : "#fff";
  context.font = `${Math.round(14 * ratio)}px system-ui, sans-serif`; context.textAlign = "left"; context.textBaseline = "bottom";
  if (upright) context.fillRect(x, y - length, thick, length); else context.fillRect(x, y - thick, length, thick);
  outlined(context, `${bar} µm`, x + (upright ? 2 * thick : 0), y - thick - 2);
}

export function drawGauge(canvas, [low, high], command, zeroFlow) {
  const context = sharp(canvas);
  const width = canvas.clientWidth, y = 16, tall = 16;
  const x = um => 14 + (um - low) / (high - low) * (width - 28);
  context.fillStyle = colour("paper"); context.strokeStyle = colour("line");
  context.fillRect(x(low), y, x(high) - x(low), tall); context.strokeRect(x(low), y, x(high) - x(low), tall);
  if (isFinite(command)) { context.fillStyle = colour("pzt"); context.fillRect(x(low), y, Math.max(0, x(command) - x(low)), tall); }
  if (isFinite(zeroFlow)) { context.fillStyle = colour("zero-flow"); context.fillRect(x(zeroFlow) - 1.5, y - 5, 3, tall + 10); }
  context.font = "12px system-ui, sans-serif"; context.fillStyle = colour("quiet"); context.textBaseline = "top";
  context.textAlign = "left"; context.fillText(`${number(low, high - low)} µm`, x(low), y + tall + 4);
  context.textAlign = "right"; context.fillText(`${number(high, high - low)} µm`, x(high), y + tall + 4);
}
