"use strict";
// Shows what a point found beside its chart: by pointer, by keyboard, or by its row of the table.
const points = JSON.parse(document.getElementById("points").textContent);
const pictures = JSON.parse(document.getElementById("pictures").textContent);

function show(section, gid) {
  const panel = section.querySelector(".shown-point");
  for (const old of section.querySelectorAll(".chosen")) old.classList.remove("chosen");
  document.getElementById(gid)?.classList.add("chosen");
  section.querySelector(`tr[data-mark="${gid}"]`)?.classList.add("chosen");
  const point = points[gid];
  panel.replaceChildren();
  const title = panel.appendChild(document.createElement("h3"));
  title.textContent = point.label;
  panel.appendChild(document.createElement("p")).textContent = point.words;
  for (const pair of point.pictures) {
    panel.appendChild(document.createElement("p")).textContent = pair.words;
    const row = panel.appendChild(document.createElement("div"));
    row.className = "pair";
    for (const [name, key] of [["Reconstructed", pair.estimate], ["True", pair.truth]]) {
      const figure = row.appendChild(document.createElement("figure"));
      const image = figure.appendChild(document.createElement("img"));
      image.src = pictures[key];
      image.alt = `${name}: centre view, and an epipolar image below`;
      figure.appendChild(document.createElement("figcaption")).textContent = name;
    }
  }
}

for (const section of document.querySelectorAll("section")) {
  for (const mark of section.querySelectorAll('[id^="mark-"]')) {
    mark.setAttribute("tabindex", "0");
    mark.setAttribute("role", "button");
    mark.setAttribute("aria-label", points[mark.id].label + ", " + points[mark.id].words);
    for (const event of ["click", "focus", "pointerenter"]) {
      mark.addEventListener(event, () => show(section, mark.id));
    }
  }
  for (const row of section.querySelectorAll("tr[data-mark]")) {
    row.addEventListener("click", () => show(section, row.dataset.mark));
  }
  const first = section.querySelector("[data-first]");
  if (first) show(section, first.dataset.first);
}
