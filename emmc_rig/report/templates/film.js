"use strict";
// A film of light fields: viewer.js shows one frame, this when it is and a row of pixels over time.
(() => {
const byId = (id) => document.getElementById(`film-${id}`);
const film = JSON.parse(byId("data").textContent);
const count = film.times_s.length, rows = film.rows;
const viewer = document.getElementById("viewer"), picture = document.getElementById("viewer-picture");
const first = film.frames.findIndex(Boolean);
const neighbour = (k) => film.frames[Math.max(film.frames.findLastIndex((frame, i) => frame && i <= k), first)];
let place = first, loading = false, playing = 0, centres = null;

// The newest place that was asked for is shown, however many were asked for while one was decoded.
async function go(to) {
  place = (to + count) % count;
  drawTime();
  if (loading) return;
  loading = true;
  for (let shown = -1; shown !== place;) {
    shown = place;
    await lightFieldViewer.take(neighbour(shown));
    viewer.dataset.place = shown;
  }
  loading = false;
}

function drawTime() {
  const gone = !film.frames[place], parts = [`${film.times_s[place].toFixed(film.rate > 20 ? 3 : 2)} s, frame ${place} / ${count - 1}`];
  if (film.levels[place]) parts.push(film.levels[place]);
  byId("time").value = place;
  byId("time").setAttribute("aria-valuetext", parts.join(": "));
  byId("time-value").textContent = parts.join(": ");
  byId("missing").hidden = !gone;
  document.getElementById("viewer-stage").classList.toggle("film-gone", gone);
  drawRows();
}

function drawRows() {
  if (!centres) return;
  const canvas = byId("rows"), context = canvas.getContext("2d"), { state } = lightFieldViewer;
  const scale = rows.width / film.frames[first].views.width;
  const y = Math.min(Math.floor((state.y + 0.5) * scale), rows.height - 1);
  const padded = (length) => Math.ceil(length / rows.tile) * rows.tile;
  Object.assign(canvas, { width: rows.width, height: count });
  for (let k = 0; k < count; k++)
    if (film.frames[k]) context.drawImage(
      centres, (k % rows.columns) * padded(rows.width), Math.floor(k / rows.columns) * padded(rows.height) + y,
      rows.width, 1, 0, k, rows.width, 1);
  context.fillStyle = "#fffa";
  context.fillRect(0, place, rows.width, 1);
  context.fillRect(Math.floor((state.x + 0.5) * scale), 0, 1, count);
}

function play() {
  byId("play").setAttribute("aria-pressed", String(!playing));
  byId("play").textContent = playing ? "Play" : "Pause";
  if (playing) { cancelAnimationFrame(playing); playing = 0; return; }
  const begun = performance.now(), from = place;
  const turn = (now) => {
    const due = (from + Math.max(0, Math.floor((now - begun) / 1000 * film.rate))) % count;
    if (due !== place && !loading) go(due); // frames that come too fast to be drawn are left out
    playing = requestAnimationFrame(turn);
  };
  playing = requestAnimationFrame(turn);
}
const stop = () => { if (playing) play(); };
const step = (by) => { stop(); go(place + by); };

byId("time").max = count - 1;
byId("time").addEventListener("input", (event) => { stop(); go(+event.target.value); });
byId("play").addEventListener("click", play);
const keys = { " ": play, ",": () => step(-1), ".": () => step(1) };
picture.addEventListener("keydown", (event) => { // before viewer.js, whose space turns the light field
  if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
  keys[event.key]();
  event.preventDefault();
  event.stopImmediatePropagation();
});
for (const kind of ["pointermove", "pointerup"]) picture.addEventListener(kind, () => requestAnimationFrame(drawRows));
const pick = (event) => {
  const box = byId("rows").getBoundingClientRect();
  stop();
  go(Math.min(Math.max(Math.floor((event.clientY - box.top) / box.height * count), 0), count - 1));
};
byId("rows").addEventListener("pointerdown", (event) => { byId("rows").setPointerCapture(event.pointerId); pick(event); });
byId("rows").addEventListener("pointermove", (event) => { if (event.buttons) pick(event); });

go(place).then(() => decoded(rows.picture)).then((atlas) => { centres = atlas; drawRows(); viewer.dataset.rows = "yes"; });
})();
