"use strict";
// The light field: all views in one picture; viewpoint and focus are worked out here.
const field = { number: 0, sheet: null, depth: null, u: 0.5, v: 0.5, disparity: 0, loading: false };
let shownKind = document.querySelector("[data-show][aria-pressed=true]").dataset.show;
function onField() { return ["views", "focus", "depth"].includes(shownKind); }

async function showField() {
  const shown = state.light_field?.pictures;
  if (!shown || !onField() || field.loading || shown.number === field.number) return;
  field.loading = true;
  try {
    const [sheet, depth] = await Promise.all(["views.jpg", "disparity.png"].map(async (name) =>
      createImageBitmap(await (await ask(name)).blob())));
    Object.assign(field, { sheet, depth, number: shown.number, shown });
    paintField();
  } catch (fault) { /* the next state tells why */ }
  field.loading = false;
}

function drawField() {
  const told = state.light_field;
  for (const one of ["views", "focus", "depth"])
    document.querySelector(`[data-show=${one}]`).hidden = !told;
  if (!told) return;
  const parts = [told.stage];
  if (told.shots[1] > 1) parts.push(`${told.shots[0]} of ${told.shots[1]} shots`);
  if (told.latency_s !== undefined && told.pictures && !told.verdict) parts.push(`${told.latency_s.toFixed(2)} s after its frame`);
  if (told.why) parts.push(told.why);
  if (told.verdict !== undefined) parts.push(told.verdict?.words || "no verdict yet");
  write("field-stage", parts.join("; "));
  $("field-stage").classList.toggle("bad", told.verdict?.level === "do not use");
  $("field-stage").classList.toggle("good", told.verdict?.level === "trust");
}

function paintField() {
  const canvas = $("field"), { sheet, shown } = field;
  if (!sheet || !onField()) return;
  const box = canvas.getBoundingClientRect(), dots = window.devicePixelRatio || 1;
  canvas.width = Math.max(1, Math.round(box.width * dots));
  canvas.height = Math.max(1, Math.round(box.height * dots));
  const pen = canvas.getContext("2d");
  const [rows, columns] = shown.views, [high, wide] = shown.size;
  const scale = Math.min(canvas.width / wide, canvas.height / high);
  const left = (canvas.width - wide * scale) / 2, top = (canvas.height - high * scale) / 2;
  pen.save();
  pen.beginPath();
  pen.rect(left, top, wide * scale, high * scale);
  pen.clip();
  const put = (v, u, x = 0, y = 0) => pen.drawImage(sheet, u * wide, v * high, wide, high,
    left + x * scale, top + y * scale, wide * scale, high * scale);
  const middle = [Math.floor(rows / 2), Math.floor(columns / 2)];
  if (shownKind === "depth") {
    put(...middle);
    pen.fillStyle = "#000a";
    pen.fillRect(left, top, wide * scale, high * scale);
    pen.drawImage(field.depth, left, top, wide * scale, high * scale);
  } else if (shownKind === "focus") {
    let count = 0;
    for (let v = 0; v < rows; v++)
      for (let u = 0; u < columns; u++) {
        pen.globalAlpha = 1 / ++count;
        put(v, u, -field.disparity * (u - middle[1]), -field.disparity * (v - middle[0]));
      }
  } else {
    const v = field.v * (rows - 1), u = field.u * (columns - 1);
    const v0 = Math.min(Math.floor(v), Math.max(0, rows - 2)), u0 = Math.min(Math.floor(u), Math.max(0, columns - 2));
    let sum = 0;
    for (const [i, j, weight] of [[0, 0, (1 - v + v0) * (1 - u + u0)], [0, 1, (1 - v + v0) * (u - u0)],
      [1, 0, (v - v0) * (1 - u + u0)], [1, 1, (v - v0) * (u - u0)]]) {
      if (weight <= 0) continue;
      sum += weight;
      pen.globalAlpha = weight / sum;
      put(v0 + i, u0 + j);
    }
  }
  pen.restore();
  const range = shown.disparities;
  write("focused", shownKind === "focus" ? `focus at ${field.disparity.toFixed(2)} px per view`
    : shownKind === "depth" ? (range ? `${range[0].toFixed(2)} (dark) to ${range[1].toFixed(2)} (bright) px per view` : "no disparity is decided")
    : `view ${(field.v * (rows - 1) + 1).toFixed(1)}, ${(field.u * (columns - 1) + 1).toFixed(1)}`);
  canvas.setAttribute("aria-label", `light field, ${$("focused").textContent}`);
  canvas.dataset.number = field.number;
}

function refocus(steps) {
  const range = field.shown?.disparities;
  const step = range ? Math.max((range[1] - range[0]) / 20, 0.01) : 0.02;
  field.disparity += steps * step;
  choose("focus");
}

function look(v, u) {
  field.v = Math.max(0, Math.min(1, v));
  field.u = Math.max(0, Math.min(1, u));
  if (shownKind === "focus") choose("views"); else paintField();
}

function choose(what) {
  shownKind = what;
  for (const one of document.querySelectorAll("[data-show]"))
    one.setAttribute("aria-pressed", one.dataset.show === what);
  for (const one of document.querySelectorAll(".of-frame")) one.hidden = onField();
  for (const one of document.querySelectorAll(".of-field")) one.hidden = !onField();
  if (onField()) { paintField(); showField(); } else if (typeof show === "function") show();
}

$("field").addEventListener("pointermove", (event) => {
  if (shownKind !== "views" && !event.buttons) return;
  const box = $("field").getBoundingClientRect();
  look((event.clientY - box.top) / box.height, (event.clientX - box.left) / box.width);
});
$("field").addEventListener("wheel", (event) => { event.preventDefault(); refocus(event.deltaY < 0 ? 1 : -1); }, { passive: false });
$("field").addEventListener("keydown", (event) => {
  const [rows, columns] = field.shown?.views || [1, 1];
  const by = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] }[event.key];
  if (by) look(field.v + by[0] / Math.max(1, rows - 1), field.u + by[1] / Math.max(1, columns - 1));
  else if (event.key === "+" || event.key === "-") refocus(event.key === "+" ? 1 : -1);
  else return;
  event.preventDefault();
});

for (const one of document.querySelectorAll("[data-show]"))
  one.addEventListener("click", () => choose(one.dataset.show));
window.addEventListener("resize", paintField);
