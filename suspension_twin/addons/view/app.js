// SPDX-License-Identifier: Apache-2.0
// The page: takes frames from the server, keeps the last seconds, and draws them sixty times a second.

import { Signals, Spectrum, palette, readColours } from "./charts.js";
import { drawMap } from "./map.js";

const $ = (id) => document.getElementById(id);
const KEPT = 12, DELAY = 0.12; // s of signals; s behind the newest sample, so that there is one to move towards
const state = { measured: [], simulated: [], pose: [], joints: [], path: [], events: [], scene: null, spectrum: null, gap: null };
readColours();
const signals = new Signals($("chart")), spectrum = new Spectrum($("spectrum"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { readColours(); spectrum.redraw(); });

// The picture in 3D is loaded where it is asked for: by a wide window, or by its button.
let scene = null;
async function show3d(on) {
  $("scene").hidden = $("view3d").hidden = !on;
  $("scene").parentElement.classList.toggle("flat", !on);
  $("show3d").textContent = on ? "Hide 3D" : "Show 3D";
  $("no3d").hidden = true;
  if (!on || scene) return;
  try {
    const { Scene } = await import("./scene.js");
    scene = new Scene($("scene"), palette);
    if (state.scene) scene.load(state.scene);
  } catch (error) {
    await show3d(false);
    $("no3d").hidden = false;
  }
}
$("show3d").addEventListener("click", () => show3d($("scene").hidden));
show3d(matchMedia("(min-width: 901px)").matches);

// -- frames ----------------------------------------------------------------------------------------

let socket = null, retry = 500;
// The program sends something every second. Where the network went away, a connection neither opens nor closes for
// minutes; counted in seconds of this page, so that one which was asleep or busy gives the connection the same time.
const PATIENCE = 5;
let silent = 0;
setInterval(() => { if (socket && ++silent > PATIENCE) lose(); }, 1000);
function connect() {
  const opened = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws${location.search}`);
  silent = 0;
  opened.onopen = () => { retry = 500; $("link").classList.add("ok"); };
  opened.onmessage = (message) => { silent = 0; take(JSON.parse(message.data)); };
  opened.onclose = lose;
  socket = opened;
}

function lose() {
  socket.onopen = socket.onmessage = socket.onclose = null;
  socket.close();
  socket = null;
  $("link").classList.remove("ok");
  setTimeout(connect, retry);
  retry = Math.min(2 * retry, 5000);
}

function take(frame) {
  if (frame.said !== undefined) return say(frame.said, frame.wrong);
  if (frame.reset) {
    for (const name of ["measured", "simulated", "pose", "joints", "path", "events"]) state[name] = [];
    state.spectrum = null;
    head.t = NaN;
    if (frame.scene && frame.scene.wheels) showScene(frame.scene);
  }
  for (const name of ["measured", "simulated", "pose", "joints"]) {
    if (!frame[name]) continue;
    const rows = state[name];
    rows.push(...frame[name]);
    const oldest = rows.length ? rows[rows.length - 1][0] - KEPT : 0;
    let cut = 0;
    while (cut < rows.length && rows[cut][0] < oldest) cut++;
    if (cut > 200) rows.splice(0, cut);
  }
  if (frame.measured || frame.simulated || frame.reset) signalsDue = true;
  if (frame.path) {
    state.path.push(...frame.path);
    if (state.path.length > 6500) state.path.splice(0, 500);
  }
  if (frame.events) state.events = frame.events;
  if (frame.spectrum) { state.spectrum = frame.spectrum; spectrumDue = true; $("nospectrum").hidden = true; }
  if (frame.gap) showGap(frame.gap);
  if (frame.driven !== undefined) $("driven").textContent = frame.driven === null ? "–" : frame.driven.toFixed(3);
  if (frame.motion) showMotion(frame.motion);
  if (frame.health) showHealth(frame.health);
  if (frame.player !== undefined) showPlayer(frame.player);
  if (frame.record !== undefined) showRecord(frame.record);
  if (frame.job !== undefined) showJob(frame.job);
  if (frame.guide !== undefined) showGuide(frame.guide);
  const rows = state.pose.length ? state.pose : state.measured;
  if (rows.length) latest = rows[rows.length - 1][0];
}

// -- the time that is shown: behind the newest sample, and even although frames are not ---------------

let latest = 0, signalsDue = false, spectrumDue = false;
const head = { t: NaN, rate: 1, wall: 0, seen: [] };
function advance(wall) {
  const dt = Math.min((wall - head.wall) / 1000, 0.25);
  head.wall = wall;
  head.seen.push([wall, latest]);
  while (head.seen.length > 2 && wall - head.seen[0][0] > 1200) head.seen.shift();
  const [w0, t0] = head.seen[0], span = (wall - w0) / 1000;
  if (span > 0.3) head.rate = (latest - t0) / span;
  const wanted = latest - DELAY * Math.max(head.rate, 0.1);
  if (!(Math.abs(wanted - head.t) < 0.6 * Math.max(head.rate, 1))) head.t = wanted;
  else head.t = Math.min(Math.max(head.t, head.t + dt * head.rate + (wanted - head.t) * Math.min(4 * dt, 1)), latest);
}

function between(rows, t) { // the row before t, the one behind it, and the share of the way
  let i = rows.length - 1;
  while (i > 0 && rows[i][0] > t) i--;
  const a = rows[i], b = rows[Math.min(i + 1, rows.length - 1)];
  const k = b[0] > a[0] ? Math.min(Math.max((t - a[0]) / (b[0] - a[0]), 0), 1) : 0;
  return [a, b, k];
}
function poseAt(t) {
  if (!state.pose.length) return null;
  const [a, b, k] = between(state.pose, t), mixed = a.map((v, i) => v + (b[i] - v) * k), p = mixed.slice(1, 4);
  const turned = a.slice(4).reduce((s, v, i) => s + v * b[4 + i], 0) < 0 ? -1 : 1;
  let q = a.slice(4).map((v, i) => v + (turned * b[4 + i] - v) * k);
  const norm = Math.hypot(...q) || 1;
  q = q.map((v) => v / norm);
  return { p, q, yaw: Math.atan2(2 * (q[3] * q[2] + q[0] * q[1]), 1 - 2 * (q[1] * q[1] + q[2] * q[2])) };
}
function jointsAt(t) {
  if (!state.joints.length) return null;
  const [a, b, k] = between(state.joints, t);
  return a.slice(1).map((v, i) => v + (b[i + 1] - v) * k);
}

// A machine that is slow to paint gets as long a rest after each picture: the twin's own nodes run on it, too.
const SLOW = 34; // ms from asking for a picture to its turn, two frames of 60 Hz
let asked = performance.now();
function next() { asked = performance.now(); requestAnimationFrame(picture); }

let before = null, texts = 0, frames = 0;
function picture(wall) {
  const took = performance.now() - asked;
  if (took > SLOW && took < 1000) setTimeout(next, took);
  else next();
  if (document.hidden) return;
  advance(wall);
  frames++;
  const pose = poseAt(head.t), joints = jointsAt(head.t);
  let moved = 0;
  if (pose && before) moved = (pose.p[0] - before.p[0]) * Math.cos(pose.yaw) + (pose.p[1] - before.p[1]) * Math.sin(pose.yaw);
  if (Math.abs(moved) > 5) moved = 0;
  before = pose;
  if (scene && state.scene && !$("scene").hidden) scene.draw(pose, joints, moved);
  if (signalsDue) signals.take(state.measured, state.simulated);
  signalsDue = false;
  signals.draw(Math.max(head.t || 0, 0), state.events);
  if (wall - texts < 100) return;
  texts = wall;
  $("clock").textContent = Math.max(head.t || 0, 0).toFixed(1);
  showTravel(joints);
  const [low, high] = gapLimits();
  drawMap($("map"), state.path, state.events, pose, low, high);
  if (spectrumDue && state.spectrum) spectrum.draw(state.spectrum);
  spectrumDue = false;
}

// -- parts of the page -----------------------------------------------------------------------------

function showScene(given) {
  state.scene = given;
  $("name").textContent = given.name;
  $("model").textContent = [given.model, ...given.effects].join(", ");
  document.title = `${given.name}: suspension twin`;
  if (scene) scene.load(given);
  const travel = $("travel");
  travel.replaceChildren();
  travel.classList.toggle("many", given.wheels.length > 4);
  travel.hidden = !given.wheels.length;
  for (const wheel of given.wheels) {
    const box = document.createElement("div");
    box.innerHTML = '<span></span><br><b>–</b> <span></span><div class="rail"><i></i></div>';
    box.children[0].textContent = given.wheels.length > 4 ? wheel.name.replace(" road wheel", "") : wheel.name;
    box.children[3].textContent = wheel.kind === "prismatic" ? "mm" : "°";
    travel.append(box);
  }
}

function showTravel(joints) {
  if (!joints || !state.scene) return;
  state.scene.wheels.forEach((wheel, i) => {
    const box = $("travel").children[i], d = (joints[i] - wheel.standing) * (wheel.kind === "prismatic" ? 1000 : 180 / Math.PI);
    if (!box || !Number.isFinite(d)) return;
    const text = d.toFixed(wheel.kind === "prismatic" ? 0 : 1);
    box.querySelector("b").textContent = +text === 0 ? "0" : d > 0 ? `+${text}` : text;
    const share = Math.min(Math.abs(d) / (wheel.kind === "prismatic" ? 80 : 25), 1) * 50, bar = box.querySelector("i");
    bar.style.left = `${d > 0 ? 50 : 50 - share}%`;
    bar.style.width = `${share}%`;
  });
}

function gapLimits() { // of the map's colours: from the floor to four times that
  const floor = (state.gap && state.gap.calibrated && state.gap.floor) || null;
  const known = floor ? [] : state.path.map((p) => p[2]).filter((v) => v >= 0).sort((a, b) => a - b);
  const low = floor || known[known.length >> 1] || 0.1;
  $("lowgap").textContent = low.toFixed(2);
  $("highgap").textContent = `${(4 * low).toFixed(2)} m/s²`;
  return [low, 4 * low];
}

function showGap(gap) {
  state.gap = gap;
  $("window").textContent = gap.window.toFixed(0);
  $("gap").textContent = gap.rms.toFixed(2);
  const parts = [];
  if (gap.measured > 0) parts.push(`${((100 * gap.rms) / gap.measured).toFixed(0)} % of the measured ${gap.measured.toFixed(2)}`);
  if (gap.normalised) parts.push(`${gap.normalised.toFixed(1)} × ${gap.calibrated ? "the calibration's residual" : "the noise"}`);
  $("times").textContent = parts.join(", ");
  const bands = $("bands"), most = Math.max(gap.rms, 1e-9);
  const rest = Math.sqrt(Math.max(gap.rms ** 2 - gap.bands.reduce((sum, band) => sum + band[2] ** 2, 0), 0));
  const rows = [...gap.bands.map(([low, high, rms]) => [`${low} to ${high} Hz`, rms]), ["other", rest]];
  bands.title = "The squares of all rows add up to the square of the gap.";
  while (bands.children.length > rows.length) bands.lastChild.remove();
  rows.forEach(([label, rms], i) => {
    if (!bands.children[i]) {
      const row = document.createElement("div");
      row.className = "band";
      row.innerHTML = '<span></span><div class="bar"><i></i></div><span></span>';
      bands.append(row);
    }
    const [name, bar, value] = bands.children[i].children;
    name.textContent = label;
    bar.firstChild.style.width = `${Math.min((100 * rms) / most, 100)}%`;
    value.textContent = rms.toFixed(2);
  });
}

function showMotion(motion) {
  $("speed").textContent = motion.speed === null ? "–" : Math.abs(3.6 * motion.speed).toFixed(0);
  $("advice").textContent = motion.advice;
  $("advice").classList.toggle("warn", motion.level > 0);
}

// Nodes by name, each with its inputs below it, and sources with what they say of themselves.
function showHealth(statuses) {
  const groups = new Map(), open = new Set([...document.querySelectorAll("#health details[open]")].map((d) => d.dataset.name));
  for (const status of statuses) {
    const [name, input] = status.name.split(/:\s+/, 2);
    if (!groups.has(name)) groups.set(name, { level: 0, says: [], rates: [], rows: [] });
    const group = groups.get(name), rate = status.values["rate (Hz)"];
    // a silent topic is stale, and a warning; a thing that is not known yet is neither
    const level = status.level < 3 || !input ? status.level : status.values.messages === undefined ? 0 : 1;
    group.level = Math.max(group.level, level);
    if (!input && status.level > 0) group.says.push([status.level, status.message]);
    if (input && rate !== undefined && status.values.messages !== "0") group.rates.push(`${input.replace("vertical_acceleration", "vertical")} ${rate === "" ? "–" : Math.round(+rate)}`);
    for (const [key, value] of Object.entries(status.values)) if (value !== "") group.rows.push([input ? `${input}: ${key}` : key, value]);
  }
  const box = $("health");
  box.replaceChildren();
  for (const [name, group] of groups) {
    const details = document.createElement("details"), summary = document.createElement("summary"), dot = document.createElement("span");
    details.dataset.name = name;
    details.open = open.has(name);
    dot.className = `dot l${group.level}`;
    const label = document.createElement("b"), rates = document.createElement("span");
    label.textContent = name;
    rates.className = "rates";
    rates.textContent = group.rates.length ? `${group.rates.slice(0, 3).join(", ")} Hz` : "";
    summary.append(dot, label, rates);
    details.append(summary);
    const table = document.createElement("table");
    for (const [key, value] of group.rows) {
      const row = table.insertRow();
      row.insertCell().textContent = key;
      row.insertCell().textContent = value;
    }
    details.append(table);
    box.append(details);
    for (const [level, text] of group.says) {
      const line = document.createElement("div");
      line.className = `says l${level}`;
      line.textContent = text;
      box.append(line);
    }
  }
}

let dragging = false;
function showPlayer(player) {
  $("player").hidden = !player;
  if (!player) return;
  const bar = $("bar");
  bar.max = player.duration;
  if (!dragging) bar.value = player.position;
  $("position").textContent = `${player.position.toFixed(1)} / ${player.duration.toFixed(1)} s`;
  const resting = player.paused || player.ended || player.waiting;
  $("pause").textContent = player.ended ? "Again" : player.waiting ? "Start" : player.paused ? "Play" : "Pause";
  $("pause").dataset.do = player.ended ? "again" : resting ? "play" : "pause";
  const pace = $("pace");
  if (document.activeElement !== pace && player.rate !== null) {
    const text = String(player.rate);
    if (![...pace.options].some((o) => o.value === text)) pace.add(new Option(`${text} ×`, text));
    pace.value = text;
  }
}

function showRecord(record) {
  $("record").classList.toggle("on", record.on);
  $("record").lastChild.textContent = record.on ? `${record.seconds.toFixed(0)} s` : "Record";
  $("record").disabled = record.on;
  $("stop").disabled = !record.on;
  $("record").title = record.path || "";
}

function showJob(job) {
  $("job").hidden = !job;
  $("calibrate").disabled = $("diagnose").disabled = Boolean(job && job.running);
  $("load").disabled = !(job && job.result);
  if (!job) return;
  $("jobtext").replaceChildren(job.text);
  if (job.report) {
    const link = document.createElement("a");
    link.href = "report";
    link.target = "_blank";
    link.textContent = "Open the report";
    $("jobtext").append(" ", link);
  }
  const bar = $("jobbar");
  bar.hidden = !job.running;
  $("cancel").hidden = !job.running;
  if (job.progress === null) bar.removeAttribute("value");
  else bar.value = job.progress;
}

function showGuide(steps) { // of the first drive, the one that is next in colour
  $("guide").hidden = !steps;
  $("first").textContent = steps && steps.some((s) => s.state === "now") ? "End drive" : steps ? "Close drive" : "First drive";
  $("steps").replaceChildren(...(steps || []).map((step) => {
    const item = document.createElement("li"), title = document.createElement("b"), text = document.createElement("span");
    item.className = `step-${step.state}`;
    title.textContent = step.title;
    text.textContent = step.text;
    item.append(title, " ", text);
    return item;
  }));
}

let silence = 0;
function say(text, wrong) {
  const box = $("said");
  box.textContent = text;
  box.hidden = !text;
  box.classList.toggle("wrong", wrong);
  clearTimeout(silence);
  silence = setTimeout(() => { box.hidden = true; }, wrong ? 15000 : 6000);
}

function ask(what, value) {
  if (!socket || socket.readyState !== 1) return say("Not connected: is the program still running?", true);
  socket.send(JSON.stringify(value === undefined ? { do: what } : { do: what, value }));
}
for (const button of document.querySelectorAll("button[data-do]"))
  button.addEventListener("click", () => {
    const what = button.dataset.do;
    if (what === "again") ask("seek", 0);
    else ask(what);
  });
$("bar").addEventListener("input", () => { dragging = true; });
$("bar").addEventListener("change", () => { dragging = false; ask("seek", +$("bar").value); });
$("pace").addEventListener("change", () => { ask("speed", +$("pace").value); $("pace").blur(); });
const VIEWS = [["Side view", 0.62, 0.24], ["Top view", 1.5707, 0.06], ["Chase view", 0, 1.35]];
let view = 0;
$("view3d").addEventListener("click", () => {
  view = (view + 1) % VIEWS.length;
  if (scene) [, scene.turn, scene.tilt] = VIEWS[view];
  $("view3d").textContent = VIEWS[view][0];
});

// For a test or a curious reader: what is shown at the moment.
window.twin = { state, head, frames: () => frames };
connect();
next();
