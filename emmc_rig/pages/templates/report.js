"use strict";
(() => {
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const { rows, columns, width, height } = data.views;
const nativeScale = data.nativeWidth / width;
const padded = (length) => Math.ceil(length / data.tileMultiple) * data.tileMultiple;
const tileWidth = padded(width), tileHeight = padded(height);
const middleRow = (rows - 1) / 2, middleColumn = (columns - 1) / 2;

// What the reader has chosen; every drawing is a function of it.
const state = {
  v: Math.floor(rows / 2), u: Math.floor(columns / 2),
  x: Math.floor(width / 2), y: Math.floor(height / 2),
  errorKind: "mean", flipped: false,
};
const sources = {}; // truth, estimate, errorViews, errorMean: canvases that hold the sprites

// A request to draw is answered once per screen refresh, however many events asked for it.
function oncePerFrame(draw) {
  let waiting = false;
  return () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; draw(); });
  };
}

function setSize(canvas, w, h) {
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
}

function place(event, canvas) {
  const box = canvas.getBoundingClientRect();
  return [
    clamp((event.clientX - box.left) / box.width, 0, 0.999999),
    clamp((event.clientY - box.top) / box.height, 0, 0.999999),
  ];
}

const heatTable = (() => {
  const table = new Uint8Array(256 * 3), last = data.heat.length - 1;
  for (let i = 0; i < 256; i++) {
    const at = (i / 255) * last, k = Math.min(Math.floor(at), last - 1);
    for (let c = 0; c < 3; c++)
      table[3 * i + c] = Math.round(data.heat[k][c] + (at - k) * (data.heat[k + 1][c] - data.heat[k][c]));
  }
  return table;
})();

function drawHeat(canvas, source, x, y, w, h) {
  setSize(canvas, w, h);
  const pixels = source.getContext("2d").getImageData(x, y, w, h);
  const p = pixels.data;
  for (let i = 0; i < p.length; i += 4) {
    const at = 3 * p[i];
    p[i] = heatTable[at]; p[i + 1] = heatTable[at + 1]; p[i + 2] = heatTable[at + 2];
  }
  canvas.getContext("2d").putImageData(pixels, 0, 0);
}

// Views

function drawView(canvas, source, v, u) {
  setSize(canvas, width, height);
  canvas.getContext("2d").drawImage(
    source, u * tileWidth, v * tileHeight, width, height, 0, 0, width, height);
}

const cropWidth = Math.min(66, width), cropHeight = Math.min(44, height);

function cropCorner() {
  return [
    clamp(state.x - (cropWidth >> 1), 0, width - cropWidth),
    clamp(state.y - (cropHeight >> 1), 0, height - cropHeight),
  ];
}

function drawCrop(canvas, source) {
  const [left, top] = cropCorner();
  setSize(canvas, cropWidth, cropHeight);
  canvas.getContext("2d").drawImage(
    source, state.u * tileWidth + left, state.v * tileHeight + top, cropWidth, cropHeight,
    0, 0, cropWidth, cropHeight);
}

// Lays a mark over a picture, so that the picture's own pixels stay what they are.
function screenValue(frame) {
  const part = `value / ${frame.white.toPrecision(2)}`;
  return frame.gamma === 1 ? part : `(${part})^(1 / ${frame.gamma.toFixed(2)})`;
}

function cover(mark, left, top, w, h, pictureWidth, pictureHeight) {
  Object.assign(mark.style, {
    left: `${(100 * left) / pictureWidth}%`, width: `${(100 * w) / pictureWidth}%`,
    top: `${(100 * top) / pictureHeight}%`, height: `${(100 * h) / pictureHeight}%`,
  });
}

const drawViews = oncePerFrame(() => {
  const right = state.flipped && sources.truth ? sources.truth : sources.estimate;
  drawView(byId("view-estimate"), right, state.v, state.u);
  drawCrop(byId("crop-estimate"), sources.estimate);
  if (sources.truth) {
    drawView(byId("view-truth"), sources.truth, state.v, state.u);
    drawCrop(byId("crop-truth"), sources.truth);
    const [left, top] = cropCorner();
    drawHeat(byId("crop-error"), sources.errorViews,
      state.u * tileWidth + left, state.v * tileHeight + top, cropWidth, cropHeight);
  }
  for (const box of document.querySelectorAll(".crop-box"))
    cover(box, ...cropCorner(), cropWidth, cropHeight, width, height);
  for (const label of document.querySelectorAll(".view-index"))
    label.textContent = `view v ${state.v}, u ${state.u}`;
  byId("estimate-name").textContent = state.flipped ? "True, in the place of reconstructed" : "Reconstructed";
  byId("crop-place").textContent =
    `around x ${Math.round(state.x * nativeScale)}, y ${Math.round(state.y * nativeScale)}`;
  byId("view-row").value = state.v;
  byId("view-column").value = state.u;
  for (const button of byId("view-grid").children)
    button.setAttribute("aria-pressed", String(+button.dataset.v === state.v && +button.dataset.u === state.u));
});

// Refocus: shift and add is separable under linear interpolation, so views of one row are
// combined along x first, then the rows along y: 60 taps per pixel instead of 100.

const decodeTable = Float32Array.from({ length: 256 }, (_, i) => Math.pow(i / 255, data.gamma));
const encodeTable = Uint8ClampedArray.from(
  { length: 4097 }, (_, i) => Math.round(255 * Math.pow(i / 4096, 1 / data.gamma)));

// Gives views in linear light, (y, x, rgb), at w x h pixels. Small views are kept; full ones are
// decoded again each time, because all of them at once would take hundreds of megabytes.
function linearViews(source, w, h, keep) {
  const canvas = document.createElement("canvas");
  canvas.width = w;
  canvas.height = h;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.imageSmoothingQuality = "high";
  const kept = [], scratch = keep ? null : new Float32Array(w * h * 3);
  return (v, u) => {
    const index = v * columns + u;
    if (kept[index]) return kept[index];
    context.drawImage(source, u * tileWidth, v * tileHeight, width, height, 0, 0, w, h);
    const pixels = context.getImageData(0, 0, w, h).data;
    const linear = keep ? (kept[index] = new Float32Array(w * h * 3)) : scratch;
    for (let i = 0, k = 0; i < pixels.length; i += 4) {
      linear[k++] = decodeTable[pixels[i]];
      linear[k++] = decodeTable[pixels[i + 1]];
      linear[k++] = decodeTable[pixels[i + 2]];
    }
    return linear;
  };
}

// target[i] += source[i + shift], linearly interpolated, for `count` groups of `group` numbers
// from index `from` on; beyond either end the last group repeats.
function addShifted(target, source, from, count, group, shift) {
  const whole = Math.floor(shift), t = shift - whole, s = 1 - t, last = count - 1;
  const inside = clamp(-whole, 0, count), outside = clamp(last - whole, inside, count);
  const near = whole * group, far = near + group, end = from + outside * group;
  for (let k = from + inside * group; k < end; k++)
    target[k] += s * source[k + near] + t * source[k + far];
  for (let i = 0; i < count; i++) {
    if (i === inside) i = outside;
    if (i >= count) break;
    const a = from + clamp(i + whole, 0, last) * group, b = from + clamp(i + whole + 1, 0, last) * group;
    for (let c = 0; c < group; c++) target[from + i * group + c] += s * source[a + c] + t * source[b + c];
  }
}

function refocus(canvas, view, w, h, disparity) {
  const scaled = (disparity / nativeScale) * (w / width);
  const sum = new Float32Array(w * h * 3), line = new Float32Array(w * h * 3);
  for (let v = 0; v < rows; v++) {
    line.fill(0);
    for (let u = 0; u < columns; u++) {
      const linear = view(v, u);
      for (let y = 0; y < h; y++)
        addShifted(line, linear, y * w * 3, w, 3, scaled * (u - middleColumn));
    }
    addShifted(sum, line, 0, h, w * 3, scaled * (v - middleRow));
  }
  setSize(canvas, w, h);
  const context = canvas.getContext("2d"), image = context.createImageData(w, h), p = image.data;
  const share = 4096 / (rows * columns);
  for (let i = 0, k = 0; i < p.length; i += 4, k += 3) {
    p[i] = encodeTable[(sum[k] * share + 0.5) | 0];
    p[i + 1] = encodeTable[(sum[k + 1] * share + 0.5) | 0];
    p[i + 2] = encodeTable[(sum[k + 2] * share + 0.5) | 0];
    p[i + 3] = 255;
  }
  context.putImageData(image, 0, 0);
}

const quickScale = Math.min(1, 256 / width);
const refocusSizes = {
  quick: { w: Math.round(width * quickScale), h: Math.max(1, Math.round(height * quickScale)), views: {} },
  full: { w: width, h: height, views: {} },
};
function drawRefocus(size) {
  const { w, h, views } = refocusSizes[size];
  for (const name of ["truth", "estimate"]) {
    if (!sources[name]) continue;
    views[name] ??= linearViews(sources[name], w, h, size === "quick");
    refocus(byId(`refocus-${name}`), views[name], w, h, +byId("refocus-slider").value);
  }
}
const drawRefocusQuick = oncePerFrame(() => drawRefocus("quick"));
let settle = 0;
function refocusChanged() {
  byId("refocus-value").textContent = (+byId("refocus-slider").value).toFixed(2);
  drawRefocusQuick();
  clearTimeout(settle); // full size once the slider rests
  settle = setTimeout(() => drawRefocus("full"), 180);
}

// Epipolar images

// The stretch of a line that is shown: all of it, or what surrounds the chosen point.
function stretch(at, length) {
  const shown = byId("whole-line").checked ? length : Math.min(160, length);
  return [clamp(at - (shown >> 1), 0, length - shown), shown];
}

function drawHorizontalEpi(canvas, source, row) {
  const [from, shown] = stretch(state.x, width);
  setSize(canvas, shown, columns);
  const context = canvas.getContext("2d");
  for (let u = 0; u < columns; u++)
    context.drawImage(
      source, u * tileWidth + from, row * tileHeight + state.y, shown, 1, 0, u, shown, 1);
}

function drawVerticalEpi(canvas, source, column) {
  const [from, shown] = stretch(state.y, height);
  setSize(canvas, shown, rows);
  const context = canvas.getContext("2d");
  context.save();
  // y runs along the strip, v down it: a transposition.
  context.setTransform(0, 1, 1, 0, 0, 0);
  for (let v = 0; v < rows; v++)
    context.drawImage(
      source, column * tileWidth + state.x, v * tileHeight + from, 1, shown, v, 0, 1, shown);
  context.restore();
}

const drawEpi = oncePerFrame(() => {
  const row = Math.floor(rows / 2), column = Math.floor(columns / 2);
  drawView(byId("epi-map"), sources.estimate, row, column);
  const across = byId("epi-across"), down = byId("epi-down");
  cover(across, 0, state.y + 0.5, width, 0, width, height);
  cover(down, state.x + 0.5, 0, 0, height, width, height);
  across.style.height = down.style.width = "1.5px";
  for (const name of ["truth", "estimate"]) {
    if (!sources[name]) continue;
    drawHorizontalEpi(byId(`epi-h-${name}`), sources[name], row);
    drawVerticalEpi(byId(`epi-v-${name}`), sources[name], column);
  }
  const x = Math.round(state.x * nativeScale), y = Math.round(state.y * nativeScale);
  const ends = ([from, shown]) =>
    `${Math.round(from * nativeScale)} to ${Math.round((from + shown) * nativeScale) - 1}`;
  byId("epi-horizontal-name").textContent =
    `Horizontal, at y ${y}, v ${row}: x ${ends(stretch(state.x, width))} along, u 0 to ${columns - 1} down`;
  byId("epi-vertical-name").textContent =
    `Vertical, at x ${x}, u ${column}: y ${ends(stretch(state.y, height))} along, v 0 to ${rows - 1} down`;
  byId("line-y").value = state.y; byId("line-y-value").textContent = y;
  byId("line-x").value = state.x; byId("line-x-value").textContent = x;
});

// Error map

const drawError = oncePerFrame(() => {
  if (!sources.errorViews) return;
  const canvas = byId("error-map");
  if (state.errorKind === "mean") {
    drawHeat(canvas, sources.errorMean, 0, 0, width, height);
    byId("error-caption").innerHTML = "<strong>Averaged over all views</strong>";
  } else {
    drawHeat(canvas, sources.errorViews, state.u * tileWidth, state.v * tileHeight, width, height);
    byId("error-caption").innerHTML = `<strong>View v ${state.v}, u ${state.u}</strong>`;
  }
});

function readError(event) {
  const [fx, fy] = place(event, byId("error-map"));
  const x = Math.floor(fx * width), y = Math.floor(fy * height);
  const mean = state.errorKind === "mean", source = mean ? sources.errorMean : sources.errorViews;
  const level = source.getContext("2d").getImageData(
    x + (mean ? 0 : state.u * tileWidth), y + (mean ? 0 : state.v * tileHeight), 1, 1).data[0];
  const value = (level / 255) * data.error.scale;
  byId("error-readout").textContent =
    `x ${Math.round(x * nativeScale)}, y ${Math.round(y * nativeScale)}: ` +
    (level === 255 ? `${data.error.scale} or more` : `about ${value.toPrecision(2)}`);
}

// Frames: a switcher, the whole frame, and its pixels around the cursor

function frameViewer(host, frames, name) {
  if (!frames.length) { host.innerHTML = '<p class="quiet">None were handed to this report.</p>'; return Promise.resolve(); }
  const tile = data.cfaTile;
  host.innerHTML = `
    <div class="tabs" role="group" aria-label="${name}"></div>
    <div class="frame">
      <div class="stage"><canvas class="picture follow" tabindex="0" role="img" aria-label="${name}; arrow keys move the magnifier"></canvas><i></i></div>
      <figure><canvas class="picture pixels" role="img" aria-label="${name}, pixels around the cursor"></canvas>
        <p class="readout"></p></figure>
    </div>`;
  const [whole, zoom] = host.querySelectorAll("canvas");
  const tabs = host.querySelector(".tabs"), readout = host.querySelector(".readout");
  let shown = 0, cursor = null, tinted = false;
  const pictures = [];

  frames.forEach((frame, i) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = frame.label;
    button.addEventListener("click", () => { shown = i; draw(); });
    tabs.append(button);
  });
  if (tile) {
    const label = document.createElement("label"), box = document.createElement("input");
    box.type = "checkbox";
    box.addEventListener("change", () => { tinted = box.checked; draw(); });
    label.append(box, "in the colours of the filter");
    tabs.append(label);
  }

  function pixelsOf(x, y, w, h) {
    const image = pictures[shown].getContext("2d").getImageData(x, y, w, h), p = image.data;
    if (!tinted) return image;
    for (let i = 0; i < p.length; i += 4) {
      const column = x + ((i / 4) % w), row = y + Math.floor(i / 4 / w);
      const filters = tile[row % tile.length], colour = filters[column % filters.length];
      for (let c = 0; c < 3; c++) p[i + c] *= 0.2 + 0.8 * colour[c];
    }
    return image;
  }

  function draw() {
    const { width: w, height: h } = pictures[shown];
    cursor ??= [w >> 1, h >> 1];
    cursor = [clamp(cursor[0], 0, w - 1), clamp(cursor[1], 0, h - 1)];
    setSize(whole, w, h);
    whole.getContext("2d").putImageData(pixelsOf(0, 0, w, h), 0, 0);
    const side = Math.min(36, w, h);
    const left = clamp(cursor[0] - (side >> 1), 0, w - side), top = clamp(cursor[1] - (side >> 1), 0, h - side);
    cover(host.querySelector(".stage i"), left, top, side, side, w, h);
    setSize(zoom, side, side);
    zoom.getContext("2d").putImageData(pixelsOf(left, top, side, side), 0, 0);
    const level = pictures[shown].getContext("2d").getImageData(cursor[0], cursor[1], 1, 1).data[0];
    const value = frames[shown].white * Math.pow(level / 255, frames[shown].gamma);
    const written = level === 255 ? `${value.toPrecision(2)} or more` : `about ${value.toPrecision(2)}`;
    readout.textContent = `x ${cursor[0]}, y ${cursor[1]}: ${written}. ${side} × ${side} pixels; ` +
      `screen value = ${screenValue(frames[shown])}.`;
    [...tabs.querySelectorAll("button")].forEach((b, i) => b.setAttribute("aria-pressed", String(i === shown)));
  }

  const redraw = oncePerFrame(draw);
  const follow = (event) => {
    const [fx, fy] = place(event, whole);
    cursor = [Math.floor(fx * whole.width), Math.floor(fy * whole.height)];
    redraw();
  };
  whole.addEventListener("pointermove", follow);
  whole.addEventListener("pointerdown", follow);
  onArrows(whole, (dx, dy) => { cursor = [cursor[0] + dx, cursor[1] + dy]; redraw(); });
  return Promise.all(frames.map((frame) => decoded(frame.picture))).then((loaded) => {
    pictures.push(...loaded);
    whole.classList.toggle("pixels", loaded[0].width < 320);
    draw();
  });
}

// Events

function onArrows(element, move) {
  const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  element.addEventListener("keydown", (event) => {
    const way = ways[event.key];
    if (!way) return;
    event.preventDefault();
    const step = event.shiftKey ? 10 : 1;
    move(way[0] * step, way[1] * step);
  });
}

function chooseView(v, u) {
  v = clamp(v, 0, rows - 1);
  u = clamp(u, 0, columns - 1);
  if (v === state.v && u === state.u) return;
  state.v = v;
  state.u = u;
  drawViews();
  if (state.errorKind === "view") drawError();
}

function choosePoint(x, y) {
  state.x = clamp(x, 0, width - 1);
  state.y = clamp(y, 0, height - 1);
  drawViews();
  drawEpi();
}

function listen() {
  for (const canvas of [byId("view-truth"), byId("view-estimate")]) {
    const follow = (event) => {
      stopSweep();
      const [fx, fy] = place(event, canvas);
      chooseView(Math.floor(fy * rows), Math.floor(fx * columns));
    };
    canvas.addEventListener("pointermove", follow);
    canvas.addEventListener("pointerdown", follow);
    canvas.addEventListener("click", (event) => {
      const [fx, fy] = place(event, canvas);
      choosePoint(Math.floor(fx * width), Math.floor(fy * height));
    });
    onArrows(canvas, (dx, dy) => chooseView(state.v + Math.sign(dy), state.u + Math.sign(dx)));
  }
  byId("view-row").addEventListener("input", (event) => chooseView(+event.target.value, state.u));
  byId("view-column").addEventListener("input", (event) => chooseView(state.v, +event.target.value));
  byId("view-grid").addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (button) chooseView(+button.dataset.v, +button.dataset.u);
  });
  byId("brightness").addEventListener("input", (event) => {
    const value = +event.target.value;
    byId("brightness-value").textContent = value.toFixed(2);
    for (const canvas of document.querySelectorAll("canvas.scene")) canvas.style.filter = `brightness(${value})`;
  });
  byId("flip").addEventListener("click", () => {
    state.flipped = !state.flipped;
    byId("flip").setAttribute("aria-pressed", String(state.flipped));
    drawViews();
  });
  byId("sweep").addEventListener("click", () => (sweep ? stopSweep() : startSweep()));

  byId("refocus-slider").addEventListener("input", refocusChanged);

  const map = byId("epi-map");
  const choose = (event) => {
    if (event.type === "pointermove" && !event.buttons) return;
    const [fx, fy] = place(event, map);
    choosePoint(Math.floor(fx * width), Math.floor(fy * height));
  };
  map.addEventListener("pointerdown", choose);
  map.addEventListener("pointermove", choose);
  onArrows(map, (dx, dy) => choosePoint(state.x + dx, state.y + dy));
  byId("whole-line").addEventListener("change", drawEpi);
  byId("line-y").addEventListener("input", (event) => choosePoint(state.x, +event.target.value));
  byId("line-x").addEventListener("input", (event) => choosePoint(+event.target.value, state.y));

  for (const radio of document.querySelectorAll("input[name=error-kind]"))
    radio.addEventListener("change", () => { state.errorKind = radio.value; drawError(); });
  byId("error-map").addEventListener("pointermove", readError);
}

// A sweep walks round the outermost views, the largest parallax there is.
let sweep = 0;
function startSweep() {
  const path = [];
  for (let u = 0; u < columns; u++) path.push([0, u]);
  for (let v = 1; v < rows; v++) path.push([v, columns - 1]);
  for (let u = columns - 2; u >= 0; u--) path.push([rows - 1, u]);
  for (let v = rows - 2; v > 0; v--) path.push([v, 0]);
  let at = 0;
  sweep = setInterval(() => chooseView(...path[at++ % path.length]), 130);
  byId("sweep").setAttribute("aria-pressed", "true");
}
function stopSweep() {
  clearInterval(sweep);
  sweep = 0;
  byId("sweep").setAttribute("aria-pressed", "false");
}

function prepareControls() {
  byId("view-row").max = rows - 1;
  byId("view-column").max = columns - 1;
  byId("line-y").max = height - 1;
  byId("line-x").max = width - 1;
  byId("view-grid").style.gridTemplateColumns = `repeat(${columns}, 1fr)`;
  const slider = byId("refocus-slider"), [low, high] = data.disparity;
  slider.min = low;
  slider.max = high;
  slider.value = clamp(0, low, high);
  // Small pictures are shown as pixels, not as a blur.
  if (width < 320)
    for (const canvas of document.querySelectorAll("canvas.scene")) canvas.classList.add("pixels");
  if (data.error) byId("error-scale").textContent = `${data.error.scale} and more`;
}

async function main() {
  prepareControls();
  await viewerShown; // what is seen first comes first
  const frames = [
    frameViewer(byId("shots"), data.shots, "Captured frames"),
    frameViewer(byId("whiteboards"), data.whiteboards, "Whiteboard frames"),
  ];
  const named = data.truth ? { errorMean: data.error.mean, errorViews: data.error.views, truth: data.truth } : {};
  for (const [name, picture] of Object.entries({ ...named, estimate: data.estimate }))
    sources[name] = await decoded(picture);
  listen();
  drawViews();
  drawEpi();
  drawError();
  byId("refocus-value").textContent = (+byId("refocus-slider").value).toFixed(2);
  (window.requestIdleCallback ?? setTimeout)(() => drawRefocus("full")); // below what is seen first
  await Promise.all(frames);
  document.documentElement.dataset.ready = "yes";
}

main().catch((error) => {
  const failure = byId("failure");
  failure.style.display = "block";
  failure.textContent = `The pictures could not be drawn (${error}). The figures below are complete.`;
  console.error(error);
});
})();
