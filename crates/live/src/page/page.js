// The page: what comes in goes to its place, what is asked goes out.

import { Rows, Wire } from "/wire.js";
import { Traces } from "/trace.js";
import { Lateness, drawCycles, drawSpectrum } from "/spectrum.js";
import { PictureView, drawGauge } from "/picture.js";
import { Clips } from "/clips.js";

const LONGEST_S = 600, MOST_ROWS = 1_200_000, MOST_EVENTS = 500, MOST_CYCLES = 20_000;
const $ = id => document.getElementById(id);
let hello = null, operator = false, rows = new Rows(1024), traces = new Traces($("traces"), rows), lateness = new Lateness();
let state = null, cycles = [], held = null, mark = null, armedTrigger = null, checked = 0, unheard = null;
const picture = new PictureView($("picture")), clips = new Clips($);

const theme = localStorage.getItem("theme");
if (theme) document.documentElement.dataset.theme = theme;
$("theme").onclick = () => {
  const dark = document.documentElement.dataset.theme
    ? document.documentElement.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  document.documentElement.dataset.theme = dark ? "light" : "dark";
  localStorage.setItem("theme", document.documentElement.dataset.theme);
};

function begin(told) {
  // A line that comes back tells the same run again: what is shown stays.
  if (hello && hello.name === told.hello.name) { hello = told.hello; return; }
  hello = told.hello; operator = told.operator;
  const perSecond = 1e6 / hello.period_us;
  rows = new Rows(Math.min(MOST_ROWS, Math.ceil(LONGEST_S * perSecond)));
  traces = new Traces($("traces"), rows); lateness = new Lateness(); cycles = [];
  document.title = `${hello.name} - cellpos`;
  $("name").textContent = hello.name; $("subtitle").textContent = hello.subtitle;
  $("f-bound").textContent = hello.bound_nm === null ? "-" : `${hello.bound_nm.toFixed(1)} nm`;
  for (const id of ["freeze", "resume", "park"]) $(id).hidden = hello.recorded;
  for (const id of ["freeze", "resume", "park", "pause", "skip"]) $(id).disabled = !operator;
  for (const input of document.querySelectorAll("#target-form *, #note-form *")) input.disabled = !operator || hello.recorded;
  $("target-card").hidden = !hello.steered; $("script-card").hidden = !hello.script; $("note-card").hidden = !hello.notes;
  for (const id of ["pause", "skip", "cycles", "cycles-text"]) $(id).hidden = !hello.script || (hello.recorded && !id.startsWith("cycles"));
  $("script-title").textContent = hello.script ? "Script" : "Measurement";
  $("target-label").textContent = hello.by_hand ? "displacement of the PZT, um" : "position, um";
  if (hello.by_hand) document.body.dataset.hand = ""; else delete document.body.dataset.hand;
  $("picture-card").hidden = !hello.pictures;
}

// What led to Safe is held on the screen by itself: the last half second before the PZT began to park.
let faulted = false;
function holdFault(time) {
  if (faulted || hello?.recorded) return;
  faulted = true;
  setTimeout(() => {
    hold(true);
    mark = time; held = { from: time - 0.5, to: time + 0.1 };
    answer("Held: the last half second before the PZT began to park. Hold (space) goes on.");
  }, 400);
}

function show(told) {
  state = told;
  document.body.dataset.state = state.banner.state;
  $("state").textContent = state.banner.state; $("reason").textContent = state.banner.reason;
  $("f-time").textContent = clock(state.time_s);
  $("f-rms").textContent = state.rms_nm === null ? "-" : `${state.rms_nm.toFixed(1)} nm`;
  for (const [id, value, wrong] of [["late", state.late, true], ["skipped", state.skipped, true], ["lost", state.frames_lost, false],
    ["stale", state.stale, true], ["coasted", state.coasted, false], ["records", state.records_lost, true]]) {
    $(`f-${id}`).textContent = value; $(`f-${id}`).parentElement.classList.toggle("bad", wrong && value > 0);
  }
  const parts = [];
  if (state.doing) { parts.push(`${state.doing}.`); $("script-card").hidden = false; }
  if (state.cycle) parts.push(`Cycle ${state.cycle[0]} of ${state.cycle[1]}.`);
  if (state.next) parts.push(`Next: ${state.next}.`);
  if (state.left_s !== null) parts.push(`${clock(state.left_s)} left.`);
  $("script-text").textContent = parts.join(" ");
  $("lateness-text").textContent = state.wake_us === null ? ""
    : `99.9 % of all ticks: wake-up within ${state.wake_us.toFixed(0)} us, computing within ${state.compute_us.toFixed(0)} us.`;
}

function clock(seconds) {
  if (!isFinite(seconds)) return "-";
  const s = Math.max(0, Math.floor(seconds)), pad = n => String(n).padStart(2, "0");
  return `${Math.floor(s / 3600)}:${pad(Math.floor(s / 60) % 60)}:${pad(s % 60)}`;
}

function happened(events) {
  const list = $("events");
  for (const event of events) {
    const item = document.createElement("li"), time = document.createElement("span");
    item.className = event.level; time.textContent = `${event.time_s.toFixed(3)} s`;
    item.append(time, event.text); // text, never markup
    list.prepend(item);
    if (event.level === "fault" && event.text.startsWith("The PZT parks")) holdFault(event.time_s);
    if ($("trigger").value === "event" && event.level !== "info" && !hello?.recorded) fire(event.time_s);
  }
  while (list.childElementCount > MOST_EVENTS) list.lastElementChild.remove();
}

const told = message => {
  if (message.hello) begin(message);
  if (message.state) show(message.state);
  if (message.events) happened(message.events);
  if (message.cycles) {
    const known = cycles.length ? cycles[cycles.length - 1].cycle : 0;
    cycles.push(...message.cycles.filter(c => c.cycle > known));
    cycles.splice(0, Math.max(0, cycles.length - MOST_CYCLES));
  }
  if (message.clips) clips.add(message.clips);
  if (message.unshown !== undefined) { unheard = message.unshown; }
  if (message.refused !== undefined) answer(message.refused);
  if (message.done) answer("Done.");
};

function answer(text) { $("answer").textContent = text; setTimeout(() => { if ($("answer").textContent === text) $("answer").textContent = ""; }, 6000); }

const wire = new Wire({
  told,
  rows: view => { rows.take(view); },
  picture: shown => {
    picture.show(shown);
    $("picture-text").textContent = isFinite(shown.centre[0]) ? (operator && hello?.steered && !hello.by_hand ? "Click to set the target." : "") : "Nothing is followed in this picture.";
  },
  closed: () => {
    if (state?.banner.state === "over") return;
    document.body.dataset.state = "disconnected"; $("state").textContent = "no line";
    $("reason").textContent = "The page has lost the program; it tries again. What is shown is old.";
  },
});

// Stop keys, target, script, note
const ask = request => { if (operator) wire.ask(request); else answer("This link may look only; the operator's link may act."); };
for (const id of ["freeze", "resume", "park", "pause", "skip"]) $(id).onclick = () => ask({ do: id });
const setTarget = um => { if (isFinite(um)) ask({ do: "target", um }); else answer("A target is a number in um, for example -2.5."); };
$("target-form").onsubmit = event => { event.preventDefault(); setTarget(parseFloat($("target").value.replace(",", "."))); };
for (const button of document.querySelectorAll(".step")) {
  button.onclick = () => { if (rows.count) setTarget(+((hello.by_hand ? rows.command : rows.target)[rows.at(rows.count - 1)] + +button.dataset.um).toFixed(6)); };
}
$("picture").onclick = event => { if (operator && hello?.steered && !hello.by_hand) setTarget(+picture.umAt(event).toFixed(3)); };
$("note-form").onsubmit = event => { event.preventDefault(); ask({ do: "note", text: $("note").value }); $("note").value = ""; };

// What is seen: time base, hold, trigger, cursor, export
function hold(on) {
  held = on ? { to: rows.newest } : null; mark = null; armedTrigger = null;
  $("hold").setAttribute("aria-pressed", String(on));
}
function fire(time) { if (!held && armedTrigger === null) armedTrigger = time; }
$("hold").onclick = () => hold(!held);
$("base").onchange = () => { if (held) held = { to: held.to }; };
function span() {
  if (held?.from !== undefined) return [held.from, held.to];
  const to = held ? held.to : rows.newest, base = parseFloat($("base").value);
  return [to - base, Math.max(to, to - base + 1e-3)];
}
function watchTrigger() {
  const level = parseFloat($("level").value), around = 1e-3 * parseFloat($("around").value);
  for (let i = Math.max(checked, rows.first); i < rows.count && $("trigger").value === "level"; i++) {
    if (Math.abs(rows.error[rows.at(i)]) > level) { fire(rows.time[rows.at(i)]); break; }
  }
  checked = rows.count;
  if (armedTrigger !== null && isFinite(around) && rows.newest >= armedTrigger + around) {
    const time = armedTrigger;
    hold(true);
    mark = time; held = { from: time - around, to: time + around };
  }
}
$("traces").onpointermove = event => { traces.cursor = traces.timeAt(event.offsetX); };
$("traces").onpointerleave = () => { traces.cursor = null; };
function save(blob, ending) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob); link.download = `${(hello?.name ?? "run").replace(/[^\w.-]+/g, "-")}.${ending}`;
  link.click(); setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}
$("csv").onclick = () => {
  const [from, to] = span(), lines = ["time_s,target_um,bead_um,error_nm,pzt_um,zero_flow_um,length_um,wake_us,compute_us"];
  const say = value => isFinite(value) ? String(+value.toPrecision(9)) : "";
  for (let i = rows.after(from); i < rows.after(to); i++) {
    const k = rows.at(i);
    lines.push([rows.time[k], rows.target[k], rows.measured[k], rows.error[k], rows.command[k], rows.zeroFlow[k], rows.length[k], rows.wake[k], rows.compute[k]].map(say).join(","));
  }
  save(new Blob([lines.join("\n"), "\n"], { type: "text/csv" }), "csv");
};
$("png").onclick = () => $("traces").toBlob(blob => { if (blob) save(blob, "png"); });

document.onkeydown = event => {
  if (event.ctrlKey || event.altKey || event.metaKey || ["INPUT", "SELECT", "TEXTAREA"].includes(event.target.tagName)) return;
  const key = event.key.toLowerCase(), act = { f: () => ask({ do: "freeze" }), g: () => ask({ do: "resume" }), p: () => ask({ do: "park" }) }[key];
  if (act) { act(); return; }
  if (key === " " && event.target.tagName !== "BUTTON") { event.preventDefault(); hold(!held); }
  if (key === "arrowleft" || key === "arrowright") {
    const [from, to] = span();
    traces.cursor = Math.min(to, Math.max(from, (traces.cursor ?? (from + to) / 2) + (key === "arrowleft" ? -1 : 1) * (to - from) / 200));
    event.preventDefault();
  }
};

// Drawn when there is something to draw, slower where there is more of it.
let drawn = 0, slow = 0;
function draw(now) {
  requestAnimationFrame(draw);
  const [from, to] = span();
  if (now - drawn < (to - from > 60 ? 200 : 40) || !hello) return;
  drawn = now;
  watchTrigger();
  traces.draw(from, to, mark);
  $("cursor").textContent = traces.read() ?? "Point at the traces, or move the cursor with the arrow keys, to read values.";
  if (rows.count) {
    const k = rows.at(rows.count - 1);
    picture.target = rows.target[k];
    drawGauge($("gauge"), hello.range_um, rows.command[k], rows.zeroFlow[k]);
    $("gauge-text").textContent = `PZT ${rows.command[k].toFixed(3)} um`
      + (isFinite(rows.zeroFlow[k]) ? `, at rest at ${rows.zeroFlow[k].toFixed(3)} um` : "");
  }
  lateness.take(rows);
  if (now - slow < 500) return;
  slow = now;
  $("f-unshown").textContent = unheard === null ? rows.missing : `${rows.missing} rows, ${unheard} messages`;
  drawSpectrum($("spectrum"), rows, 1e6 / hello.period_us, hello.bound_spectrum);
  lateness.draw($("lateness"), hello.budget_us);
  if (hello.script) {
    drawCycles($("cycles"), cycles);
    const last = cycles[cycles.length - 1];
    $("cycles-text").textContent = last ? `${last.cycle} cycles done.` : "No cycle is done yet.";
  }
}
requestAnimationFrame(draw);
