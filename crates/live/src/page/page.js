// The page: what comes in goes to its place, what is asked goes out.

import { Rows, Wire } from "/wire.js";
import { Traces } from "/trace.js";
import { Lateness, drawCycles, drawSpectrum } from "/spectrum.js";
import { PictureView, drawGauge } from "/picture.js";
import { Clips } from "/clips.js";
import { TraceView } from "/view.js";
import { Sound, themes } from "/theme.js";

const LONGEST_S = 600, MOST_ROWS = 1_200_000, MOST_EVENTS = 500, MOST_CYCLES = 20_000;
// What an ending is called on the banner.
const ENDINGS = { done: "run over", stopped: "stopped", "not-kept": "bead not kept", safe: "safe", failed: "failed" };
const $ = id => document.getElementById(id);
let hello = null, operator = false, rows = new Rows(1024), traces = new Traces($("traces"), rows), lateness = new Lateness();
let state = null, cycles = [], unheard = null;
const picture = new PictureView($("picture"), $("inset")), clips = new Clips($), view = new TraceView($), sound = new Sound($("sound"));
view.begin({}, rows, traces);
themes($("theme"));

function begin(told) {
  // A line that comes back tells the same run again: what is shown stays.
  if (hello && hello.name === told.hello.name) { hello = told.hello; return; }
  hello = told.hello; operator = told.operator;
  const perSecond = 1e6 / hello.period_us;
  rows = new Rows(Math.min(MOST_ROWS, Math.ceil(LONGEST_S * perSecond)), perSecond);
  traces = new Traces($("traces"), rows); lateness = new Lateness(); cycles = [];
  view.begin(hello, rows, traces);
  document.title = `${hello.name} - cellpos`;
  $("name").textContent = hello.name; $("subtitle").textContent = hello.subtitle;
  for (const id of ["freeze", "resume", "park"]) $(id).hidden = hello.recorded;
  for (const input of document.querySelectorAll("#target-form *, #note-form *")) input.disabled = !operator || hello.recorded;
  $("target-card").hidden = !hello.steered; $("script-card").hidden = !hello.script; $("note-card").hidden = !hello.notes;
  for (const id of ["pause", "skip", "cycles", "cycles-text"]) $(id).hidden = !hello.script || (hello.recorded && !id.startsWith("cycles"));
  $("script-title").textContent = hello.script ? "Script" : "Measurement";
  $("target-label").textContent = hello.by_hand ? "displacement of the PZT, µm" : `position of the ${what()}, µm`;
  if (hello.by_hand) document.body.dataset.hand = ""; else delete document.body.dataset.hand;
  $("picture-card").hidden = !hello.pictures; $("inset-card").hidden = !hello.pictures;
  buttons();
}

// The program's sentences as this page says them: µ where there is one, and the cell where a cell is followed. What a person wrote
// stays as it was written.
function words(text) {
  if (/^(Note|Mark): /.test(text)) return text;
  const set = text.replace(/(^|[\s\d(])um(?=[\s),.;:/]|$)/g, "$1µm").replace(/(\d ?)us(?=[\s),.;:]|$)/g, "$1µs").replaceAll("+-", "±");
  return hello?.cell ? set.replace(/\bbead\b/g, "cell").replace(/\bBead\b/g, "Cell") : set;
}

function what() { return hello?.cell ? "cell" : "bead"; }

// What can be asked for now.
function buttons() {
  const over = Boolean(state?.last_word), frozen = ["frozen", "paused"].includes(state?.banner.state);
  for (const id of ["freeze", "resume", "park", "pause", "skip"]) $(id).disabled = !operator || over;
  $("pause").textContent = frozen ? "Go on" : "Pause";
}

// The way to Safe is held on the screen: half a second of it, from the last position of the bead.
let faulted = false;
function holdFault(time) {
  if (faulted || hello?.recorded) return;
  faulted = true;
  setTimeout(() => {
    // Of a bead that was lost, the last that was seen of it is shown too.
    let seen = time;
    for (let i = rows.after(time) - 1; i >= rows.first; i--) if (isFinite(rows.measured[rows.at(i)])) { seen = rows.time[rows.at(i)]; break; }
    view.holdSpan(Math.min(time, seen) - 0.5, time + 0.1, time);
    answer("Held: what came before the PZT began to park. Hold (space) goes on.", "view-answer");
  }, 400);
}

function show(told) {
  const before = state;
  state = told;
  const word = state.last_word;
  // Without a line the picture of that stays, unless this is the last word.
  document.body.dataset.state = state.banner.state;
  $("state").textContent = word && state.banner.state !== "disconnected" ? ENDINGS[word.how] : state.banner.state === "disconnected" ? "no line" : state.banner.state;
  $("reason").textContent = words(state.banner.reason);
  $("last-word").hidden = !word;
  $("to-do").textContent = word?.to_do ? words(`${word.to_do}.`) : "";
  $("pzt-word").textContent = words(word?.pzt ?? "");
  if (word && !before?.last_word) sound.play(word.how === "done" || word.how === "stopped" ? "warning" : "fault");
  else if (!word && state.banner.state === "safe" && before?.banner.state !== "safe") sound.play("fault");
  buttons();
  $("f-bound").textContent = state.bound_nm === null ? "-" : `${state.bound_nm.toFixed(1)} nm`;
  traces.bound = state.bound_nm;
  // The counters below are those of the record up to this tick.
  document.body.dataset.ticks = state.ticks;
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
  $("script-text").textContent = words(parts.join(" "));
  $("lateness-text").textContent = state.wake_us === null ? ""
    : `99.9 % of all ticks: wake-up within ${state.wake_us.toFixed(0)} µs, computing within ${state.compute_us.toFixed(0)} µs.`;
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
    item.append(time, words(event.text)); // text, never markup
    list.prepend(item);
    if (event.level !== "info" && !hello?.recorded && events.length < 20) sound.play(event.level);
    if (event.level === "fault" && event.text.startsWith("The PZT parks")) holdFault(event.time_s);
    if ($("trigger").value === "event" && event.level !== "info" && !hello?.recorded) view.fire(event.time_s);
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
};

// An answer stands at the field that it is the answer to.
function answer(text, where, good) {
  const place = $(where) ?? $("stop-answer");
  place.textContent = text; place.classList.toggle("good", Boolean(good));
  clearTimeout(place.timer);
  place.timer = setTimeout(() => { place.textContent = ""; }, good ? 3000 : 12_000);
}

const wire = new Wire({
  told,
  answered: (refused, where) => answer(words(refused || "Done."), where, !refused),
  rows: fresh => { rows.take(fresh); },
  picture: shown => {
    picture.show(shown);
    const click = operator && hello?.steered && !hello.by_hand && !state?.last_word ? "Click to set the target; drag to measure." : "Drag to measure.";
    $("picture-text").textContent = isFinite(shown.centre[0]) ? click : `No ${what()} is followed in this picture.`;
  },
  closed: () => {
    // The last word of a run stays; a line that breaks without one is another matter.
    if (state?.last_word) { document.body.dataset.gone = ""; return !hello.recorded; }
    document.body.dataset.state = "disconnected"; $("state").textContent = "no line";
    $("reason").textContent = "The program is gone or cannot be reached, and left no last word. What is shown is old; the page tries again. "
      + "A board that gets no commands holds the bead and parks the PZT by its own watchdog.";
    sound.play("fault");
    return false;
  },
});

// Stop keys, target, script, note
const ask = (request, where) => {
  if (operator) wire.ask(request, where);
  else answer("This link may look only; the operator's link may act.", where);
};
for (const id of ["freeze", "resume", "park"]) $(id).onclick = () => ask({ do: id }, "stop-answer");
$("pause").onclick = () => ask({ do: ["frozen", "paused"].includes(state?.banner.state) ? "resume" : "pause" }, "script-answer");
$("skip").onclick = () => ask({ do: "skip" }, "script-answer");
const setTarget = um => {
  if (isFinite(um)) ask({ do: "target", um }, "target-answer"); else answer("A target is a number in µm, for example -2.5.", "target-answer");
};
$("target-form").onsubmit = event => { event.preventDefault(); setTarget(parseFloat($("target").value.replace(",", "."))); };
for (const button of document.querySelectorAll(".step")) {
  button.onclick = () => { if (rows.count) setTarget(+((hello.by_hand ? rows.command : rows.target)[rows.at(rows.count - 1)] + +button.dataset.um).toFixed(6)); };
}
$("note-form").onsubmit = event => { event.preventDefault(); ask({ do: "note", text: $("note").value }, "note-answer"); $("note").value = ""; };

// The picture: a click sets the target, a drag measures.
let pressed = null;
$("picture").onpointerdown = event => {
  if (!picture.picture) return;
  pressed = { at: picture.pxAt(event), x: event.clientX, y: event.clientY, moved: false };
  try { $("picture").setPointerCapture(event.pointerId); } catch { /* a pointer that is gone */ }
};
$("picture").onpointermove = event => {
  if (!pressed) return;
  pressed.moved ||= Math.hypot(event.clientX - pressed.x, event.clientY - pressed.y) > 4;
  if (pressed.moved) $("ruler-text").textContent = picture.measure(pressed.at, picture.pxAt(event));
};
$("picture").onpointerup = event => {
  if (pressed && !pressed.moved) {
    if (picture.ruler) $("ruler-text").textContent = picture.measure(null);
    else if (operator && hello?.steered && !hello.by_hand) setTarget(+picture.umAt(event).toFixed(3));
  }
  pressed = null;
};
function toggle(id, name) {
  picture[name] = !picture[name];
  $(id).setAttribute("aria-pressed", String(picture[name]));
  picture.draw();
}
$("overlay").onclick = () => toggle("overlay", "overlay");
$("contrast").onclick = () => toggle("contrast", "stretch");
addEventListener("resize", () => picture.draw());

document.onkeydown = event => {
  if (event.ctrlKey || event.altKey || event.metaKey || event.target.matches("input:not([type=checkbox], [type=range]), select, textarea")) return;
  const key = event.key.toLowerCase();
  const stop = { f: "freeze", g: "resume", p: "park" }[key];
  if (stop && !event.repeat && hello && !hello.recorded && !state?.last_word) ask({ do: stop }, "stop-answer");
  if (key === "o") toggle("overlay", "overlay");
  if (key === "c") toggle("contrast", "stretch");
  if (key === " " && event.target.tagName !== "BUTTON") { event.preventDefault(); view.hold(!view.held); }
  if (key === "arrowleft" || key === "arrowright") { view.step(key === "arrowleft" ? -1 : 1); event.preventDefault(); }
};

// Drawn when there is something to draw, slower where there is more of it.
let drawn = 0, slow = 0;
function draw(now) {
  requestAnimationFrame(draw);
  const [from, to] = view.span();
  if (now - drawn < (to - from > 60 ? 200 : 40) || !hello) return;
  drawn = now;
  view.watchTrigger();
  view.draw();
  if (rows.count) {
    const k = rows.at(rows.count - 1);
    picture.target = hello.by_hand ? NaN : rows.target[k];
    drawGauge($("gauge"), hello.range_um, rows.command[k], rows.zeroFlow[k]);
    $("gauge-text").dataset.seq = rows.lastSeq;
    $("gauge-text").textContent = `PZT ${rows.command[k].toFixed(3)} µm`
      + (isFinite(rows.zeroFlow[k]) ? `, at rest at ${rows.zeroFlow[k].toFixed(3)} µm` : "");
  }
  lateness.take(rows);
  if (now - slow < 500) return;
  slow = now;
  $("f-unshown").textContent = unheard === null ? rows.missing : `${rows.missing} rows, ${unheard} messages`;
  drawSpectrum($("spectrum"), rows, 1e6 / hello.period_us, hello.predicted_spectrum, state?.fix_noise_nm);
  lateness.draw($("lateness"), hello.budget_us);
  document.body.dataset.held = rows.newest - rows.oldest;
  document.body.dataset.painted = document.documentElement.dataset.theme ?? "auto";
  if (hello.script) {
    drawCycles($("cycles"), cycles);
    const last = cycles[cycles.length - 1];
    $("cycles-text").textContent = last ? `${last.cycle} cycles done.` : "No cycle is done yet.";
  }
}
requestAnimationFrame(draw);
