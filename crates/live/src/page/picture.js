// The camera's picture with what the tracker sees, and the PZT's gauge.

import { colour, number, sharp } from "/trace.js";

export class PictureView {
  constructor(canvas) { this.canvas = canvas; this.picture = null; this.target = NaN; }
  show(picture) { this.picture = picture; this.draw(); }
  // Position along the channel at a place of the canvas, um.
  umAt(event) {
    if (!this.picture) return NaN;
    const { width, height, upright, umPerPx, firstUm } = this.picture;
    const box = this.canvas.getBoundingClientRect();
    const px = upright ? (event.clientY - box.top) / box.height * height : (event.clientX - box.left) / box.width * width;
    return firstUm + (px - 0.5) * umPerPx;
  }
  draw() {
    const { picture, canvas } = this;
    if (!picture) return;
    const { width, height, pixels, upright, umPerPx, firstUm, centre, half, gate, outline } = picture;
    const scale = Math.max(1, Math.round(canvas.clientWidth * (window.devicePixelRatio || 1) / width));
    if (canvas.width !== width * scale || canvas.height !== height * scale) { canvas.width = width * scale; canvas.height = height * scale; }
    const context = canvas.getContext("2d");
    this.small ??= document.createElement("canvas");
    if (this.small.width !== width || this.small.height !== height) { this.small.width = width; this.small.height = height; }
    const grey = new ImageData(width, height);
    // The full range of grey: a bead on a bright field fills a tenth of it.
    let low = 255, high = 0;
    for (const value of pixels) { if (value < low) low = value; if (value > high) high = value; }
    const stretch = 255 / Math.max(1, high - low);
    for (let n = 0; n < pixels.length; n++) {
      const value = (pixels[n] - low) * stretch;
      grey.data[4 * n] = value; grey.data[4 * n + 1] = value; grey.data[4 * n + 2] = value; grey.data[4 * n + 3] = 255;
    }
    this.small.getContext("2d").putImageData(grey, 0, 0);
    context.imageSmoothingEnabled = false;
    context.drawImage(this.small, 0, 0, width * scale, height * scale);
    context.lineWidth = Math.max(2.5, scale / 3);
    const toPx = um => ((um - firstUm) / umPerPx + 0.5) * scale;
    const across = at => {
      context.beginPath();
      if (upright) { context.moveTo(0, at); context.lineTo(canvas.width, at); } else { context.moveTo(at, 0); context.lineTo(at, canvas.height); }
      context.stroke();
    };
    if (isFinite(this.target)) { context.strokeStyle = "#ff9d5c"; context.setLineDash([4, 4]); across(toPx(this.target)); context.setLineDash([]); }
    if (isFinite(centre[0])) {
      const cx = (centre[0] + 0.5) * scale, cy = (centre[1] + 0.5) * scale;
      context.strokeStyle = "#5ad1ff"; context.beginPath();
      if (outline.length) {
        for (let n = 0; n < outline.length; n += 2) context.lineTo((outline[n] + 0.5) * scale, (outline[n + 1] + 0.5) * scale);
        context.closePath();
      } else {
        context.ellipse(cx, cy, Math.max(2, half[0] * scale), Math.max(2, half[1] * scale), 0, 0, 2 * Math.PI);
      }
      context.stroke();
      if (isFinite(gate)) {
        context.strokeStyle = "rgba(255,255,255,.55)"; context.setLineDash([2, 4]);
        const along = upright ? cy : cx; across(along - gate * scale); across(along + gate * scale); context.setLineDash([]);
      }
    }
    // A scale bar of a round length, about a quarter of the picture.
    const span = Math.abs(umPerPx) * (upright ? height : width);
    if (!(span > 0)) return; // nothing is calibrated
    const power = 10 ** Math.floor(Math.log10(span / 4));
    const bar = [1, 2, 5, 10].map(n => n * power).filter(n => n <= span / 3).pop() ?? power;
    const length = bar / Math.abs(umPerPx) * scale, x = 8 * (window.devicePixelRatio || 1), y = canvas.height - x;
    context.fillStyle = "#fff"; context.strokeStyle = "#000";
    const size = Math.round(13 * (window.devicePixelRatio || 1));
    context.font = `${size}px system-ui, sans-serif`; context.textAlign = "left"; context.textBaseline = "bottom"; context.lineWidth = 3;
    const bar3 = Math.max(3, size / 4);
    if (upright) context.fillRect(x, y - length, bar3, length); else context.fillRect(x, y - bar3, length, bar3);
    context.strokeText(`${bar} um`, x + (upright ? 2 * bar3 : 0), y - bar3 - 2); context.fillText(`${bar} um`, x + (upright ? 2 * bar3 : 0), y - bar3 - 2);
  }
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
  context.textAlign = "left"; context.fillText(`${number(low, high - low)} um`, x(low), y + tall + 4);
  context.textAlign = "right"; context.fillText(`${number(high, high - low)} um`, x(high), y + tall + 4);
}
