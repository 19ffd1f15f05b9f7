"use strict";
// The light field: fetched when there is a newer one and somebody looks, turned by viewer.js.
const field = { number: 0, loading: false };
let shownKind = document.querySelector("[data-show][aria-pressed=true]").dataset.show;
$("viewer").hidden = true; // until there is something to see
function onField() { return shownKind === "views"; }

async function showField() {
  const number = state.light_field?.pictures?.number;
  if (!number || !onField() || field.loading || number === field.number) return;
  field.loading = true;
  try {
    await lightFieldViewer.take(await (await ask(`light-field.json?n=${number}`)).json());
    $("viewer").dataset.number = field.number = number;
    $("viewer").hidden = false;
  } catch (fault) { /* the next state tells why */ }
  field.loading = false;
  if (field.number === number) showField(); // there may be a newer one by now
}

function drawField() {
  const told = state.light_field;
  document.querySelector("[data-show=views]").hidden = !told;
  if (!told) return;
  const parts = told.verdict ? [told.verdict.words, told.stage] : [told.stage];
  if (told.shots[1] > 1) parts.push(`${told.shots[0]} of ${told.shots[1]} shots`);
  if (told.latency_s !== undefined && told.pictures && !told.verdict) parts.push(`${told.latency_s.toFixed(2)} s after its frame`);
  if (told.why) parts.push(told.why);
  if (told.verdict === null) parts.push("no verdict yet");
  writeWithCode("field-stage", parts.join("; "));
  $("field-stage").classList.toggle("watch", ["doubt", "cannot tell"].includes(told.verdict?.level));
  $("field-stage").classList.toggle("bad", told.verdict?.level === "do not use");
  $("field-stage").classList.toggle("good", told.verdict?.level === "trust");
}

function choose(what) {
  shownKind = what;
  each("[data-show]", (choice) => choice.setAttribute("aria-pressed", choice.dataset.show === what));
  each(".of-frame", (part) => { part.hidden = onField(); });
  each(".of-field", (part) => { part.hidden = !onField(); });
  if (onField()) showField(); else show();
}

each("[data-show]", (choice) => choice.addEventListener("click", () => choose(choice.dataset.show)));
