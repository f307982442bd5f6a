// The clips that were kept of the run: a list, and one of them to be played or stepped through.

import { wordOfLink } from "/wire.js";
import { isRed } from "/theme.js";

// A clip as the program sends it: head, then time, centre and pixels of each frame, padded to eight bytes.
export function readFilm(buffer) {
  const view = new DataView(buffer);
  const width = view.getUint32(0, true), height = view.getUint32(4, true), count = view.getUint32(8, true);
  const size = 16 + Math.ceil(width * height / 8) * 8, frames = [];
  for (let n = 0; n < count; n++) {
    const at = 16 + n * size;
    frames.push({
      time: view.getFloat64(at, true), centre: [view.getFloat32(at + 8, true), view.getFloat32(at + 12, true)],
      pixels: new Uint8Array(buffer, at + 16, width * height),
    });
  }
  return { width, height, frames };
}

// What a clip is kept of, from its name.
export function called(name) {
  const cycle = /^cycle-0*(\d+)-phase-([\d.]+)$/.exec(name);
  if (cycle) return `cycle ${cycle[1]}, phase ${cycle[2]}`;
  const event = /^[\d.]+s-(.+)$/.exec(name);
  return event ? event[1] : name;
}

export class Clips {
  constructor($) {
    this.$ = $; this.known = new Set(); this.film = null; this.at = 0; this.playing = null; this.name = null;
    $("clip-play").onclick = () => this.play(this.playing === null);
    $("clip-back").onclick = () => this.step(-1);
    $("clip-on").onclick = () => this.step(1);
    $("clip-at").oninput = () => { this.play(false); this.show(+$("clip-at").value); };
  }
  add(clips) {
    for (const clip of clips) {
      if (this.known.has(clip.name)) continue;
      this.known.add(clip.name);
      const item = document.createElement("li"), button = document.createElement("button"), time = document.createElement("span");
      time.textContent = `${clip.time_s.toFixed(3)} s`;
      button.append(called(clip.name)); // text, never markup
      button.onclick = () => this.open(clip.name, button);
      item.append(time, button, ` ${clip.frames} frames`);
      this.$("clips").prepend(item);
    }
    this.$("clips-card").hidden = this.known.size === 0;
  }
  async open(name, button) {
    this.play(false);
    this.$("clip-text").textContent = "Loading.";
    try {
      const answer = await fetch(`/clip?word=${encodeURIComponent(wordOfLink)}&name=${encodeURIComponent(name)}`);
      if (!answer.ok) throw new Error(await answer.text());
      this.film = readFilm(await answer.arrayBuffer());
    } catch (error) {
      this.film = null;
      this.$("clip-text").textContent = `This clip cannot be shown: ${error.message}`;
      return;
    }
    for (const other of this.$("clips").querySelectorAll("button")) other.setAttribute("aria-pressed", String(other === button));
    this.name = name;
    this.$("clip-player").hidden = false;
    this.$("clip-at").max = Math.max(0, this.film.frames.length - 1);
    let low = 255, high = 0;
    for (const { pixels } of this.film.frames) for (const value of pixels) { if (value < low) low = value; if (value > high) high = value; }
    this.grey = [low, 255 / Math.max(1, high - low)];
    this.show(0);
    this.play(true);
  }
  // Twenty frames a second: what took half a second is looked at for twelve.
  play(on) {
    if (this.playing !== null) { clearInterval(this.playing); this.playing = null; }
    if (on && this.film) this.playing = setInterval(() => this.show((this.at + 1) % this.film.frames.length), 50);
    this.$("clip-play").textContent = this.playing === null ? "Play" : "Stop";
  }
  step(by) { this.play(false); if (this.film) this.show(Math.min(this.film.frames.length - 1, Math.max(0, this.at + by))); }
  show(n) {
    const film = this.film, frame = film?.frames[n];
    if (!frame) return;
    this.at = n;
    this.$("clip-at").value = n;
    const canvas = this.$("clip"), scale = Math.max(1, Math.round(canvas.clientWidth * (window.devicePixelRatio || 1) / film.width));
    canvas.width = film.width * scale; canvas.height = film.height * scale;
    const context = canvas.getContext("2d"), image = new ImageData(film.width, film.height), [low, stretch] = this.grey, red = isRed();
    for (let k = 0; k < frame.pixels.length; k++) {
      const value = (frame.pixels[k] - low) * stretch;
      image.data[4 * k] = value; image.data[4 * k + 1] = red ? 0 : value; image.data[4 * k + 2] = red ? 0 : value; image.data[4 * k + 3] = 255;
    }
    this.small ??= document.createElement("canvas");
    this.small.width = film.width; this.small.height = film.height;
    this.small.getContext("2d").putImageData(image, 0, 0);
    context.imageSmoothingEnabled = false;
    context.drawImage(this.small, 0, 0, canvas.width, canvas.height);
    if (isFinite(frame.centre[0])) {
      const x = (frame.centre[0] + 0.5) * scale, y = (frame.centre[1] + 0.5) * scale, arm = 5 * scale;
      context.strokeStyle = red ? "#ff5a4a" : "#5ad1ff"; context.lineWidth = Math.max(1.5, scale / 3); context.beginPath();
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) { context.moveTo(x + dx * arm, y + dy * arm); context.lineTo(x + 2 * dx * arm, y + 2 * dy * arm); }
      context.stroke();
    }
    this.$("clip-text").textContent = `${called(this.name)}: frame ${n + 1} of ${film.frames.length}, at ${frame.time.toFixed(4)} s`
      + (isFinite(frame.centre[0]) ? "" : ", nothing is followed in it");
  }
}
