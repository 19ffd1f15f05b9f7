"use strict";
// Both pages: the state that the server pushes, actions, the newest picture, texts.
const $ = (id) => document.getElementById(id);
let state = { version: 0 };

async function ask(path, options) {
  const answer = await fetch(path, { cache: "no-store", ...options });
  if (!answer.ok) throw new Error((await answer.text()).trim());
  return answer;
}

// Returns what the action answers, null where it was refused.
async function act(name, values = {}) {
  hiddenLines = [];
  try {
    const answer = await ask("do/" + name, {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(values),
      priority: name === "stop" ? "high" : "auto",
    });
    complain("");
    return await answer.json();
  } catch (fault) {
    complain(fault instanceof TypeError ? `${name}: the program does not answer` : fault.message);
    return null;
  }
}

let complaint = "";
function complain(text) { complaint = text; drawTrouble(); }

// What is announced is written only when it changes: a screen reader reads it again otherwise.
function write(id, text) { put($(id), text); }
function put(element, text) { if (element.textContent !== text) element.textContent = text; }

// Show a picture of the frame; while it loads no other is asked for, but `again` is called after it.
let loading = false, wanted = false;
async function load(path, again) {
  if (loading) { wanted = true; return; }
  loading = true;
  try {
    const blob = await (await ask(path)).blob();
    const before = $("picture").src;
    $("picture").src = URL.createObjectURL(blob);
    if (before) URL.revokeObjectURL(before);
    $("picture").dataset.frame = state.frame;
    $("picture").hidden = false;
  } catch (fault) { /* the next state tells why */ }
  loading = false;
  if (wanted) { wanted = false; again(); }
}

// Call a function with every element of a CSS selector.
function each(selector, call) { document.querySelectorAll(selector).forEach(call); }

// What was read may be hidden; with the next action it is shown again where it still holds.
let hiddenLines = [], lostSince = "";
function troubleLines() {
  const lost = lostSince && `No connection since ${lostSince}: what is shown is from then. Where the program has`
    + " ended, start it again and open the address that it prints";
  return [lost, complaint, ...Object.values(state.trouble || {})].filter(Boolean);
}

// The same, where `so` is what somebody types.
function writeWithCode(id, text) { putWithCode($(id), text); }
function putWithCode(element, text) {
  if (element.dataset.text === text) return;
  element.dataset.text = text;
  fill(element, text.split("`").map((part, i) => i % 2 ? cell("code", part) : part));
}

function drawTrouble() {
  const lines = troubleLines();
  hiddenLines = hiddenLines.filter((line) => lines.includes(line));
  const shown = lines.filter((line) => !hiddenLines.includes(line));
  $("trouble").hidden = shown.length === 0;
  write("trouble-text", shown.join("; "));
  $("lost").hidden = !lostSince;
  document.body.classList.toggle("stale", Boolean(lostSince || state.trouble?.camera));
}
$("trouble-close").addEventListener("click", () => { hiddenLines = troubleLines(); drawTrouble(); });

// Draw every newer state; what is seen of the light field follows it.
function follow(draw) {
  const source = new EventSource("events");
  source.onmessage = (event) => {
    const before = state;
    state = JSON.parse(event.data);
    lostSince = "";
    $("read-only").hidden = !state.read_only;
    drawTrouble();
    drawField();
    draw(before);
    showField();
    if (state.ended) source.close();
  };
  source.onerror = () => {
    lostSince ||= new Date().toLocaleTimeString();
    drawTrouble();
    if (state.version) draw(state);
  };
}

function cell(kind, text, style = "") {
  const made = document.createElement(kind);
  made.textContent = text;
  if (style) made.className = style;
  return made;
}

function heading(text) {
  const made = cell("th", text);
  made.scope = "row";
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

function number(field) {
  const value = Number(field.value.replace(",", "."));
  return field.value.trim() === "" || Number.isNaN(value) ? field.value : value;
}

function percent(value, deviation) {
  const digits = Math.max(0, Math.min(3, Math.ceil(-Math.log10(Math.max(100 * deviation, 1e-3)))));
  return `${(100 * value).toFixed(digits)} \u00b1 ${(100 * deviation).toFixed(digits)} %`;
}
