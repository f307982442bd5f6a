// What is seen of the traces: which, from when to when, held or running, a trigger, a cursor, and what is saved of it.

import { PANELS, colour } from "/trace.js";

const SHORTEST_S = 0.02;

export class TraceView {
  constructor($, answer) {
    this.$ = $; this.answer = answer; this.rows = null; this.traces = null; this.hello = null;
    this.held = null; this.mark = null; this.trigger = null; this.checked = 0; this.base = +$("base").value;
    $("hold").onclick = () => this.hold(!this.held);
    $("whole").onclick = () => this.reset();
    $("base").onchange = () => { this.base = +$("base").value; if (this.held) this.held = { to: this.held.to }; };
    $("csv").onclick = () => this.saveCsv();
    $("png").onclick = () => this.savePng();
    this.point($("traces"));
    this.choices();
  }
  // Another run, or the same again.
  begin(hello, rows, traces) {
    Object.assign(this, { hello, rows, traces, held: null, mark: null, trigger: null, checked: 0 });
    this.traces.chosen = this.chosen();
    this.$("hold").setAttribute("aria-pressed", "false");
  }
  choices() {
    let kept = null;
    try { kept = JSON.parse(localStorage.getItem("traces")); } catch { /* not ours */ }
    for (const panel of PANELS) {
      const label = document.createElement("label"), box = document.createElement("input");
      box.type = "checkbox"; box.value = panel.id;
      box.checked = Array.isArray(kept) ? kept.includes(panel.id) : ["position", "error", "pzt"].includes(panel.id);
      box.onchange = () => {
        if (this.chosen().size === 0) box.checked = true; // one is always seen
        localStorage.setItem("traces", JSON.stringify([...this.chosen()]));
        if (this.traces) this.traces.chosen = this.chosen();
      };
      label.append(box, ` ${panel.name}`);
      this.$("choices").append(label);
    }
  }
  chosen() { return new Set([...this.$("choices").querySelectorAll("input:checked")].map(box => box.value)); }
  hold(on) {
    this.held = on ? { to: this.rows.newest } : null; this.mark = null; this.trigger = null;
    if (!on) this.base = +this.$("base").value;
    this.$("hold").setAttribute("aria-pressed", String(on));
  }
  // Everything as it was: running, each panel with a scale of its own.
  reset() { this.hold(false); this.traces.scales = {}; }
  holdSpan(from, to, mark) {
    this.hold(true);
    if (mark !== undefined) this.mark = mark;
    this.held = { from, to };
  }
  span() {
    if (this.held?.from !== undefined) return [this.held.from, this.held.to];
    const to = this.held ? this.held.to : this.rows?.newest ?? 0;
    return [to - this.base, Math.max(to, to - this.base + 1e-3)];
  }
  // Wheel: time, about the cursor; over the numbers of a panel: its scale. Drag: through time. Twice clicked: all as it was.
  point(canvas) {
    let drag = null;
    canvas.onpointermove = event => {
      if (!this.traces) return;
      if (drag) {
        const by = (drag.x - event.offsetX) * drag.perPixel;
        if (Math.abs(drag.x - event.offsetX) > 3 || drag.moved) { drag.moved = true; this.holdSpan(drag.from + by, drag.to + by, this.mark ?? undefined); }
      }
      this.traces.cursor = this.traces.timeAt(event.offsetX);
    };
    canvas.onpointerdown = event => {
      if (!this.traces || this.traces.onAxis(event.offsetX)) return;
      const [from, to] = this.span();
      drag = { x: event.offsetX, from, to, perPixel: this.traces.perPixel, moved: false };
      try { canvas.setPointerCapture(event.pointerId); } catch { /* a pointer that is gone */ }
    };
    canvas.onpointerup = canvas.onpointercancel = () => { drag = null; };
    canvas.onpointerleave = () => { if (this.traces && !drag) this.traces.cursor = null; };
    canvas.ondblclick = () => this.reset();
    canvas.addEventListener("wheel", event => {
      if (!this.traces) return;
      event.preventDefault();
      const factor = Math.exp(Math.max(-1, Math.min(1, event.deltaY / 300)));
      const panel = this.traces.panelAt(event.offsetY);
      if (this.traces.onAxis(event.offsetX)) { if (panel) this.traces.zoom(panel, event.offsetY, factor); return; }
      const [from, to] = this.span(), long = Math.min(600, Math.max(SHORTEST_S, (to - from) * factor));
      // What runs goes on running, its right end the newest.
      if (!this.held) { this.base = long; return; }
      const at = Math.min(to, Math.max(from, this.traces.timeAt(event.offsetX))), share = (at - from) / (to - from);
      this.held = { from: at - share * long, to: at + (1 - share) * long };
    }, { passive: false });
  }
  step(by) {
    const [from, to] = this.span();
    this.traces.cursor = Math.min(to, Math.max(from, (this.traces.cursor ?? (from + to) / 2) + by * (to - from) / 200));
  }
  // A trigger has found something.
  fire(time) { if (!this.held && this.trigger === null) this.trigger = time; }
  watchTrigger() {
    const { rows, $ } = this, level = parseFloat($("level").value), around = 1e-3 * parseFloat($("around").value);
    for (let i = Math.max(this.checked, rows.first); i < rows.count && $("trigger").value === "level"; i++) {
      if (Math.abs(rows.error[rows.at(i)]) > level) { this.fire(rows.time[rows.at(i)]); break; }
    }
    this.checked = rows.count;
    if (this.trigger !== null && isFinite(around) && rows.newest >= this.trigger + around) {
      const time = this.trigger;
      this.holdSpan(time - around, time + around, time);
    }
  }
  draw() {
    const [from, to] = this.span(), panels = this.chosen().size;
    // As much room for each of many panels as for one of three.
    if (this.$("traces").dataset.panels !== String(panels)) {
      this.$("traces").dataset.panels = panels;
      this.$("traces").style.height = panels > 3 ? `calc(${panels} * var(--panel))` : "";
    }
    this.traces.draw(from, to, this.mark);
    this.$("cursor").textContent = this.traces.read() ?? "Point at the traces to read values. Wheel: zoom; drag: move; wheel over the numbers: that panel's scale; double click: back.";
    // A panel without data is no choice.
    for (const box of this.$("choices").querySelectorAll("input")) {
      const key = PANELS.find(panel => panel.id === box.value).series[0][0], { rows } = this;
      box.parentElement.hidden = ["length", "area", "gain"].includes(box.value) && rows.count > 0 && !isFinite(rows[key][rows.at(rows.count - 1)]) && !box.checked;
    }
  }
  save(blob, ending) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob); link.download = `${(this.hello?.name ?? "run").replace(/[^\w.-]+/g, "-")}.${ending}`;
    link.click(); setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  }
  saveCsv() {
    const { rows } = this, [from, to] = this.span();
    const columns = ["target", "measured", "error", "command", "zeroFlow", "gain", "length", "area", "wake", "compute"];
    const lines = ["time_s,target_um,bead_um,error_nm,pzt_um,zero_flow_um,gain_ratio,length_um,area_um2,wake_us,compute_us"];
    const say = value => isFinite(value) ? String(+value.toPrecision(9)) : "";
    for (let i = rows.after(from); i < rows.after(to); i++) {
      const k = rows.at(i);
      lines.push([rows.time[k], ...columns.map(name => rows[name][k])].map(say).join(","));
    }
    this.save(new Blob([lines.join("\n"), "\n"], { type: "text/csv" }), "csv");
  }
  // The traces as they are, on a ground of their own, with what they are of: a picture that can be shown by itself.
  picture() {
    const source = this.$("traces"), ratio = window.devicePixelRatio || 1, head = 46 * ratio, foot = 6 * ratio, [from, to] = this.span();
    const canvas = document.createElement("canvas");
    canvas.width = source.width; canvas.height = source.height + head + foot;
    const context = canvas.getContext("2d");
    context.fillStyle = colour("card"); context.fillRect(0, 0, canvas.width, canvas.height);
    context.fillStyle = colour("ink"); context.textBaseline = "top"; context.font = `600 ${15 * ratio}px system-ui, sans-serif`;
    context.fillText(this.hello?.name ?? "run", 10 * ratio, 6 * ratio, canvas.width - 20 * ratio);
    context.fillStyle = colour("quiet"); context.font = `${12 * ratio}px system-ui, sans-serif`;
    context.fillText(`${this.hello?.subtitle ?? ""}; ${from.toFixed(3)} s to ${to.toFixed(3)} s of the run`, 10 * ratio, 26 * ratio, canvas.width - 20 * ratio);
    context.drawImage(source, 0, head);
    return canvas;
  }
  savePng() { this.picture().toBlob(blob => blob && this.save(blob, "png")); }
}
