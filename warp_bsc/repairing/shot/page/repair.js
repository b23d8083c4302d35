// Fills in the page of a repair from its data: the timeline, a frame in 3D before and after, and the tables.
"use strict";

const BASE_COLORS = [[0.55, 0.66, 0.8], [0.6, 0.72, 0.62], [0.7, 0.64, 0.76], [0.58, 0.72, 0.72]];
const KEPT_COLOR = [0.62, 0.64, 0.67];
const SMALL_MOVE = [0.98, 0.8, 0.25], LARGE_MOVE = [0.8, 0.09, 0.11];
const meshColor = (mesh) => (data.meshes[mesh].kept ? KEPT_COLOR : BASE_COLORS[mesh % BASE_COLORS.length]);

// `amount` has the root of a move as a share of the largest one, so that small moves are seen, and the stretch around a
// vertex: the logarithm to base 3 of the factor by which its edges are longer or shorter at most.
const MOVED_SHADER = `#version 300 es
in vec3 start; in vec3 end; in vec3 color; in vec2 amount;
uniform mat4 view; uniform mat4 projection; uniform float time; uniform vec2 painted; uniform vec3 small; uniform vec3 large;
out vec3 place; out vec3 tint;
void main() {
  vec4 at = view * vec4(mix(start, end, time), 1.0);
  place = at.xyz;
  float share = dot(painted, amount);
  tint = mix(color, mix(small, large, share), min(1.0, 8.0 * share));
  gl_Position = projection * at;
}`;

const frames = data.frames.filter((frame) => frame.view !== null);
const edges = (length) => `${Number((length / data.edge_length).toPrecision(3))} edges`;

// --- The timeline ---

// Bars of a list of [from, to, ...numbers], some of them in one bar if there are many. `parts` and `text` get those.
function bars(list, width, parts, text) {
  const together = Math.ceil(list.length / (width / 2.5)), result = [];
  for (let at = 0; at < list.length; at += together) {
    const some = list.slice(at, at + together), [from, to] = [some[0][0], some[some.length - 1][1]];
    const time = `time ${short(from)}${to > from ? ` to ${short(to)}` : ""}`;
    result.push({ from, to: to > from ? to : from + 1, parts: parts(some), tip: `${time}\n${text(some)}`, click: () => viewer.showTime((from + to) / 2) });
  }
  return result;
}

function fillTimeline() {
  const width = Math.max(340, Math.min(1100, byId("moves").clientWidth || 1100));
  const most = (some) => some.reduce((largest, item) => Math.max(largest, item[2]), 0);
  const percent = (some) => Math.round((100 * most(some)) / data.edge_length);
  const marked = addBars(byId("moves"), bars(data.moves, width, (some) => [percent(some)], (some) => `largest move ${edges(most(some))}`), ["bar"], width, "time code", 160, 64);
  const kinds = [["collisions", "first"], ["intersections", "second"], ["pairs too near", "third"]].slice(0, data.has_distance ? 3 : 2);
  kinds.forEach(([name, color]) => addKey(byId("timeline-legend"), { class: color }, name));
  for (const [name, title] of [["before", "Before"], ["after", "After"]]) {
    const list = data[name];
    byId(name).hidden = !list;
    if (!list) {
      byId(`${name}-title`).textContent = `${title}: not checked`;
      continue;
    }
    const sum = (some, column) => some.reduce((total, item) => total + item[column], 0);
    const total = kinds.map(([what], column) => `${count(sum(list, 2 + column))} ${what}`).join(", ");
    byId(`${name}-title`).textContent = `${title}: ${total}`;
    const isFree = !kinds.some((_, column) => sum(list, 2 + column));
    byId(name).hidden = isFree;
    if (!isFree) addBars(byId(name), bars(list, width, (some) => kinds.map((_, column) => sum(some, 2 + column)), (some) => kinds.map(([what], column) => `${count(sum(some, 2 + column))} ${what}`).join("\n")), kinds.map(([, color]) => color), width, "", 90, 64);
  }
  const mark = add(marked.chart, "rect", { class: "mark", y: 2, height: marked.bottom - 1, rx: 3 });
  return (time) => {
    const index = data.moves.findIndex(([from, to]) => time >= from && time < to);
    const [from, to] = data.moves[index < 0 ? data.moves.length - 1 : index];
    mark.setAttribute("x", marked.x(from) - 1);
    mark.setAttribute("width", Math.max(3, marked.x(to > from ? to : from + 1) - marked.x(from) + 2));
  };
}

// --- The frame in 3D ---

const LONGEST = 3; // factor of the deepest colour
const STEPS = 8; // least length of an edge in steps of rounded positions whose stretch is shown

// Returns the arrays of a frame: positions before and after, and the amounts of the shader.
async function loadFrame({ view }) {
  const block = await unpack(`frame-${view}`);
  const topology = await unpack(`faces-${block.faces}`);
  const start = new Float32Array(block.before.length);
  block.before.forEach((value, i) => { start[i] = block.low[i % 3] + block.step * value; });
  const end = start.slice(), amount = new Float32Array((2 * start.length) / 3), moved = new Float32Array(3 * block.moved.length);
  block.moved.forEach((vertex, row) => {
    const added = block.displacement.subarray(3 * row, 3 * row + 3);
    for (let axis = 0; axis < 3; axis += 1) end[3 * vertex + axis] += added[axis];
    amount[2 * vertex] = Math.sqrt(Math.min(1, Math.hypot(...added) / data.largest));
    moved.set(end.subarray(3 * vertex, 3 * vertex + 3), 3 * row);
  });
  const length = (x, a, b) => Math.hypot(x[3 * a] - x[3 * b], x[3 * a + 1] - x[3 * b + 1], x[3 * a + 2] - x[3 * b + 2]);
  topology.faces.forEach((a, corner) => {
    const b = topology.faces[corner % 3 === 2 ? corner - 2 : corner + 1], before = length(start, a, b);
    if (before < STEPS * block.step) return;
    const stretch = Math.min(1, Math.abs(Math.log(length(end, a, b) / before)) / Math.log(LONGEST));
    for (const vertex of [a, b]) amount[2 * vertex + 1] = Math.max(amount[2 * vertex + 1], stretch);
  });
  return { start, end, amount, moved, faces: topology.faces, meshes: topology.mesh_of_vertex, of: block.of };
}

function makeViewer(markTime) {
  const message = byId("viewer-message");
  const say = (text) => { message.textContent = text; message.hidden = !text; };
  const { gl, ask, frame, begin, set, turn } = makeCanvas(byId("canvas"), data.up_axis === "Z", draw);
  if (!gl) say("This browser has no WebGL 2, which the view in 3D needs.");
  if (!frames.length) say("Nothing is moved.");
  const made = gl && program(gl, MOVED_SHADER, TRIANGLE_COLOR);
  const state = { index: -1, shown: null, blend: 1, painted: frames.some((one) => one.distortion) ? "stretch" : "moves", playing: false, last: 0, framed: false };

  async function show(index) {
    if (index < 0 || index >= frames.length || index === state.index) return;
    state.index = index;
    const chosen = frames[index];
    try {
      history.replaceState(null, "", `#frame=${index}`);
    } catch {
      // a page that stands in another one, as in a notebook, may have no address
    }
    byId("viewer-heading").textContent = `Time ${short(chosen.time)}${chosen.before ? ", just before" : ""}`;
    byId("viewer-title").textContent = `${plural(chosen.moved, "point")} moved, at most by ${edges(chosen.move)}; edges are ${chosen.edges.map((ratio) => ratio.toFixed(2)).join(" to ")} times as long as in the scene`;
    byId("viewer-title").classList.toggle("bad", chosen.distortion > 0);
    byId("frame").value = index;
    byId("frame-label").textContent = `${count(index + 1)} of ${count(frames.length)}`;
    markTime(chosen.time);
    if (!gl) return;
    const loaded = await loadFrame(chosen);
    if (state.index !== index) return; // another one was selected meanwhile
    state.shown?.part.free();
    const colors = new Float32Array(loaded.start.length);
    loaded.meshes.forEach((mesh, vertex) => colors.set(meshColor(mesh), 3 * vertex));
    const attributes = [["start", loaded.start, 3], ["end", loaded.end, 3], ["color", colors, 3], ["amount", loaded.amount, 2]];
    const part = vertexArray(gl, made, attributes, loaded.faces);
    if (loaded.faces.length / 3 < loaded.of) byId("viewer-title").textContent += `; the ${count(loaded.faces.length / 3)} of ${count(loaded.of)} triangles around them are shown`;
    const whole = boxOf([loaded.start]), near = boxOf([loaded.moved]);
    near.radius = Math.max(1.2 * near.radius, 0.12 * whole.radius);
    state.shown = { ...loaded, part, whole, near };
    if (!state.framed) frame({ center: near.center, radius: Math.max(near.radius, 0.4 * whole.radius) });
    state.framed = true;
    ask();
  }

  function draw(now) {
    const { shown } = state;
    if (!shown) return;
    if (state.playing && now - state.last > 1000 / 24) {
      state.last = now;
      show((state.index + 1) % frames.length);
    }
    begin(shown.whole.radius);
    set(made, { time: state.blend, painted: [Number(state.painted === "moves"), Number(state.painted === "stretch")], small: SMALL_MOVE, large: LARGE_MOVE, only: [0, 0, 0, 0] });
    gl.bindVertexArray(shown.part.array);
    gl.drawElements(gl.TRIANGLES, shown.faces.length, gl.UNSIGNED_INT, 0);
    if (state.playing) ask();
  }

  function setBlend(value) {
    state.blend = value;
    byId("blend").value = Math.round(100 * value);
    ask();
  }

  // Shows the frame that is nearest to a time.
  function showTime(time) {
    let best = 0;
    frames.forEach((one, index) => { if (Math.abs(one.time - time) < Math.abs(frames[best].time - time)) best = index; });
    show(best);
  }

  function fillLegend() {
    const legend = byId("viewer-legend");
    legend.replaceChildren();
    [0.25, 0.5, 0.75, 1].forEach((share) => {
      const color = SMALL_MOVE.map((value, axis) => value + share * (LARGE_MOVE[axis] - value));
      const factor = Number((LONGEST ** share).toPrecision(2));
      const text = state.painted === "moves" ? edges(share ** 2 * data.largest) : `edges ${factor} times as long or short`;
      if (state.painted !== "none") addKey(legend, { fill: css(color) }, text);
    });
    data.meshes.slice(0, 6).forEach((mesh, index) => addKey(legend, { fill: css(meshColor(index)) }, mesh.name + (mesh.kept ? ", kept" : "")));
    if (data.meshes.length > 6) add(legend, "span", {}, `and ${count(data.meshes.length - 6)} more`);
  }

  fillLegend();
  byId("painted").value = state.painted;
  byId("frame").max = Math.max(0, frames.length - 1);
  byId("frame").addEventListener("input", (event) => show(Number(event.target.value)));
  byId("blend").addEventListener("input", (event) => setBlend(event.target.value / 100));
  byId("show-before").addEventListener("click", () => setBlend(0));
  byId("show-after").addEventListener("click", () => setBlend(1));
  byId("painted").addEventListener("change", (event) => { state.painted = event.target.value; fillLegend(); ask(); });
  byId("frame-moves").addEventListener("click", () => { if (state.shown) frame(state.shown.near); });
  byId("frame-all").addEventListener("click", () => { if (state.shown) frame({ ...state.shown.whole, radius: 1.15 * state.shown.whole.radius }); });
  byId("previous").addEventListener("click", () => show(state.index - 1));
  byId("next").addEventListener("click", () => show(state.index + 1));
  byId("play").addEventListener("click", () => {
    state.playing = !state.playing;
    byId("play").textContent = state.playing ? "Pause" : "Play";
    ask();
  });
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, select")) return;
    const keys = {
      ArrowLeft: () => show(state.index - 1),
      ArrowRight: () => show(state.index + 1),
      Home: () => show(0),
      End: () => show(frames.length - 1),
      " ": () => byId("play").click(),
      b: () => setBlend(state.blend < 0.5 ? 1 : 0),
      f: () => byId("frame-moves").click(),
      a: () => byId("frame-all").click(),
    };
    const turns = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const action = event.shiftKey ? turns[event.key] && (() => turn(...turns[event.key])) : keys[event.key];
    if (!action || (event.key === " " && event.target.matches("button, summary, input"))) return;
    event.preventDefault();
    action();
  });
  return { show, showTime };
}

async function start() {
  fillHead();
  const headers = [["Time"], ["Frames", 1], ["Points", 1], ["Largest move", 1], ["Edges", 1]];
  addTable(byId("stretches"), headers, data.stretches, "Nothing is moved.");
  viewer = makeViewer(data.moves.length ? fillTimeline() : () => {});
  const asked = Number(new URLSearchParams(location.hash.slice(1)).get("frame") ?? -1);
  const worse = (one, other) => (one.distortion - other.distortion || one.move - other.move) > 0;
  const most = frames.reduce((best, one, index) => (worse(one, frames[best]) ? index : best), 0);
  await viewer.show(Number.isInteger(asked) && asked >= 0 && asked < frames.length ? asked : most);
  document.body.dataset.state = "ready";
}

let viewer = null;
start();
