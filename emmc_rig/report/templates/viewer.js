"use strict";
// Pictures in the page as canvases that hold their pixels; each is decoded once.
const decoded = (() => {
  const known = new Map();
  async function decode(uri) {
    const image = new Image();
    image.src = uri;
    await image.decode();
    const canvas = document.createElement("canvas");
    canvas.width = image.naturalWidth;
    canvas.height = image.naturalHeight;
    canvas.getContext("2d", { willReadFrequently: true }).drawImage(image, 0, 0);
    return canvas;
  }
  const once = (uri) => {
    if (!known.has(uri)) known.set(uri, decode(uri));
    return known.get(uri);
  };
  return Object.assign(once, { forget: () => known.clear() });
})();

// A light field to turn, focus and look into. The shader is the twin of model/novel_view.py.
const lightFieldViewer = (() => {
const byId = (id) => document.getElementById(`viewer-${id}`);
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const picture = byId("picture");
const state = { overlay: -1 };
let data, rows, columns, width, height, tileWidth, tileHeight, count, farthest; // of what is shown
let renderer, atlases = {}, depth, overlayLevels = [];
const middle = (count) => (data.axes ? Math.floor(count / 2) : (count - 1) / 2);
const home = () => ({ v: middle(rows), u: middle(columns), focus: data.focus.at, aperture: 0, wipe: 0 });
const breath = () => new Promise((done) => setTimeout(done)); // lets the page answer in between

const VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2DArray;
uniform sampler2DArray views, depths;
uniform sampler2D overlay;
uniform ivec2 grid;
uniform vec2 size, shown, range, position;  // shown: pixels of the canvas; position: (u, v), in view steps
uniform float focus, aperture, gamma, wipe, opacity;
uniform bool compared;
out vec4 colour;

const float TOLERANCE = 0.25, LEAST = 1e-3;
const float FLAT = 0.01, STILL = 0.002; // pixels: what is nearer around a place, and the last step, do not matter

vec2 p;
int first;  // layer of the first view: the truth's or the estimate's

int layer(ivec2 view) { return view.y * grid.x + view.x; }
vec3 seen(ivec2 view, vec2 at) { return texture(views, vec3((at + 0.5) / size, first + layer(view))).rgb; }
vec2 depthsAt(ivec2 view, vec2 at) { // there, and the nearest around
  return mix(range.xx, range.yy, texture(depths, vec3((at + 0.5) / size, layer(view))).rg);
}
float depthAt(ivec2 view, vec2 at) { return depthsAt(view, at).r; }

vec3 between(out float surface) {
  ivec2 corner = clamp(ivec2(floor(position)), ivec2(0), max(grid - 2, ivec2(0)));
  vec3 colours[4];
  float shares[4], found[4], missed[4], nearest = -1e9;
  for (int k = 0; k < 4; k++) {
    ivec2 view = corner + ivec2(k & 1, k >> 1);
    vec2 away = vec2(view) - position;
    shares[k] = max((1.0 - abs(away.x)) * (1.0 - abs(away.y)), 0.0);
    if (shares[k] <= 0.0) continue;
    vec2 here = depthsAt(view, p);
    float d = here.r, before = d;
    if (here.g - d > FLAT)
      for (int guess = 0; guess < 3; guess++)
        d = max(d, depthAt(view, p + mix(range.x, range.y, float(guess) * 0.5) * away));
    for (int step = 0; step < 4; step++) {
      before = d;
      d = depthAt(view, p + before * away);
      if (abs(d - before) < STILL) break;
    }
    missed[k] = abs(d - before);
    found[k] = before;
    colours[k] = seen(view, p + before * away);
    nearest = max(nearest, before - missed[k]);
  }
  vec3 total = vec3(0.0);
  float weights = 0.0;
  surface = 0.0;
  for (int k = 0; k < 4; k++) {
    if (shares[k] <= 0.0) continue;
    float off = missed[k] / TOLERANCE;
    float weight = shares[k] * (exp(-(nearest - (found[k] - missed[k])) / TOLERANCE) / (1.0 + off * off) + LEAST);
    total += weight * colours[k];
    surface += weight * found[k];
    weights += weight;
  }
  surface /= weights;
  return total / weights;
}

void main() {
  p = vec2(gl_FragCoord.x, shown.y - gl_FragCoord.y) * (size / shown) - 0.5;
  first = compared && p.x + 0.5 < wipe * size.x ? grid.x * grid.y : 0;
  float surface = focus, weights = max(0.0, 1.0 - aperture);
  vec3 total = vec3(0.0);
  if (weights > 0.0 || opacity > 0.0) {
    vec3 pinhole = between(surface);
    colour = vec4(pinhole, 1.0);
    total = weights * pow(pinhole, vec3(gamma));
  }
  if (aperture > 0.0) {
    for (int j = 0; j < grid.y; j++)
      for (int i = 0; i < grid.x; i++) {
        vec2 away = vec2(i, j) - position;
        float weight = clamp(aperture - length(away), 0.0, 1.0);
        if (weight <= 0.0) continue;
        total += weight * pow(seen(ivec2(i, j), p + focus * away), vec3(gamma));
        weights += weight;
      }
    colour = vec4(pow(total / weights, vec3(1.0 / gamma)), 1.0);
  }
  if (opacity > 0.0 && (first == 0 || opacity < 1.0)) { // a picture is laid over the estimate alone
    vec2 centre = vec2(grid / 2);
    vec4 laid = texture(overlay, (p + surface * (centre - position) + 0.5) / size);
    colour.rgb = mix(colour.rgb, laid.rgb, opacity * laid.a);
  }
}`;

// Put into green the largest code within a view step's shift of every pixel: by blocks, of nine in one square.
function addNearest(codes) {
  const side = Math.ceil(Math.max(Math.abs(data.disparity.low), Math.abs(data.disparity.high), 1)) + 1;
  const across = Math.ceil(width / side), down = Math.ceil(height / side);
  const blocks = new Uint8Array(across * down), around = new Uint8Array(across);
  const eachRun = (y, visit) => {
    for (let block = 0, x = 0; x < width; block++, x += side)
      visit(block, y * width + x, y * width + Math.min(x + side, width));
  };
  for (let y = 0; y < height; y++) {
    const row = Math.floor(y / side) * across;
    eachRun(y, (block, from, to) => {
      let most = blocks[row + block];
      for (let i = from; i < to; i++) if (codes[4 * i] > most) most = codes[4 * i];
      blocks[row + block] = most;
    });
  }
  for (let y = 0; y < height; y++) {
    const row = Math.floor(y / side);
    if (y % side === 0) {
      around.fill(0);
      for (let j = Math.max(row - 1, 0); j <= Math.min(row + 1, down - 1); j++)
        for (let x = 0; x < across; x++)
          for (let i = Math.max(x - 1, 0); i <= Math.min(x + 1, across - 1); i++)
            around[x] = Math.max(around[x], blocks[j * across + i]);
    }
    eachRun(y, (block, from, to) => {
      for (let i = from; i < to; i++) codes[4 * i + 1] = around[block];
    });
  }
}

function webgl(canvas) {
  const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
  if (!gl || gl.getParameter(gl.MAX_ARRAY_TEXTURE_LAYERS) < 2 * count) return null;
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  gl.useProgram(program);
  const at = (name) => gl.getUniformLocation(program, name);
  gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);

  const made = [];
  function texture(unit, kind) {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.deleteTexture(made[unit] ?? null);
    gl.bindTexture(kind, made[unit] = gl.createTexture());
    for (const [name, value] of [
      [gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
      [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
    ]) gl.texParameteri(kind, name, value);
  }
  function layers(unit, many) {
    texture(unit, gl.TEXTURE_2D_ARRAY);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA8, width, height, many);
  }
  function upload(unit, atlas, view, layer, prepare) {
    const codes = atlas.getContext("2d").getImageData(
      (view % columns) * tileWidth, Math.floor(view / columns) * tileHeight, width, height).data;
    prepare?.(codes);
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.texSubImage3D(
      gl.TEXTURE_2D_ARRAY, 0, 0, 0, layer, width, height, 1, gl.RGBA, gl.UNSIGNED_BYTE, codes);
  }
  const [shown, position, focus, aperture, wipe, opacity] =
    ["shown", "position", "focus", "aperture", "wipe", "opacity"].map(at);
  return {
    kind: "WebGL2",
    load() {
    layers(0, data.truth ? 2 * count : count);
    layers(1, count);
    for (let view = 0; view < count; view++) {
      upload(0, atlases.estimate, view, view);
      upload(1, depth, view, view, addNearest);
    }
    texture(2, gl.TEXTURE_2D);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    gl.uniform1i(at("compared"), 0);
    gl.uniform1i(at("views"), 0);
    gl.uniform1i(at("depths"), 1);
    gl.uniform1i(at("overlay"), 2);
    gl.uniform2i(at("grid"), columns, rows);
    gl.uniform2f(at("size"), width, height);
    gl.uniform2f(at("range"), data.disparity.low, data.disparity.high);
    gl.uniform1f(at("gamma"), data.gamma);
    },
    async compare(truth) {
      for (let view = 0; view < count; view++) {
        upload(0, truth, view, count + view);
        if (view % columns === columns - 1) await breath();
      }
      gl.uniform1i(at("compared"), 1);
    },
    draw() {
      const across = Math.ceil(width / detail), down = Math.ceil(height / detail);
      if (canvas.width !== across) Object.assign(canvas, { width: across, height: down });
      gl.viewport(0, 0, across, down);
      gl.uniform2f(shown, across, down);
      gl.uniform2f(position, state.u, state.v);
      gl.uniform1f(focus, state.focus);
      gl.uniform1f(aperture, state.aperture);
      gl.uniform1f(wipe, state.wipe);
      gl.uniform1f(opacity, state.overlay < 0 ? 0 : opacityOf(data.overlays[state.overlay]));
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    },
    lay(coloured) {
      gl.activeTexture(gl.TEXTURE2);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, coloured.data);
    },
    finish() { gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)); },
  };
}

// Without WebGL2: the nearest view, and views laid over each other in equal shares.
function plain(canvas) {
  const context = canvas.getContext("2d");
  let laid = null;
  const view = (source, v, u, dx, dy) => context.drawImage(
    source, u * tileWidth, v * tileHeight, width, height, dx, dy, width, height);
  function scene(source) {
    const open = [];
    for (let v = 0; v < rows; v++)
      for (let u = 0; u < columns; u++)
        if (Math.hypot(v - state.v, u - state.u) < state.aperture) open.push([v, u]);
    if (open.length < 2) { view(source, Math.round(state.v), Math.round(state.u), 0, 0); return; }
    open.forEach(([v, u], k) => {
      context.globalAlpha = 1 / (k + 1);
      view(source, v, u, -state.focus * (u - state.u), -state.focus * (v - state.v));
    });
    context.globalAlpha = 1;
  }
  return {
    kind: "plain canvas",
    load() { Object.assign(canvas, { width, height }); laid = null; },
    async compare() {},
    draw() {
      const overlay = laid && data.overlays[state.overlay];
      const lay = () => {
        context.globalAlpha = opacityOf(overlay);
        context.drawImage(laid, 0, 0);
        context.globalAlpha = 1;
      };
      scene(atlases.estimate);
      if (overlay && opacityOf(overlay) === 1) lay();
      if (atlases.truth && state.wipe > 0) {
        context.save();
        context.beginPath();
        context.rect(0, 0, state.wipe * width, height);
        context.clip();
        scene(atlases.truth);
        context.restore();
      }
      if (overlay && opacityOf(overlay) < 1) lay();
    },
    lay(coloured) {
      laid = document.createElement("canvas");
      laid.width = width;
      laid.height = height;
      laid.getContext("2d").putImageData(coloured, 0, 0);
    },
    finish() {},
  };
}

// Drawing: once per screen refresh, however many events asked for it. Where that is slower than
// the hand, every second or fourth pixel is drawn while it moves, and all of them when it rests.

const SLOW_MS = 30, REST_MS = 150, COARSEST = 4;
let detail = 1, moving = 1, slow = 0, waiting = false, resting = 0;
function changed() {
  if (waiting) return;
  waiting = true;
  const asked = performance.now();
  requestAnimationFrame((now) => {
    waiting = false;
    slow = now - asked > SLOW_MS ? slow + 1 : 0;
    if (slow > 2 && moving < COARSEST) { moving *= 2; slow = 0; }
    detail = moving;
    draw();
    clearTimeout(resting);
    resting = setTimeout(() => { if (detail > 1) { detail = 1; draw(); } }, REST_MS);
  });
}

function draw() {
  renderer.draw();
  byId("aperture").value = state.aperture;
  byId("aperture-value").textContent = state.aperture.toFixed(2);
  byId("focus").value = state.focus;
  byId("focus-value").textContent = [`${(state.focus / data.scale).toFixed(2)} px`, ...depthAt(state.focus)].join(", ");
  byId("wipe").value = state.wipe;
  const inside = state.wipe > 0 && state.wipe < 1; // of the picture: each side that there is has its name
  for (const [id, there] of [["wipe-line", inside], ["side-left", state.wipe > 0], ["side-right", state.wipe < 1]])
    byId(id).hidden = !atlases.truth || !there;
  if (atlases.truth && inside) {
    const { left, scale } = shownAt(), stage = byId("stage").getBoundingClientRect();
    byId("wipe-line").style.left = `${left - stage.left + state.wipe * width * scale}px`;
  }
  drawEpi();
  byId("status").textContent =
    [`${viewpoint()}; at x ${Math.round(state.x / data.scale)}, y ${Math.round(state.y / data.scale)}`, reading()]
      .filter(Boolean).join(": ");
}

// Bands and times are called so, and counted; views at angles have coordinates.
function viewpoint() {
  if (!data.axes) return `View v ${state.v.toFixed(2)}, u ${state.u.toFixed(2)}`;
  const named = data.axes.map((name, k) => name && `${name} ${[state.v, state.u][k].toFixed(2).replace(/\.?0+$/, "")}`);
  const words = named.filter(Boolean).join(", ");
  return words[0].toUpperCase() + words.slice(1);
}

function depthHere() {
  const u = Math.round(state.u), v = Math.round(state.v);
  const code = depth.getContext("2d").getImageData(
    u * tileWidth + state.x, v * tileHeight + state.y, 1, 1).data[0];
  return data.disparity.low + (code / 255) * (data.disparity.high - data.disparity.low);
}

// The depth of a disparity in words, with its deviation, where the optics are known: the twin of model/optics.py.
function depthAt(disparity, deviation) {
  if (!data.optics) return [];
  const { focus_mm, per_px } = data.optics, nearness = 1 / focus_mm + (disparity / data.scale) * per_px;
  if (nearness <= 0) return ["beyond infinity"];
  const mm = 1 / nearness, away = deviation && ` \u00b1 ${+(mm * mm * per_px * deviation.value).toPrecision(2)}`;
  return [`depth ${+mm.toPrecision(3)}${away || ""} mm${deviation?.most ? " or more" : ""}`];
}

// What a map says at a place; most: it ends there. Null where it is unknown or not decoded yet.
function valueAt(map, x, y) {
  const levels = overlayLevels[data.overlays.indexOf(map)], at = 4 * (y * width + x);
  if (!levels?.data[at + 3]) return null;
  const level = levels.data[at] / 255;
  return { value: map.low + level * (map.high - map.low), most: level >= 1 };
}

function reading() {
  const d = depthHere();
  const middle = [Math.floor(columns / 2), Math.floor(rows / 2)];
  const x = clamp(Math.round(state.x + d * (middle[0] - state.u)), 0, width - 1);
  const y = clamp(Math.round(state.y + d * (middle[1] - state.v)), 0, height - 1);
  const deviation = data.overlays.find((map) => map.key === "disparity_sigma");
  const here = data.axes ? [] : [`disparity ${(d / data.scale).toFixed(2)} px`, ...depthAt(d, deviation && valueAt(deviation, x, y))];
  data.overlays.forEach((map, k) => {
    if (map.key.startsWith("disparity") || !map.colours || !overlayLevels[k]) return;
    const found = valueAt(map, x, y);
    here.push(found ? `${map.label} ${found.most ? "at least " : ""}${found.value.toPrecision(2)} ${map.unit}`.trimEnd()
      : `${map.label} unknown`);
  });
  return here.join(", ");
}

function drawEpi() {
  const source = atlases.truth && state.x < state.wipe * width ? atlases.truth : atlases.estimate;
  const v = Math.round(state.v), u = Math.round(state.u);
  const across = byId("epi-h"), down = byId("epi-v");
  across.width = width; across.height = columns;
  const drawn = across.getContext("2d");
  for (let k = 0; k < columns; k++)
    drawn.drawImage(source, k * tileWidth, v * tileHeight + state.y, width, 1, 0, k, width, 1);
  drawn.fillStyle = "#fff9";
  drawn.fillRect(state.x, 0, 1, columns);
  down.width = height; down.height = rows;
  const other = down.getContext("2d");
  other.setTransform(0, 1, 1, 0, 0, 0); // y along the strip, v down it
  for (let k = 0; k < rows; k++)
    other.drawImage(source, u * tileWidth + state.x, k * tileHeight, 1, height, k, 0, 1, height);
  other.fillStyle = "#fff9";
  other.fillRect(0, state.y, rows, 1);
}

// A map lets the picture through, a picture (it has no scale of colours) does not.
const opacityOf = (overlay) => (overlay.colours ? 0.7 : 1);

function colourOf(colours, at) {
  const last = colours.length - 1, place = at * last;
  const k = Math.min(Math.floor(place), last - 1);
  return [0, 1, 2].map((c) => Math.round(colours[k][c] + (place - k) * (colours[k + 1][c] - colours[k][c])));
}

function choose(overlay) {
  state.overlay = overlay < data.overlays.length ? overlay : -1;
  if (!overlayLevels[state.overlay]) state.overlay = -1; // until they are decoded
  for (const input of byId("overlays").querySelectorAll("input")) input.checked = +input.value === state.overlay;
  const legend = byId("legend"), map = data.overlays[state.overlay];
  legend.hidden = !map?.colours;
  legend.replaceChildren();
  if (map && !map.colours) renderer.lay(overlayLevels[state.overlay]);
  else if (map) {
    const levels = overlayLevels[state.overlay], coloured = new ImageData(width, height);
    const table = Array.from({ length: 256 }, (_, i) => colourOf(map.colours, i / 255));
    for (let i = 0; i < coloured.data.length; i += 4) {
      const [r, g, b] = table[levels.data[i]];
      coloured.data.set([r, g, b, levels.data[i + 3]], i);
    }
    renderer.lay(coloured);
    const add = (to, kind, text) => {
      const made = to.appendChild(document.createElement(kind));
      made.textContent = text;
      return made;
    };
    add(legend, "i", "").style.background = `linear-gradient(90deg,${map.colours.map((c) => `rgb(${c})`)})`;
    const ends = add(legend, "div", "");
    add(ends, "span", map.low.toPrecision(2));
    add(ends, "span", `${map.high.toPrecision(2)} ${map.unit}`);
  }
  changed();
}

// Acting: pointer, wheel, keys

function set(more) {
  stopAnimation();
  Object.assign(state, more);
  state.v = clamp(state.v, 0, rows - 1);
  state.u = clamp(state.u, 0, columns - 1);
  state.aperture = clamp(state.aperture, 0, farthest);
  state.focus = clamp(state.focus, data.focus.low, data.focus.high);
  state.wipe = clamp(state.wipe, 0, 1);
  changed();
}

// Where the picture is on the screen: in full screen the canvas is wider or taller than it.
function shownAt() {
  const box = picture.getBoundingClientRect();
  const scale = Math.min(box.width / width, box.height / height);
  return {
    box, scale,
    left: box.left + (box.width - scale * width) / 2, top: box.top + (box.height - scale * height) / 2,
  };
}

function place(event) {
  const { box, scale, left, top } = shownAt();
  return {
    x: clamp(Math.floor((event.clientX - left) / scale), 0, width - 1),
    y: clamp(Math.floor((event.clientY - top) / scale), 0, height - 1), box,
  };
}

let gliding = 0;
function focusOn(x, y, event) {
  Object.assign(state, { x, y });
  if (data.axes) { changed(); return; }
  const from = state.focus, to = depthHere(), begun = performance.now();
  const mark = byId("mark"), stage = byId("stage").getBoundingClientRect();
  mark.style.left = `${event.clientX - stage.left}px`;
  mark.style.top = `${event.clientY - stage.top}px`;
  mark.style.opacity = 1;
  setTimeout(() => { mark.style.opacity = 0; }, 500);
  if (state.aperture < 1) state.aperture = Math.max(rows, columns) / 2;
  cancelAnimationFrame(gliding);
  const glide = (now) => {
    const share = reduced ? 1 : clamp((now - begun) / 260, 0, 1);
    state.focus = from + (to - from) * share * (2 - share);
    changed();
    if (share < 1) gliding = requestAnimationFrame(glide);
  };
  glide(performance.now());
}

const reduced = matchMedia("(prefers-reduced-motion: reduce)").matches;
let animating = 0;
function animate() {
  if (animating) { stopAnimation(); return; }
  byId("animate").setAttribute("aria-pressed", "true");
  const begun = performance.now();
  const turn = (now) => {
    const angle = (now - begun) / 650;
    state.v = ((rows - 1) / 2) * (1 + 0.85 * Math.sin(angle));
    state.u = ((columns - 1) / 2) * (1 + 0.85 * Math.cos(angle));
    changed();
    animating = requestAnimationFrame(turn);
  };
  animating = requestAnimationFrame(turn);
}
function stopAnimation() {
  cancelAnimationFrame(animating);
  animating = 0;
  byId("animate").setAttribute("aria-pressed", "false");
}

function listen() {
  const down = new Map();
  let moved = 0, spread = 0;
  picture.addEventListener("pointerdown", (event) => {
    picture.setPointerCapture(event.pointerId);
    down.set(event.pointerId, event);
    moved = 0;
    spread = 0;
  });
  picture.addEventListener("pointermove", (event) => {
    const { x, y, box } = place(event), before = down.get(event.pointerId);
    if (before === undefined) { Object.assign(state, { x, y }); changed(); return; }
    const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY;
    down.set(event.pointerId, event);
    moved += Math.hypot(dx, dy);
    if (down.size === 2) {
      const [a, b] = [...down.values()];
      const apart = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
      if (spread) set({ aperture: state.aperture + ((apart - spread) / box.width) * farthest });
      spread = apart;
    } else if (moved > 4) {
      // The scene follows the hand: a whole picture's width is all the views there are.
      set({
        u: state.u - (dx / box.width) * 1.6 * (columns - 1), v: state.v - (dy / box.height) * 1.6 * (rows - 1),
      });
    }
  });
  const up = (event) => {
    if (down.size === 1 && moved <= 4 && event.type === "pointerup") {
      const { x, y } = place(event);
      focusOn(x, y, event);
    }
    down.delete(event.pointerId);
  };
  picture.addEventListener("pointerup", up);
  picture.addEventListener("pointercancel", up);
  picture.addEventListener("wheel", (event) => {
    if (event.ctrlKey) return; // the browser's own zoom
    event.preventDefault();
    set({ aperture: state.aperture - Math.sign(event.deltaY) * 0.25 });
  }, { passive: false });
  const next = () => (data.axes ? 1 : 0.1);
  const step = () => (data.focus.high - data.focus.low) / 60;
  const keys = {
    ArrowLeft: () => set({ u: state.u - next() }), ArrowRight: () => set({ u: state.u + next() }),
    ArrowUp: () => set({ v: state.v - next() }), ArrowDown: () => set({ v: state.v + next() }),
    "+": () => set({ aperture: state.aperture + 0.25 }), "=": () => set({ aperture: state.aperture + 0.25 }),
    "-": () => set({ aperture: state.aperture - 0.25 }),
    PageUp: () => set({ focus: state.focus + step() }), PageDown: () => set({ focus: state.focus - step() }),
    w: () => atlases.truth && set({ wipe: state.wipe ? 0 : 0.5 }),
    " ": animate, r: reset, f: full,
  };
  picture.addEventListener("keydown", (event) => {
    const number = "012345".indexOf(event.key);
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (number >= 0) choose(number - 1);
    else if (keys[event.key]) keys[event.key]();
    else return;
    event.preventDefault();
  });
  for (const name of ["aperture", "focus", "wipe"])
    byId(name).addEventListener("input", (event) => set({ [name]: +event.target.value }));
  byId("animate").addEventListener("click", animate);
  byId("reset").addEventListener("click", reset);
  byId("full").addEventListener("click", full);
  addEventListener("resize", changed);
}

function reset() { set(home()); choose(-1); }
function full() {
  if (document.fullscreenElement) document.exitFullscreen();
  else byId("stage").requestFullscreen?.().then(() => picture.focus());
}

function prepareControls() {
  byId("aperture").max = farthest;
  byId("focus").min = data.focus.low;
  byId("focus").max = data.focus.high;
  for (const element of document.querySelectorAll(".viewer-with-truth")) element.hidden = !data.truth;
  for (const element of document.querySelectorAll(".viewer-angles")) element.hidden = Boolean(data.axes);
  if (data.axes) nameAxes(data.axes);
  byId("no-depth").hidden = !data.no_depth;
  byId("no-depth").textContent = data.no_depth;
  const choices = ["nothing", ...data.overlays.map((map) => map.label)];
  const there = [...byId("overlays").querySelectorAll("label")];
  if (choices.join() === there.map((row) => row.textContent).join()) return; // a choice may have the focus
  for (const row of there) row.remove();
  choices.forEach((label, k) => {
    const row = byId("overlays").appendChild(document.createElement("label"));
    const input = row.appendChild(document.createElement("input"));
    Object.assign(input, { type: "radio", name: "viewer-overlay", value: k - 1, checked: !k });
    input.addEventListener("change", () => choose(k - 1));
    row.append(label);
  });
}

// Where views are bands or times: their names in place of viewpoint, aperture and epipolar images.
function nameAxes(axes) {
  const names = axes.filter(Boolean), words = names.join(" and ");
  picture.setAttribute("aria-label", `Pictures by ${words}. Arrow keys change it, plus and minus take a mean over several.`);
  byId("aperture-name").textContent = "Mean over";
  byId("turn").textContent = `change the ${words}`;
  byId("open").textContent = "take a mean over more or fewer";
  byId("epi-v-name").textContent = `Column by ${axes[0]}`;
  byId("epi-h-name").textContent = `Row by ${axes[1]}`;
  byId("epi-v").parentElement.hidden = !axes[0];
  byId("epi-h").parentElement.hidden = !axes[1];
  byId("epi-v").setAttribute("aria-label", `Column under the pointer, by ${axes[0]}`);
  byId("epi-h").setAttribute("aria-label", `Row under the pointer, by ${axes[1]}`);
}

// What the pictures are of; a place, a focus and an overlay stay chosen from one light field to the next.
function adopt(next) {
  const before = data, overlay = data?.overlays[state.overlay]?.key;
  const grown = before ? next.views.width / width : 1;
  data = next;
  ({ rows, columns, width, height } = data.views);
  const padded = (length) => Math.ceil(length / data.tile) * data.tile;
  [tileWidth, tileHeight, count] = [padded(width), padded(height), rows * columns];
  farthest = Math.hypot(rows - 1, columns - 1) + 1;
  if (!before) Object.assign(state, home(), { x: width >> 1, y: height >> 1 });
  state.x = clamp(Math.round(state.x * grown), 0, width - 1);
  state.y = clamp(Math.round(state.y * grown), 0, height - 1);
  state.focus = clamp(state.focus * grown, data.focus.low, data.focus.high);
  state.overlay = data.overlays.findIndex((map) => map.key === overlay);
  picture.style.aspectRatio = `${width} / ${height}`;
  byId("stage").style.maxWidth = `calc(80vh * ${width} / ${height})`;
}

// Show a light field, in place of the one before if there is one. Fulfilled when it can be turned;
// maps of the first, and a truth, are decoded after that.
async function take(next) {
  const replaced = Boolean(renderer);
  if (replaced) decoded.forget();
  const [estimate, disparities, maps] = await Promise.all(
    [decoded(next.estimate), decoded(next.disparity.atlas), replaced ? levelsOf(next) : []]);
  adopt(next);
  prepareControls();
  [atlases, depth, overlayLevels] = [{ estimate }, disparities, maps];
  const wanted = new URLSearchParams(location.search).get("renderer");
  renderer ??= (wanted === "plain" ? null : webgl(picture)) ?? plain(picture);
  renderer.load();
  if (replaced) choose(state.overlay);
  else listen();
  draw();
  byId("poster")?.remove();
  const viewer = document.getElementById("viewer");
  viewer.dataset.renderer = renderer.kind;
  viewer.dataset.ready = "yes";
  // For tests: set a state, draw it now, and how long a drawing takes.
  viewer.show = (more, pixels = 1) => { set(more); detail = pixels; draw(); renderer.finish(); };
  compare(next).then(() => { viewer.dataset.complete = "yes"; }, failed);
}

async function levelsOf(next) {
  const laid = await Promise.all(next.overlays.map((map) => decoded(map.picture)));
  return laid.map((canvas) => canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height));
}

// What is laid over the estimate and compared with it.
async function compare(next) {
  await breath();
  const maps = await levelsOf(next), truth = next.truth && await decoded(next.truth);
  if (data !== next) return;
  overlayLevels = maps;
  if (truth) {
    await renderer.compare(truth);
    atlases.truth = truth;
  }
  draw();
}

function failed(error) {
  byId("status").textContent = `The light field could not be drawn (${error}).`;
  console.error(error);
}
return { take: (next) => take(next).catch(failed), state };
})();

// What a page holds itself; the live page hands light fields over as they come.
const own = document.getElementById("viewer-data");
if (own) lightFieldViewer.take(JSON.parse(own.textContent));
