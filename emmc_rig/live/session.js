"use strict";
// The page of a capture: frames as they come, the light field so far, and where allowed steering.
const rows = new Map();
let chosen = new Set();

function draw(before) {
  write("title", state.title);
  document.title = `${state.done} of ${state.planned}, ${state.title}`;
  $("bar").max = Math.max(1, state.planned);
  $("bar").value = state.done;
  write("count", state.planned ? `${state.done} of ${state.planned} frames` : "no frame yet");
  write("left", state.left && !state.ended && state.done < state.planned ? `about ${duration(state.left.seconds)} left`
    + (state.left.guessed ? ` (excludes ${state.left.guessed} exposures not metered yet)` : "") : "");
  write("step", state.step);
  // Whoever may press "go on" reads of a pause beside it: nothing moves under the hand.
  const here = state.paused && state.held && !state.read_only;
  write("wish", here ? "Paused by hand: \u201cgo on\u201d takes the next frame." : state.wish);
  $("waiting").hidden = !state.paused || here || state.by_hand;
  write("waiting", !state.paused ? "" : state.held ? "Paused by hand." : `Waiting: ${state.paused.reason}`);
  each(".steers", (part) => { part.hidden = state.read_only || state.ended; });
  write("pause", state.held ? "go on" : "pause");
  $("pause").hidden = state.paused !== null && !state.held;
  drawAsk();
  drawMessages();
  drawEnd();
  drawFrames();
  drawNewest();
  if (state.frame !== before.frame) show();
}

function duration(seconds) {
  const whole = Math.round(seconds);
  if (whole < 100) return `${whole} s`;
  if (whole < 6000) return `${Math.round(whole / 60)} min`;
  return `${(whole / 3600).toFixed(1)} h`;
}

let drawnMessages = null;
function drawMessages() {
  const key = JSON.stringify(state.messages);
  if (key === drawnMessages) return;
  drawnMessages = key;
  fill($("messages"), state.messages.length ? state.messages.map((text) => cell("li", text)).reverse()
    : [cell("li", "none yet", "quiet")]);
}

function drawEnd() {
  const { end, verdict } = state;
  $("end").hidden = !state.ended;
  $("capture-section").hidden = state.ended;
  const reasons = (verdict?.reasons || []).map((reason) => `${reason.level}: ${reason.what}; ${reason.remedy}`);
  const next = end?.complete ? "reconstruct the light field of session" : "go on with this capture; its session is";
  writeWithCode("end", !end ? `The capture has ended: ${state.why || "see the terminal"}`
    : [end.complete ? "Complete: every frame verified." : `Stopped: ${end.missing} of ${state.planned} frames are still to be taken.`,
      ...reasons, `Next: ${next} \`${end.session}\``].join("\n"));
  $("end").classList.toggle("good", Boolean(end?.complete) && reasons.length === 0);
  $("end").classList.toggle("bad", !end);
}

// The wish is the largest thing on the page, and its button stays in its place between two wishes.
const DIM = 0.05; // of white, below which a picture looks black
const UNREAD_MS = 400; // so long a button or foot switch pressed twice answers no wish that nobody read
let wish = 0, wishedAt = 0, plate = null;
function drawAsk() {
  const asked = state.asked;
  $("ask").hidden = !state.by_hand || state.ended;
  if (asked && asked.number !== wish) {
    wish = asked.number;
    wishedAt = performance.now();
    setTimeout(drawAsk, UNREAD_MS + 20);
  }
  plate = asked ? asked.views : plate;
  write("ask-refusal", asked?.refusal || "");
  const words = asked?.text || (state.paused ? `waiting: ${state.paused.reason}` : "hands off: frames are taken");
  write("ask-text", words[0].toUpperCase() + words.slice(1));
  $("ask").classList.toggle("due", Boolean(asked));
  drawPlate(asked?.hole);
  $("done").hidden = state.read_only || (!asked && state.paused !== null);
  $("done").disabled = !asked || performance.now() - wishedAt < UNREAD_MS;
  const left = $("left").textContent;
  const how = !asked ? "" : state.read_only ? "Press Enter at the computer when it is done."
    : "Done is also the space bar or Enter, or a foot switch that sends either.";
  write("ask-note", `${left && `A${left.slice(1)}. `}${how}`);
}

let drawnPlate = "";
function drawPlate(hole) {
  const key = JSON.stringify([plate, hole, state.last_hole]);
  $("plate").toggleAttribute("hidden", !plate);
  if (!plate || key === drawnPlate) return;
  drawnPlate = key;
  const [rows, columns] = plate, shape = (name, facts, text = "") => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [fact, value] of Object.entries(facts)) made.setAttribute(fact, value);
    made.textContent = text;
    return made;
  };
  const number = (place) => place[0] * columns + place[1] + 1;
  const drawn = [];
  for (let v = 0; v < rows; v++) for (let u = 0; u < columns; u++) {
    const x = 10 * u + 5, y = 10 * v + 5, is = (place) => place && place[0] === v && place[1] === u;
    drawn.push(shape("circle", { cx: x, cy: y, r: 4.2, class: is(hole) ? "wanted" : "hole" }));
    drawn.push(shape("text", { x, y: y + 1.3, class: is(hole) ? "wanted" : "hole" }, number([v, u])));
    if (is(state.last_hole)) drawn.push(shape("path", { d: `M${x - 4} ${y - 4}l8 8m0-8l-8 8`, class: "last" }));
  }
  $("plate").setAttribute("viewBox", `0 0 ${10 * columns} ${10 * rows}`);
  $("plate").setAttribute("aria-label", `plate of ${rows} by ${columns} holes: `
    + [hole ? `${number(hole)} is wanted` : "", state.last_hole ? `${number(state.last_hole)} was the last` : ""].filter(Boolean).join(", "));
  fill($("plate"), drawn);
}

// A tile is made once for each frame, and its picture is asked for when that is taken (again). Like
// tiles stand in a group; the newest group is open, and the others have a summary.
const groups = new Map();
const FEW = 24;
function groupOf(kind) {
  let group = groups.get(kind);
  if (!group) {
    const all = document.createElement("details"), tiles = document.createElement("div");
    const more = button("", () => tiles.classList.add("all"));
    const summary = document.createElement("summary");
    tiles.className = "tiles";
    summary.append(cell("b", state.headings[kind] || kind), " ", cell("span", "", "figure"));
    all.append(summary, tiles, more);
    group = { all, tiles, more, words: summary.lastChild };
    groups.set(kind, group);
  }
  return group;
}

function drawFrames() {
  const parent = $("frames"), shown = new Set(state.frames.map((frame) => frame.id)), made = new Set();
  for (const [id, row] of rows) if (!shown.has(id)) { row.remove(); rows.delete(id); }
  for (const frame of state.frames) {
    let tile = rows.get(frame.id);
    if (!tile) {
      tile = document.createElement("button");
      tile.className = "tile";
      tile.append(document.createElement("img"), cell("span", frame.id), cell("span", "", "figure"));
      tile.firstChild.alt = "";
      tile.firstChild.loading = "lazy";
      tile.addEventListener("click", () => choose_frame(frame.id));
      tile.setAttribute("aria-pressed", "false");
      rows.set(frame.id, tile);
      groupOf(frame.kind).tiles.prepend(tile);
      made.add(frame.kind);
    }
    const key = `frame.jpg?id=${encodeURIComponent(frame.id)}&n=${frame.number}`;
    if (tile.firstChild.getAttribute("src") !== key) tile.firstChild.src = key;
    const saturated = frame.saturated > 0 ? `, ${(100 * frame.saturated).toFixed(2)} % saturated` : "";
    const words = `${Math.round(100 * frame.level)}\u00a0%\u00a0of\u00a0white${saturated}, ${Number(frame.exposure_s.toPrecision(3))}\u00a0s`;
    put(tile.lastChild, words);
    tile.lastChild.classList.toggle("bad", frame.saturated > 0.001);
    tile.classList.toggle("due", !frame.stored);
    tile.disabled = state.read_only || state.ended;
  }
  for (const kind of made) {
    const { all } = groupOf(kind);
    if (parent.firstChild === all) continue;
    if (parent.firstChild) parent.firstChild.open = false;
    parent.prepend(all);
    all.open = true;
  }
  for (const [kind, group] of groups) drawGroup(group, state.frames.filter((frame) => frame.kind === kind));
  const hidden = state.taken - state.frames.length;
  write("chosen", chosen.size ? `${chosen.size} chosen` : state.frames.length === 0 ? "none yet" : hidden > 0 ? `the last ${state.frames.length} of ${state.taken}` : "");
  $("retake").disabled = chosen.size === 0;
  write("retake", chosen.size ? `take ${chosen.size} again` : "take again");
}

function drawGroup(group, frames) {
  const levels = frames.map((frame) => Math.round(100 * frame.level)), most = Math.max(...levels), least = Math.min(...levels);
  const due = frames.filter((frame) => !frame.stored).length, bad = frames.filter((frame) => frame.saturated > 0.001).length;
  const words = [`${frames.length}`, `${least === most ? "" : `${least} to `}${most}\u00a0% of white`,
    due && `${due} not on the disk yet`, bad && `${bad} saturated`].filter(Boolean).join(", ");
  put(group.words, words);
  group.words.classList.toggle("bad", bad > 0);
  group.more.textContent = `all ${frames.length}`;
  group.more.hidden = frames.length <= FEW || group.tiles.classList.contains("all");
}

function choose_frame(id) {
  if (!chosen.delete(id)) chosen.add(id);
  rows.get(id).setAttribute("aria-pressed", chosen.has(id));
  drawFrames();
}

function drawNewest() {
  const frame = state.frame ? state.frames.at(-1) : null;
  write("none-yet", state.asked ? "no frame yet: it is taken when that is done" : "waiting for the first frame");
  write("newest", frame ? `${frame.id}: its brightest readings reach ${Math.round(100 * frame.level)}\u00a0% of white` : "");
  write("why", !frame || frame.level > DIM ? "" : frame.kind === "dark" ? "Black, as it should be: the lamp is off while darks are taken."
    : `Almost black: ${frame.kind === "whiteboard" ? "little light comes through one pinhole" : "little light comes at this exposure"}.`);
}

function show() {
  if (!onField() && state.frame) load("newest.jpg?n=" + state.frame, show);
}

$("pause").addEventListener("click", () => act(state.held ? "resume" : "pause"));
$("finish").addEventListener("click", () => act("stop"));
$("retake").addEventListener("click", async () => {
  const ids = [...chosen];
  chosen = new Set();
  for (const id of ids) rows.get(id)?.setAttribute("aria-pressed", "false");
  await act("retake", { ids });
});
$("done").addEventListener("click", () => act("done", { number: wish }));
document.addEventListener("keydown", (event) => {
  if (![" ", "Enter"].includes(event.key) || $("ask").hidden || event.target.closest("button, input, summary")) return;
  event.preventDefault(); // nor does the page scroll
  if (!event.repeat) $("done").click();
});
follow(draw);
