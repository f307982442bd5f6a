// The line to the program: messages in, requests out, and a new line when the old one breaks.

const ROW_BYTES = 64;
const PICTURE_HEAD = 40;
// Time over which the running RMS of the error is taken, s: long against the loop's own memory (1/6T, some 15 ms), short against a
// disturbance that an operator looks for.
export const RMS_S = 0.25;
// A request without an answer for this long goes another way, ms: some ten times what the program takes on a busy machine.
const ANSWER_MS = 1000;
const word = new URLSearchParams(location.search).get("word") ?? "";
export const wordOfLink = word;

// Columns of typed arrays in which the newest rows overwrite the oldest; nothing grows while a run goes on.
export class Rows {
  constructor(capacity, perSecond) {
    this.capacity = capacity;
    this.window = Math.min(capacity, Math.max(1, Math.round(RMS_S * (perSecond ?? 1000))));
    this.time = new Float64Array(capacity);
    for (const name of ["measured", "target", "error", "rms", "command", "zeroFlow", "length", "area", "gain", "wake", "compute"]) {
      this[name] = new Float32Array(capacity);
    }
    this.count = 0; // rows ever taken; row i lies at i % capacity
    this.lastSeq = null;
    this.missing = 0;
    this.squares = 0; this.counted = 0;
  }
  get first() { return Math.max(0, this.count - this.capacity); }
  at(i) { return i % this.capacity; }
  take(view) {
    const rows = view.getUint32(4, true);
    for (let row = 0; row < rows; row++) {
      const at = 8 + row * ROW_BYTES;
      const seq = view.getUint32(at + 8, true);
      if (this.lastSeq !== null) {
        const gap = (seq - this.lastSeq) | 0;
        if (gap <= 0) continue; // the past that a new line tells once more
        this.missing += gap - 1;
      }
      this.lastSeq = seq;
      const k = this.at(this.count);
      const f = n => view.getFloat32(at + 16 + 4 * n, true);
      this.running(1e3 * (f(0) - f(2)), k);
      this.time[k] = view.getFloat64(at, true);
      this.measured[k] = f(0);
      this.target[k] = f(1);
      this.error[k] = 1e3 * (f(0) - f(2));
      this.command[k] = f(3);
      this.zeroFlow[k] = f(4);
      this.length[k] = f(5);
      this.wake[k] = f(6);
      this.compute[k] = f(7);
      this.area[k] = f(8);
      this.gain[k] = f(9);
      this.count++;
    }
  }
  // The RMS of the newest errors: one comes, one leaves.
  running(error, k) {
    if (this.count >= this.window) {
      const old = this.error[this.at(this.count - this.window)];
      if (old === old) { this.squares -= old * old; this.counted--; }
    }
    // As the column keeps it, so that what leaves is what came.
    const kept = Math.fround(error);
    if (kept === kept) { this.squares += kept * kept; this.counted++; }
    this.rms[k] = this.counted > this.window / 2 ? Math.sqrt(Math.max(0, this.squares) / this.counted) : NaN;
  }
  // Index of the first row at or after a time; times rise.
  after(time) {
    let low = this.first, high = this.count;
    while (low < high) {
      const middle = Math.floor((low + high) / 2);
      if (this.time[this.at(middle)] < time) low = middle + 1; else high = middle;
    }
    return low;
  }
  get newest() { return this.count ? this.time[this.at(this.count - 1)] : 0; }
  get oldest() { return this.count ? this.time[this.at(this.first)] : 0; }
  // Whether the target is at rest between two times.
  atRest(from, to) {
    const first = this.after(from), last = this.after(to);
    let low = Infinity, high = -Infinity;
    for (let i = first; i < last; i++) {
      const value = this.target[this.at(i)];
      if (value < low) low = value;
      if (value > high) high = value;
    }
    return !(high > low);
  }
}

export function readPicture(view) {
  const f = n => view.getFloat32(12 + 4 * n, true);
  const width = view.getUint16(4, true), height = view.getUint16(6, true), points = view.getUint8(9);
  const behind = 4 + PICTURE_HEAD + Math.ceil(width * height / 4) * 4;
  return {
    width, height, upright: view.getUint8(8) !== 0, umPerPx: f(0), firstUm: f(1), centre: [f(2), f(3)], half: [f(4), f(5)],
    gate: f(6), time: f(7), pixels: new Uint8Array(view.buffer, 4 + PICTURE_HEAD, width * height),
    outline: points ? new Float32Array(view.buffer, behind, 2 * points) : [],
  };
}

export class Wire {
  constructor(handlers) {
    this.handlers = handlers;
    this.wait = 250;
    this.asked = []; // what was asked by the line and is not answered yet, in order
    this.connect();
  }
  connect() {
    const socket = new WebSocket(`ws://${location.host}/live?word=${encodeURIComponent(word)}`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => { this.wait = 250; };
    socket.onmessage = message => {
      if (typeof message.data === "string") {
        const told = JSON.parse(message.data);
        const answer = told.refused ?? (told.done ? "" : undefined);
        if (answer !== undefined) this.handlers.answered(answer, this.asked.shift()?.where);
        else this.handlers.told(told);
      } else {
        const view = new DataView(message.data);
        if (view.getUint8(0) === 1) this.handlers.rows(view);
        else if (view.getUint8(0) === 2) this.handlers.picture(readPicture(view));
      }
    };
    socket.onclose = () => {
      const open = this.asked.splice(0);
      for (const request of open) if (!this.again(request, open)) this.handlers.answered("The line broke before the answer came.", request.where);
      // After its last word a program is not looked for any more.
      if (this.handlers.closed()) return;
      setTimeout(() => this.connect(), this.wait);
      this.wait = Math.min(4000, 2 * this.wait);
    };
    this.socket = socket;
  }
  // A request goes by the line; where that is down, by a request of its own. Its answer comes to `where`: empty if it was done.
  ask({ do: what, ...more }, where) {
    const request = { what, text: JSON.stringify({ do: what, ...more }), where };
    if (this.socket.readyState !== WebSocket.OPEN) { this.post(request); return; }
    this.asked.push(request);
    this.socket.send(request.text);
    setTimeout(() => { if (this.asked.includes(request)) this.again(request, this.asked); }, ANSWER_MS);
  }
  // A stop that may have been lost with the line goes by a request of its own: whether it has. A second stop changes nothing; but
  // one that was withdrawn since, as a freeze is by going on, is not said again.
  again(request, open) {
    const stops = request.what === "park" || (["freeze", "pause"].includes(request.what) && request === open[open.length - 1]);
    if (stops && !request.again) { request.again = true; this.post(request); }
    return stops;
  }
  post({ text, where }) {
    fetch(`/do?word=${encodeURIComponent(word)}`, { method: "POST", body: text })
      .then(async answer => this.handlers.answered(answer.ok ? "" : await answer.text(), where))
      .catch(() => this.handlers.answered("The program does not answer. Without it the board parks the PZT.", where));
  }
}
