"use strict";
// One state, drawn whenever the server tells a newer one; a picture is asked for after each frame.
const $ = (id) => document.getElementById(id);
const COLOURS = { red: "#ff6b6b", green: "#63c98c", blue: "#6d9bf2", grey: "#d0d4d9" };
const PARTS = [1, 1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 32, 1 / 64];
const view = { kind: "colour", x: 0.5, y: 0.5, level: 0, marked: true, bright: false };
let state = { version: 0 };
let loading = false, wanted = false, best = 0, times = [];

async function ask(path, options) {
  const answer = await fetch(path, { cache: "no-store", ...options });
  if (!answer.ok) throw new Error((await answer.text()).trim());
  return answer;
}

async function act(name, values = {}) {
  try {
    await ask("do/" + name, {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(values),
    });
    complain("");
  } catch (fault) { complain(fault.message); }
}

let complaint = "";
function complain(text) { complaint = text; drawTrouble(); }

function drawTrouble() {
  const lines = [complaint, ...Object.values(state.trouble || {})].filter(Boolean);
  $("trouble").hidden = lines.length === 0;
  $("trouble").textContent = lines.join("; ");
}

async function follow() {
  for (;;) {
    try {
      const told = await (await ask("state?after=" + state.version)).json();
      $("lost").hidden = true;
      const fresh = told.frame !== state.frame;
      state = told;
      draw();
      if (fresh) show();
    } catch (fault) {
      $("lost").hidden = false;
      await new Promise((done) => setTimeout(done, 1000));
    }
  }
}

async function show() {
  if (loading) { wanted = true; return; }
  loading = true;
  const box = $("stage").getBoundingClientRect();
  const scale = window.devicePixelRatio || 1;
  const px = Math.max(16, Math.min(1600, Math.round(Math.max(box.width, box.height) * scale)));
  const query = new URLSearchParams({
    kind: view.kind, x: view.x, y: view.y, part: PARTS[view.level], marked: view.marked ? 1 : 0, bright: view.bright ? 1 : 0, px,
  });
  try {
    const blob = await (await ask("picture.jpg?" + query)).blob();
    const before = $("picture").src;
    $("picture").src = URL.createObjectURL(blob);
    if (before) URL.revokeObjectURL(before);
    $("picture").dataset.frame = state.frame;
  } catch (fault) { /* the next state tells why */ }
  loading = false;
  if (wanted) { wanted = false; show(); }
}

function draw() {
  const { figures, settings } = state;
  drawTrouble();
  $("camera").textContent = `${settings.camera}, ${settings.shape[0]}x${settings.shape[1]} ${settings.cfa}`;
  $("read-only").hidden = !state.read_only;
  for (const one of document.querySelectorAll(".acts")) one.disabled = state.read_only;
  $("frame").textContent = state.frame ? `frame ${state.frame}` : "waiting for the first frame";
  drawSetting("exposure", 1e3 * settings.exposure_s, settings.exposure_limits_s.map((s) => 1e3 * s), "ms");
  drawSetting("gain", settings.gain, settings.gain_limits, "");
  drawTargets();
  drawAxes();
  $("zoom").textContent = `${Math.round(1 / PARTS[view.level])}x`;
  if (!figures) return;
  const now = performance.now();
  if (times.at(-1)?.frame !== state.frame) times.push({ frame: state.frame, now });
  times = times.filter((one) => now - one.now < 3000);
  const rate = times.length > 1
    ? (times.at(-1).frame - times[0].frame) * 1000 / (times.at(-1).now - times[0].now) : 0;
  $("rate").textContent = rate ? `${rate.toFixed(1)} frames/s` : "";
  drawHistogram(figures.histogram);
  drawLevels(figures);
  best = Math.max(best, figures.focus);
  $("focus").textContent = figures.focus.toPrecision(3);
  $("focus-best").textContent = `${Math.round(100 * figures.focus / best)} % of the best`;
  const mask = figures.alignment;
  $("rotation").textContent = `${mask.rotation_deg.toFixed(3)}\u00b0`;
  $("straightness").textContent = `straight edges ${Math.round(100 * mask.straightness)} %`;
  $("shift").textContent = mask.shift_px
    ? `x ${mask.shift_px[0].toFixed(2)}, y ${mask.shift_px[1].toFixed(2)} px` : "no reference";
  $("match").textContent = mask.shift_px ? `match ${Math.round(100 * mask.match)} %` : "";
  $("take").textContent = state.reference ? "forget the reference" : "measure shifts from here";
}

function drawSetting(id, value, limits, unit) {
  const field = $(id);
  // What somebody types stays until it is sent.
  if (document.activeElement !== field && !field.dataset.typed) field.value = Number(value.toPrecision(4));
  const fixed = limits[0] === limits[1];
  const shown = (limit) => unit === "ms" && limit >= 1000
    ? `${Number((limit / 1000).toPrecision(3))} s` : `${Number(limit.toPrecision(3))} ${unit}`;
  field.disabled = fixed || state.read_only;
  field.form.querySelector("button").disabled = field.disabled;
  $(id + "-limits").textContent = fixed ? "fixed"
    : `${shown(limits[0])} to ${shown(limits[1])}`;
}

function drawHistogram(counts) {
  const canvas = $("histogram"), pen = canvas.getContext("2d");
  const { width, height } = canvas;
  pen.clearRect(0, 0, width, height);
  for (const [name, row] of Object.entries(counts)) {
    const top = Math.log1p(Math.max(...row, 1));
    pen.beginPath();
    pen.moveTo(0, height);
    row.forEach((count, i) => {
      const y = height - (height - 4) * Math.log1p(count) / top;
      pen.lineTo(i * width / row.length, y);
      pen.lineTo((i + 1) * width / row.length, y);
    });
    pen.lineTo(width, height);
    pen.fillStyle = COLOURS[name] + "44";
    pen.strokeStyle = COLOURS[name];
    pen.fill();
    pen.stroke();
  }
}

function drawLevels(figures) {
  const rows = Object.entries(figures.brightest).map(([name, level]) => [
    name, `${(100 * level).toFixed(1)} %`, level >= 0.999 ? "saturated" : "of white", level >= 0.999,
  ]);
  rows.push(["saturated", `${(100 * figures.saturated).toFixed(2)} %`, "of the pixels", figures.saturated > 0]);
  fill($("levels"), rows.map(([name, value, note, bad]) => {
    const row = document.createElement("tr");
    row.append(cell("th", name), cell("td", value, bad ? "bad" : ""), cell("td", note, "quiet"));
    return row;
  }));
}

function cell(kind, text, style = "") {
  const made = document.createElement(kind);
  made.textContent = text;
  if (style) made.className = style;
  return made;
}

function fill(parent, children) { parent.replaceChildren(...children); }

function button(text, call, label, off = false) {
  const made = cell("button", text);
  made.disabled = off;
  if (label) { made.title = label; made.setAttribute("aria-label", label); }
  made.addEventListener("click", call);
  return made;
}

let drawnTargets = "";
function drawTargets() {
  const key = JSON.stringify([state.targets, state.read_only]);
  if (key === drawnTargets) return;
  drawnTargets = key;
  fill($("targets"), state.targets.map((target) =>
    button("look at the " + target, () => act("look", { target }), "", state.read_only)));
}

let drawnAxes = "";
function drawAxes() {
  const axes = Object.entries(state.axes);
  $("axes-section").hidden = axes.length === 0;
  $("busy").textContent = state.busy;
  const key = JSON.stringify([state.axes, state.busy, state.read_only]);
  if (key === drawnAxes) return;
  drawnAxes = key;
  const off = state.read_only || state.busy !== "";
  $("home").disabled = $("centre").disabled = off;
  $("centre").hidden = Object.keys(state.centre_um).length === 0;
  fill($("axes"), axes.map(([axis, told]) => {
    const row = document.createElement("tr"), last = document.createElement("td");
    const known = told.position_um !== null;
    const step = (sign) => () => act("jog", { axis, distance_um: sign * number($("step")) });
    last.append(button("\u2212", step(-1), `${axis} down`, off || !known), " ",
      button("+", step(1), `${axis} up`, off || !known));
    row.dataset.axis = axis;
    row.append(cell("th", axis), cell("td", known ? told.position_um.toFixed(2) + " um" : "not homed"), last);
    return row;
  }));
}

function number(field) {
  const value = Number(field.value.replace(",", "."));
  return field.value.trim() === "" || Number.isNaN(value) ? field.value : value;
}

function zoom(by, x = view.x, y = view.y) {
  view.level = Math.max(0, Math.min(PARTS.length - 1, view.level + by));
  const half = PARTS[view.level] / 2;
  view.x = Math.max(half, Math.min(1 - half, x));
  view.y = Math.max(half, Math.min(1 - half, y));
  $("zoom").textContent = `${Math.round(1 / PARTS[view.level])}x`;
  show();
}

// Where in the frame a place on the screen is: the picture is centred, its bars are outside it.
function place(event) {
  const box = $("stage").getBoundingClientRect(), image = $("picture");
  const scale = Math.min(box.width / image.naturalWidth, box.height / image.naturalHeight) || 1;
  const part = PARTS[view.level];
  const across = (event.clientX - box.left - box.width / 2) / (image.naturalWidth * scale || 1);
  const down = (event.clientY - box.top - box.height / 2) / (image.naturalHeight * scale || 1);
  return [view.x + part * across, view.y + part * down];
}

for (const one of document.querySelectorAll("[data-kind]")) {
  one.addEventListener("click", () => {
    view.kind = one.dataset.kind;
    for (const other of document.querySelectorAll("[data-kind]"))
      other.setAttribute("aria-pressed", other === one);
    show();
  });
}
for (const name of ["marked", "bright"])
  $(name).addEventListener("change", () => { view[name] = $(name).checked; show(); });
$("closer").addEventListener("click", () => zoom(1));
$("farther").addEventListener("click", () => zoom(-1));
$("whole").addEventListener("click", () => zoom(-PARTS.length));
$("stage").addEventListener("dblclick", (event) => zoom(1, ...place(event)));
$("stage").addEventListener("wheel", (event) => {
  event.preventDefault();
  const [x, y] = place(event);
  const before = PARTS[view.level];
  const by = event.deltaY < 0 ? 1 : -1;
  const after = PARTS[Math.max(0, Math.min(PARTS.length - 1, view.level + by))];
  // The place under the pointer stays there.
  zoom(by, x + (view.x - x) * after / before, y + (view.y - y) * after / before);
}, { passive: false });
let held = null;
$("stage").addEventListener("pointerdown", (event) => {
  held = { at: place(event), x: view.x, y: view.y };
  $("stage").setPointerCapture(event.pointerId);
  $("stage").classList.add("held");
});
$("stage").addEventListener("pointermove", (event) => {
  if (!held) return;
  const [x, y] = place(event);
  zoom(0, view.x + held.at[0] - x, view.y + held.at[1] - y);
});
for (const end of ["pointerup", "pointercancel"])
  $("stage").addEventListener(end, () => { held = null; $("stage").classList.remove("held"); });
for (const [id, send] of [
  ["exposure", (ms) => act("exposure", { seconds: typeof ms === "number" ? ms / 1e3 : ms })],
  ["gain", (factor) => act("gain", { factor })],
]) {
  const field = $(id);
  for (const change of ["input", "change"])
    field.addEventListener(change, () => { field.dataset.typed = "yes"; });
  field.form.addEventListener("submit", (event) => {
    event.preventDefault();
    send(number(field));
    delete field.dataset.typed;
    field.blur();
  });
}
$("take").addEventListener("click", () => act("reference", { taken: !state.reference }));
$("home").addEventListener("click", () => act("home"));
$("centre").addEventListener("click", () => act("centre"));
$("stop").addEventListener("click", () => act("stop"));
window.addEventListener("resize", show);
follow();
