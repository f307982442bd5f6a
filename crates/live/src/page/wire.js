// The line to the program: messages in, requests out, and a new line when the old one breaks.

const ROW_BYTES = 56;
const PICTURE_HEAD = 40;
const word = new URLSearchParams(location.search).get("word") ?? "";
export const wordOfLink = word;

// Columns of typed arrays in which the newest rows overwrite the oldest; nothing grows while a run goes on.
export class Rows {
  constructor(capacity) {
    this.capacity = capacity;
    this.time = new Float64Array(capacity);
    for (const name of ["measured", "target", "error", "command", "zeroFlow", "length", "wake", "compute"]) {
      this[name] = new Float32Array(capacity);
    }
    this.count = 0; // rows ever taken; row i lies at i % capacity
    this.lastSeq = null;
    this.missing = 0;
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
      this.time[k] = view.getFloat64(at, true);
      this.measured[k] = f(0);
      this.target[k] = f(1);
      this.error[k] = 1e3 * (f(0) - f(2));
      this.command[k] = f(3);
      this.zeroFlow[k] = f(4);
      this.length[k] = f(5);
      this.wake[k] = f(6);
      this.compute[k] = f(7);
      this.count++;
    }
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
    this.connect();
  }
  connect() {
    const socket = new WebSocket(`ws://${location.host}/live?word=${encodeURIComponent(word)}`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => { this.wait = 250; };
    socket.onmessage = message => {
      if (typeof message.data === "string") this.handlers.told(JSON.parse(message.data));
      else {
        const view = new DataView(message.data);
        if (view.getUint8(0) === 1) this.handlers.rows(view);
        else if (view.getUint8(0) === 2) this.handlers.picture(readPicture(view));
      }
    };
    socket.onclose = () => {
      this.handlers.closed();
      setTimeout(() => this.connect(), this.wait);
      this.wait = Math.min(4000, 2 * this.wait);
    };
    this.socket = socket;
  }
  // A request goes by the line; where that is down, by a request of its own, so that a stop key always works.
  ask(request) {
    const text = JSON.stringify(request);
    if (this.socket.readyState === WebSocket.OPEN) { this.socket.send(text); return; }
    fetch(`/do?word=${encodeURIComponent(word)}`, { method: "POST", body: text })
      .then(async answer => { if (!answer.ok) this.handlers.told({ refused: await answer.text() }); })
      .catch(() => this.handlers.told({ refused: "The program does not answer. The board parks by itself when it is gone." }));
  }
}
