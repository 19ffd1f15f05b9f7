"use strict";
// The page to set up by: a picture is asked for after each frame.
const COLOURS = { red: "#ff6b6b", green: "#63c98c", blue: "#6d9bf2", grey: "#d0d4d9" };
const PARTS = [1, 1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 32, 1 / 64];
const WIDTHS = [400, 800, 1200, 1600]; // few sizes, so that pages share what is encoded
const THIRD_STOP = 2 ** (1 / 3);
const ACTIONS = { centre: "centre the mask", autoexpose: "expose automatically" };
const view = { x: 0.5, y: 0.5, level: 0, marked: true, bright: false };
let times = [];

function show() {
  if (onField() || !state.frame) return; // none before the first frame
  const box = $("stage").getBoundingClientRect();
  const wide = Math.max(box.width, box.height) * (window.devicePixelRatio || 1);
  const px = WIDTHS.find((width) => width >= wide) || WIDTHS.at(-1);
  const query = new URLSearchParams({
    kind: shownKind, x: view.x, y: view.y, part: PARTS[view.level], marked: view.marked ? 1 : 0, bright: view.bright ? 1 : 0, px,
  });
  load("picture.jpg?" + query, show);
}

function draw() {
  const { figures, settings } = state;
  drawHint();
  drawWhy();
  const exposing = state.exposing;
  $("exposing").hidden = !exposing;
  if (exposing) write("exposing-text", `exposing, ${Math.ceil(exposing.left_s)} s left of ${Number(exposing.exposure_s.toPrecision(3))}`);
  write("camera", `${settings.camera}, ${settings.shape[0]}x${settings.shape[1]} ${settings.cfa}`);
  each(".acts", (button) => { button.disabled = state.read_only; });
  write("frame", state.frame ? `frame ${state.frame}` : "waiting for the first frame");
  drawSetting("exposure", 1e3 * settings.exposure_s, settings.exposure_limits_s.map((s) => 1e3 * s), "ms");
  drawSetting("gain", settings.gain, settings.gain_limits, "");
  drawWants();
  drawTargets();
  drawAxes();
  drawSteps();
  write("zoom", `${Math.round(1 / PARTS[view.level])}x`);
  drawMask();
  if (!figures) return;
  const now = performance.now();
  if (times.at(-1)?.frame !== state.frame) times.push({ frame: state.frame, now });
  times = times.filter((time) => now - time.now < 3000);
  const rate = times.length > 1
    ? (times.at(-1).frame - times[0].frame) * 1000 / (times.at(-1).now - times[0].now) : 0;
  write("rate", rate && !state.trouble.camera ? `${rate.toFixed(1)} frames/s` : "");
  drawHistogram(figures);
  drawLevels(figures);
  const focus = figures.focus;
  write("focus", !focus ? (figures.dark ? "nothing to see" : "no edge above the noise")
    : focus.share >= 1 ? "best sharpness of the last minute"
    : `${percent(focus.share, focus.deviation)} of the best sharpness of the last minute`);
  const shift = figures.shift;
  write("shift", shift ? `x ${shift.x_px.toFixed(2)}, y ${shift.y_px.toFixed(2)} px, correlation ${Math.round(100 * shift.likeness)} %`
    : state.reference ? "the frame does not match the reference" : "no reference");
  write("take", state.reference ? "forget the reference" : "measure shifts from here");
}

function drawMask() {
  const place = state.mask?.place;
  write("rotation", place ? `${place.rotation_deg.toFixed(3)} \u00b1 ${place.rotation_deviation_deg.toFixed(3)}\u00b0` : "not seen");
  write("scale", place ? `${percent(place.scale - 1, place.scale_deviation)} off the design` : "not seen");
  const offset = place?.offset_um;
  write("offset", offset ? `x ${offset[0].toFixed(1)}, y ${offset[1].toFixed(1)} \u00b1 ${place.offset_deviation_um.toFixed(1)} \u00b5m`
    : "not seen");
  write("mask-why", state.mask?.why || place?.ambiguity || "");
}

function drawHint() {
  const hint = state.hint;
  $("hint").hidden = !hint && !state.stopped;
  write("hint-text", [state.stopped ? "Stopped by hand." : "", hint?.text || ""].filter(Boolean).join(" "));
  $("hint-do").hidden = !hint?.action;
  write("hint-do", hint?.label || ACTIONS[hint?.action] || "");
  $("hint-do").disabled = state.read_only || state.busy !== "";
  drawNext(!$("hint").hidden);
}

// What saving wants is said at the start, until somebody hides it.
let wantsSeen = false;
function drawWants() {
  $("wants").hidden = wantsSeen || !state.wants;
  writeWithCode("wants-text", state.wants);
}

// The first step that is not done; where hands do it, the button is that of the next step with one.
let nextStep = -1;
function drawNext(hinted) {
  const steps = state.steps, number = steps.findIndex((step) => !step.done);
  $("next").hidden = hinted || state.busy !== "" || !steps.length || !state.frame;
  nextStep = number < 0 ? -1 : steps.findIndex((step, i) => i >= number && !step.done && label(step));
  const step = steps[number];
  writeWithCode("next-text", step ? `Step ${number + 1} of ${steps.length}, ${step.name}: ${step.text}`
    : `All steps are done.${state.next ? ` Next: \`${state.next}\`` : ""}`);
  $("next-do").hidden = nextStep < 0;
  write("next-do", nextStep < 0 ? "" : nextStep === number ? label(step) : `or go on: ${steps[nextStep].name}`);
  $("next-do").disabled = state.read_only;
}

// A picture that shows nothing says why, and what to do about it.
const DIM = 0.05;
function drawWhy() {
  const { figures, hint, trouble } = state, gone = lostSince ? "no connection" : trouble.camera;
  const level = figures ? figures.level : 0;
  const what = !figures ? "" : figures.dark ? "Black" : level < DIM && !view.bright ? "Almost black" : "";
  const reason = hint?.text || "Looking for the reason.";
  write("why", gone ? `${state.frame ? "Not live, this is the last frame" : "No picture"}: ${gone}. Trying again every second.`
    : !state.frame ? (state.exposing ? "The first exposure is under way." : "Waiting for the first frame.")
    : !what ? "" : state.busy ? `${what} while the stage is ${state.busy}.` : figures.dark && hint ? reason : `${what}. ${reason}`);
}

// Steps are made once and then written to: a button that has the focus keeps it.
const LABELS = { autoexpose: "expose", centre: "centre", autofocus: "focus", preview: "show the changes" };
function drawSteps() {
  const parent = $("steps");
  if (parent.children.length !== state.steps.length)
    fill(parent, state.steps.map((step, i) => {
      const row = document.createElement("li");
      row.append(cell("b", step.name), cell("em", step.need), cell("span", ""), button("", () => doStep(i)));
      return row;
    }));
  state.steps.forEach((step, i) => {
    const [, need, words, press] = parent.children[i].children;
    need.hidden = step.done;
    putWithCode(words, step.text);
    put(press, label(step));
    press.hidden = !label(step);
    press.disabled = state.read_only || (state.busy !== "" && step.action !== "autoexpose");
    parent.children[i].classList.toggle("done", step.done);
    parent.children[i].toggleAttribute("aria-current", i === state.steps.findIndex((other) => !other.done));
  });
}

function label(step) {
  const look = step.look && state.targets.includes(step.look);
  return look ? "look at the " + step.look : step.label || LABELS[step.action] || "";
}

function doStep(i) {
  const step = state.steps[i];
  if (step.action === "preview") openSave();
  else if (step.action === "autofocus") act("autofocus", { span_um: 1000 });
  else if (step.action) act(step.action, step.values);
  else if (step.look) act("look", { target: step.look });
}

function openSave() {
  $("save-form").hidden = false;
  $("save-form").scrollIntoView({ block: "nearest" });
  fill($("takes"), state.takes.map((name) => {
    const label = document.createElement("label"), box = document.createElement("input");
    Object.assign(box, { type: "checkbox", checked: true, value: name });
    box.addEventListener("change", previewSave);
    label.append(box, " " + name);
    return label;
  }));
  previewSave();
}

async function previewSave() {
  const what = [...$("takes").querySelectorAll("input:checked")].map((box) => box.value);
  const answer = await act("preview", { what });
  write("saved", "");
  write("diff", answer ? answer.diff || "nothing to change" : "");
  $("save").disabled = !answer?.diff;
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
  write(id + "-limits", fixed ? "fixed" : `${shown(limits[0])} to ${shown(limits[1])}`);
}

function drawHistogram(figures) {
  const canvas = $("histogram"), pen = canvas.getContext("2d");
  const { width, height } = canvas;
  pen.clearRect(0, 0, width, height);
  for (const [name, row] of Object.entries(figures.histogram)) {
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
    row.append(heading(name), cell("td", value, bad ? "bad" : ""), cell("td", note, "quiet"));
    return row;
  }));
}

let drawnTargets = "";
function drawTargets() {
  const key = JSON.stringify([state.targets, state.read_only]);
  if (key === drawnTargets) return;
  drawnTargets = key;
  fill($("targets"), state.targets.map((target) =>
    button(target, () => act("look", { target }), "look at the " + target, state.read_only)));
}

// Rows are made once and then written to: a button that has the focus keeps it.
let drawnAxes = "";
function drawAxes() {
  const axes = Object.entries(state.axes);
  $("axes-section").hidden = $("stop").hidden = axes.length === 0;
  write("busy", state.busy);
  const key = JSON.stringify(Object.keys(state.axes));
  if (key !== drawnAxes) {
    drawnAxes = key;
    fill($("axes"), axes.map(([axis]) => {
      const row = document.createElement("tr"), last = document.createElement("td");
      last.append(button("\u2212", () => jog(axis, -1), `${axis} down`), " ",
        button("+", () => jog(axis, 1), `${axis} up`));
      row.dataset.axis = axis;
      row.append(heading(axis), cell("td", ""), last);
      return row;
    }));
  }
  const off = state.read_only || state.busy !== "";
  $("home").disabled = $("centre").disabled = off;
  $("centre").hidden = Object.keys(state.centre_um).length === 0;
  for (const [axis, told] of axes) {
    const row = $("axes").querySelector(`[data-axis="${CSS.escape(axis)}"]`);
    const known = told.position_um !== null;
    put(row.children[1], known ? told.position_um.toFixed(2) + " \u00b5m" : "not homed");
    for (const press of row.querySelectorAll("button")) press.disabled = off || !known;
  }
}

function jog(axis, sign) {
  const step = number($("step"));
  act("jog", { axis, distance_um: typeof step === "number" ? sign * step : step });
}

function zoom(by, x = view.x, y = view.y) {
  view.level = Math.max(0, Math.min(PARTS.length - 1, view.level + by));
  // A finger scrolls the page over the whole frame, and moves what is zoomed.
  $("stage").style.touchAction = view.level ? "none" : "pan-y";
  const half = PARTS[view.level] / 2;
  view.x = Math.max(half, Math.min(1 - half, x));
  view.y = Math.max(half, Math.min(1 - half, y));
  write("zoom", `${Math.round(1 / PARTS[view.level])}x`);
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

for (const name of ["marked", "bright"])
  $(name).addEventListener("change", () => { view[name] = $(name).checked; drawWhy(); show(); });
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
$("wants-close").addEventListener("click", () => { wantsSeen = true; drawWants(); });
$("take").addEventListener("click", () => act("reference", { taken: !state.reference }));
$("next-do").addEventListener("click", () => doStep(nextStep));
$("hint-do").addEventListener("click", () => act(state.hint.action, state.hint.values));
for (const name of ["home", "centre", "stop", "autoexpose", "refocus", "cancel"])
  $(name).addEventListener("click", () => act(name));

$("save-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  $("save").disabled = true;
  const answer = await act("save");
  if (!answer) return;
  write("diff", "");
  write("saved", "wrote " + answer.written.join(", ") + (answer.next && `; next: ${answer.next}`));
});

// Escape stops from anywhere; moves are by key only while the stage's panel has the focus.
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape") { act("stop"); event.preventDefault(); return; }
  if (event.ctrlKey || event.altKey || event.metaKey || event.target.tagName === "INPUT") return;
  const exposure_s = state.settings?.exposure_s;
  if (event.key === "a") act("autoexpose");
  else if (event.key === "[") act("exposure", { seconds: exposure_s / THIRD_STOP });
  else if (event.key === "]") act("exposure", { seconds: exposure_s * THIRD_STOP });
  else if ($("axes-section").contains(event.target)) {
    const [axis, sign] = { ArrowLeft: ["x", -1], ArrowRight: ["x", 1], ArrowDown: ["y", -1], ArrowUp: ["y", 1] }[event.key] || [];
    const name = `${event.shiftKey ? "aperture" : "mask"}_${axis}`;
    if (!axis || !state.axes[name]) return;
    jog(name, sign);
  } else return;
  event.preventDefault();
});
window.addEventListener("resize", show);
follow((before) => { draw(); if (state.frame !== before.frame) show(); });
