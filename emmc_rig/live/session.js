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
    + (state.left.guessed ? `, and the exposures of ${state.left.guessed} not metered yet` : "") : "");
  write("step", state.step);
  // Whoever may press "go on" reads of a pause beside it: nothing moves under the hand.
  const here = state.paused && state.held && !state.read_only;
  write("wish", here ? "Paused by hand: \u201cgo on\u201d takes the next frame." : state.wish);
  $("waiting").hidden = !state.paused || here;
  write("waiting", !state.paused ? "" : state.held ? "Paused by hand." : `Waiting: ${state.paused.reason}`);
  for (const one of document.querySelectorAll(".steers")) one.hidden = state.read_only || state.ended;
  write("pause", state.held ? "go on" : "pause");
  $("pause").hidden = state.paused !== null && !state.held;
  drawMessages();
  drawEnd();
  drawFrames();
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
  const reasons = (verdict?.reasons || []).map((one) => `${one.level}: ${one.what}; ${one.remedy}`);
  const folder = end && (/[^\w./:\\-]/.test(end.session) ? JSON.stringify(end.session) : end.session);
  writeWithCode("end", !end ? `The capture has ended: ${state.why || "see the terminal"}`
    : [end.complete ? "Complete: every frame verified." : `Stopped: ${end.missing} frames are still to be taken.`,
      ...reasons, `Next: \`emmc-rig ${end.complete ? "reconstruct" : "capture"} ${folder}\``].join("\n"));
  $("end").classList.toggle("good", Boolean(end?.complete) && reasons.length === 0);
  $("end").classList.toggle("bad", !end);
}

// A tile is made once for each frame, and its picture is asked for when that is taken (again).
function drawFrames() {
  const parent = $("frames"), shown = new Set(state.frames.map((one) => one.id));
  for (const [id, row] of rows) if (!shown.has(id)) { row.remove(); rows.delete(id); }
  for (const one of state.frames) {
    let tile = rows.get(one.id);
    if (!tile) {
      tile = document.createElement("button");
      tile.className = "tile";
      tile.append(document.createElement("img"), cell("span", one.id), cell("span", "", "figure"));
      tile.firstChild.alt = "";
      tile.firstChild.loading = "lazy";
      tile.addEventListener("click", () => choose_frame(one.id));
      tile.setAttribute("aria-pressed", "false");
      rows.set(one.id, tile);
      parent.prepend(tile);
    }
    const key = `frame.jpg?id=${encodeURIComponent(one.id)}&n=${one.number}`;
    if (tile.firstChild.getAttribute("src") !== key) tile.firstChild.src = key;
    const saturated = one.saturated > 0 ? `, ${(100 * one.saturated).toFixed(2)} % saturated` : "";
    const words = `${Math.round(100 * one.level)}\u00a0%\u00a0of\u00a0white${saturated}, ${Number(one.exposure_s.toPrecision(3))}\u00a0s`;
    if (tile.lastChild.textContent !== words) tile.lastChild.textContent = words;
    tile.lastChild.classList.toggle("bad", one.saturated > 0.001);
    tile.classList.toggle("due", !one.stored);
    tile.disabled = state.read_only || state.ended;
  }
  const hidden = state.taken - state.frames.length;
  write("chosen", chosen.size ? `${chosen.size} chosen` : state.frames.length === 0 ? "none yet" : hidden > 0 ? `the last ${state.frames.length} of ${state.taken}` : "");
  $("retake").disabled = chosen.size === 0;
  write("retake", chosen.size ? `take ${chosen.size} again` : "take again");
}

function choose_frame(id) {
  if (!chosen.delete(id)) chosen.add(id);
  rows.get(id).setAttribute("aria-pressed", chosen.has(id));
  drawFrames();
}

let loading = false, wanted = false;
async function show() {
  if (onField() || !state.frame) return;
  if (loading) { wanted = true; return; }
  loading = true;
  try {
    const blob = await (await ask("newest.jpg?n=" + state.frame)).blob();
    const before = $("picture").src;
    $("picture").src = URL.createObjectURL(blob);
    $("picture").hidden = false;
    $("none-yet").hidden = true;
    if (before) URL.revokeObjectURL(before);
  } catch (fault) { /* the next frame is shown */ }
  loading = false;
  if (wanted) { wanted = false; show(); }
}

$("pause").addEventListener("click", () => act(state.held ? "resume" : "pause"));
$("finish").addEventListener("click", () => act("stop"));
$("retake").addEventListener("click", async () => {
  const ids = [...chosen];
  chosen = new Set();
  for (const id of ids) rows.get(id)?.setAttribute("aria-pressed", "false");
  await act("retake", { ids });
});
follow(draw);
