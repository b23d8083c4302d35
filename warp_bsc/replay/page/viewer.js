// Shows an interval in 3D: triangles that move from start to end, contacts, cut curves.
"use strict";

const MESH_COLORS = [[0.52, 0.68, 0.86], [0.62, 0.78, 0.6], [0.8, 0.7, 0.55], [0.72, 0.62, 0.8], [0.55, 0.76, 0.76], [0.84, 0.66, 0.72]];
const REST_COLOR = [0.62, 0.64, 0.67];
const LIT_COLOR = [0.93, 0.28, 0.22];
const CONTACT_COLORS = [[0.78, 0.08, 0.06], [0.98, 0.6, 0.1], [0.85, 0.75, 0.1], [0.6, 0.45, 0.2]]; // by kind
const CURVE_COLOR = [0.55, 0.24, 0.92];
const STRAND_SHADE = 0.7; // of curves and points, which no light falls on
const NEAR_COLOR = [0.05, 0.6, 0.35];
const CHOSEN_COLOR = [0.05, 0.75, 0.95];

const TRIANGLE_SHADER = `#version 300 es
in vec3 start; in vec3 end; in vec3 color;
uniform mat4 view; uniform mat4 projection; uniform float time;
out vec3 place; out vec3 tint;
void main() {
  vec4 at = view * vec4(mix(start, end, time), 1.0);
  place = at.xyz; tint = color;
  gl_Position = projection * at;
}`;
// Points of the scene.
const STRAND_SHADER = `#version 300 es
in vec3 start; in vec3 end; in vec3 color;
uniform mat4 view; uniform mat4 projection; uniform float time; uniform float size;
out vec3 tint;
void main() {
  tint = color;
  gl_Position = projection * view * vec4(mix(start, end, time), 1.0);
  gl_PointSize = size;
}`;
const STRAND_COLOR = `#version 300 es
precision highp float;
in vec3 tint;
out vec4 result;
void main() { result = vec4(tint, 1.0); }`;
const POINT_SHADER = `#version 300 es
in vec3 start; in vec3 color; in float toi;
uniform mat4 view; uniform mat4 projection; uniform float time; uniform float size; uniform float fade;
out vec4 tint;
void main() {
  gl_Position = projection * view * vec4(start, 1.0);
  gl_Position.z -= 1e-4 * gl_Position.w;
  gl_PointSize = size;
  tint = vec4(color, (toi <= time ? 1.0 : 0.3) * fade);
}`;
const POINT_COLOR = `#version 300 es
precision highp float;
in vec4 tint;
uniform float core;
out vec4 result;
void main() {
  float from = length(gl_PointCoord - 0.5) * 2.0;
  float edge = fwidth(from);
  float disc = 1.0 - smoothstep(1.0 - edge, 1.0, from);
  float inner = 1.0 - smoothstep(core - edge, core, from);
  result = vec4(mix(vec3(1.0), tint.rgb, inner), tint.a * disc);
}`;

// A segment is drawn as a rectangle of some pixels' width: two triangles, of four corners.
const CURVE_SHADER = `#version 300 es
in vec3 start; in vec3 end; in vec3 start_1; in vec3 end_1; // its ends at the start of the interval, and at the end
in vec3 color;
uniform mat4 view; uniform mat4 projection; uniform vec2 pixel; uniform float time;
out vec3 tint;
void main() {
  tint = color;
  vec4 a = projection * view * vec4(mix(start, start_1, time), 1.0), b = projection * view * vec4(mix(end, end_1, time), 1.0);
  vec2 along = normalize((b.xy / b.w - a.xy / a.w) / pixel + vec2(1e-6, 0.0));
  int corner = int[](0, 1, 2, 2, 1, 3)[gl_VertexID]; // two at a, two at b
  gl_Position = corner < 2 ? a : b;
  float side = corner % 2 == 0 ? 1.0 : -1.0;
  gl_Position.xy += side * vec2(-along.y, along.x) * pixel * gl_Position.w;
  gl_Position.z -= 1e-4 * gl_Position.w;
}`;
const CURVE_COLOR_SHADER = `#version 300 es
precision highp float;
in vec3 tint;
uniform float fade;
out vec4 result;
void main() { result = vec4(tint, fade); }`;

const NO_FLOATS = new Float32Array(0), NO_INTS = new Int32Array(0);
const meshColor = (mesh) => (data.meshes[mesh].moves ? MESH_COLORS[mesh % MESH_COLORS.length] : REST_COLOR);
const strandColor = (mesh) => meshColor(mesh).map((value) => STRAND_SHADE * value);

// Returns the blocks of an interval as the arrays that are drawn.
async function loadView(index) {
  const names = [`view-${index}`, `hits-${index}`, ...["rest", "near"].flatMap((name) => [`${name}-${index}`, `${name}-${index + 1}`])];
  const [view, hits, ...atEnds] = await Promise.all(names.map(unpack));
  if (!view) return null;
  const topology = await unpack(`faces-${view.faces}`);
  const faces = topology.faces, lit = new Int32Array(3 * view.lit.length);
  view.lit.forEach((face, place) => lit.set(faces.subarray(3 * face, 3 * face + 3), 3 * place));
  const contacts = hits ? hits.position : NO_FLOATS;
  return {
    edges: topology.edges || NO_INTS, alone: topology.points || NO_INTS,
    faces, lit, meshes: topology.mesh_of_vertex, start: view.start, end: view.end, of: view.of,
    contacts, toi: hits ? hits.toi : NO_FLOATS, kinds: hits ? hits.kind : NO_INTS,
    // at the start and at the end of the interval
    rest: atEnds.slice(0, 2).map((block) => (block ? block.position : NO_FLOATS)),
    curves: atEnds.slice(0, 2).map((block) => (block ? block.curves : NO_FLOATS)),
    inside: atEnds.slice(0, 2).map((block) => (block ? block.position.filter((_, i) => block.kind[Math.floor(i / 3)] === INSIDE) : NO_FLOATS)),
    through: atEnds.slice(0, 2).map((block) => (block ? block.through : NO_FLOATS)),
    close: atEnds.slice(2).map((block) => (block ? block.position : NO_FLOATS)),
  };
}

// Makes the view and its controls. Returns functions that show an interval and turn the view.
function makeViewer() {
  const message = byId("viewer-message");
  const say = (text) => { message.textContent = text; message.hidden = !text; };
  const canvas = byId("canvas");
  const { gl, camera, turned, ask, frame, begin, set, turn } = makeCanvas(canvas, data.up_axis === "Z", draw);
  if (!gl) say("This browser has no WebGL 2, which the view in 3D needs.");
  if (LAST < 0) say("There is nothing to show.");

  const triangles = gl && program(gl, TRIANGLE_SHADER, TRIANGLE_COLOR);
  const points = gl && program(gl, POINT_SHADER, POINT_COLOR);
  const strands = gl && program(gl, STRAND_SHADER, STRAND_COLOR);
  const lines = gl && program(gl, CURVE_SHADER, CURVE_COLOR_SHADER);
  const state = { time: 0, playing: false, last: 0, index: -1, shown: null, parts: [], chosen: null, framed: false };

  // Shows an interval. `at`, if given, is a row of the table: {from, place, time}, from "hits", "rest" or "near".
  async function show(index, at = null) {
    const isNew = index !== state.index;
    state.index = index;
    const [from, to] = data.intervals[index];
    byId("viewer-heading").textContent = from === to ? `Time ${short(from)}` : `Time ${short(from)} to ${short(to)}`;
    canvas.setAttribute("aria-label", `${byId("viewer-heading").textContent} in 3D. Drag to turn, scroll to zoom.`);
    byId("selected").hidden = true;
    if (!gl) return;
    if (isNew) {
      const shown = await loadView(index);
      if (state.index !== index) return; // another one was selected meanwhile
      fill(shown, index);
    }
    if (!state.shown) return;
    if (at) choose(at);
    else if (isNew) state.time = state.shown.median;
    showTime();
    ask();
  }

  function fill(shown, index) {
    state.parts.forEach((part) => part.free());
    [state.parts, state.shown, state.chosen] = [[], shown, null];
    const legend = byId("viewer-legend");
    legend.replaceChildren();
    let title = plural(hitsIn(index), "collision");
    const atEnds = (numberAt, one, how) => { title += `; ${plural(numberAt(index), one)} ${how} at the start, ${count(numberAt(index + 1))} at the end`; };
    if (data.rest.length) atEnds(edgesAt, "edge", "in faces");
    if (insideAt(index) + insideAt(index + 1)) atEnds(insideAt, "part", "inside");
    if (data.near.length) atEnds(nearAt, "pair", "within the clearance");
    const isEmpty = !shown;
    byId("viewer-title").textContent = title;
    byId("viewer").querySelector(".controls").classList.toggle("idle", isEmpty);
    if (isEmpty) {
      say(hitsIn(index) + atStart(index) + atStart(index + 1) ? "The page is full and has no view of this interval; see the notes." : "Nothing collides or intersects here, so the page has no view of this interval.");
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      return;
    }
    say("");
    const { faces, lit, meshes, start, end, contacts, kinds, toi } = shown;
    if (faces.length / 3 < shown.of) title += `; the ${count(faces.length / 3)} of ${count(shown.of)} triangles around them are shown`;
    byId("viewer-title").textContent = title;

    const colors = new Float32Array(start.length), pointColors = new Float32Array(contacts.length);
    meshes.forEach((mesh, vertex) => colors.set(meshColor(mesh), 3 * vertex));
    kinds.forEach((kind, point) => pointColors.set(CONTACT_COLORS[kind], 3 * point));
    const present = [...new Set(meshes)];
    present.slice(0, 6).forEach((mesh) => addKey(legend, { fill: css(meshColor(mesh)) }, data.meshes[mesh].name));
    if (present.length > 6) add(legend, "span", {}, `and ${count(present.length - 6)} more`);
    if (lit.length) addKey(legend, { fill: css(LIT_COLOR) }, "faces that collide");
    CONTACT_COLORS.forEach((color, kind) => {
      if (kinds.includes(kind)) addKey(legend, { fill: css(color), rx: 5 }, `${KINDS[kind]} contact`);
    });
    if (shown.curves.some((curves) => curves.length)) addKey(legend, { fill: css(CURVE_COLOR), y: 3, height: 4 }, "curves where surfaces cut");

    const positions = [["start", start, 3], ["end", end, 3], ["color", colors, 3]];
    shown.all = vertexArray(gl, triangles, positions, faces);
    shown.some = vertexArray(gl, triangles, positions, lit);
    shown.dots = vertexArray(gl, points, [["start", contacts, 3], ["color", pointColors, 3], ["toi", toi, 1]]);
    if (shown.inside.some((places) => places.length)) addKey(legend, { fill: css(CURVE_COLOR), rx: 5 }, "part of a mesh inside another");
    if (shown.through.some((places) => places.length)) addKey(legend, { fill: css(CURVE_COLOR), rx: 5 }, "curve through a face");
    if (shown.close.some((places) => places.length)) addKey(legend, { fill: css(NEAR_COLOR), rx: 5 }, "proximity");
    // Markers of intersections and proximities at the start, and at the end.
    shown.marks = shown.inside.map((inside, end) => {
      const at = [...inside, ...shown.through[end]], places = new Float32Array([...at, ...shown.close[end]]);
      const markColors = new Float32Array(places.length);
      for (let i = 0; i < places.length; i += 3) markColors.set(i < at.length ? CURVE_COLOR : NEAR_COLOR, i);
      return { count: places.length / 3, ...vertexArray(gl, points, [["start", places, 3], ["color", markColors, 3], ["toi", new Float32Array(places.length / 3), 1]]) };
    });
    const segments = (values, stride, places, more = []) => vertexArray(gl, lines, [...["start", "end", "start_1", "end_1"].map((name, i) => [name, values, 3, [stride, places[i]]]), ...more]);
    shown.cuts = shown.curves.map((curves) => segments(curves, 24, [0, 12, 0, 12]));
    const ropes = new Float32Array(6 * shown.edges.length), ropeColors = new Float32Array(1.5 * shown.edges.length);
    for (let i = 0; i < shown.edges.length; i += 2) ropeColors.set(strandColor(meshes[shown.edges[i]]), 1.5 * i);
    shown.edges.forEach((vertex, i) => [start, end].forEach((values, when) => ropes.set(values.subarray(3 * vertex, 3 * vertex + 3), 12 * (i >> 1) + 6 * when + 3 * (i % 2))));
    shown.ropes = segments(ropes, 48, [0, 12, 24, 36], [["color", ropeColors, 3, [12, 0]]]);
    shown.dust = vertexArray(gl, strands, [...positions.slice(0, 2), ["color", colors.map((value) => STRAND_SHADE * value), 3]], shown.alone);
    state.parts = [shown.all, shown.some, shown.dots, ...shown.cuts, ...shown.marks, shown.ropes, shown.dust];

    const moving = [start, end].map((values) => values.filter((_, i) => data.meshes[meshes[Math.floor(i / 3)]].moves));
    shown.whole = boxOf(moving.some((values) => values.length) ? moving : [start]);
    const places = [contacts, ...shown.rest, ...shown.close].filter((values) => values.length);
    shown.near = places.length ? boxOf(places) : { ...shown.whole };
    shown.near.radius = Math.max(shown.near.radius * 1.2, shown.whole.radius * 0.12);
    shown.median = toi.length ? Array.from(toi).sort((a, b) => a - b)[toi.length >> 1] : 0;
    byId("frame-contacts").hidden = !places.length;
    if (!state.framed) {
      const { near, whole } = shown;
      frame(places.length ? { center: near.center, radius: Math.max(near.radius, 0.6 * whole.radius) } : { center: whole.center, radius: 1.15 * whole.radius });
      state.framed = true;
    }
  }

  // Marks the position of a row, and moves the view to it.
  function choose({ from, place, time }) {
    const { contacts, rest, close } = state.shown;
    const places = from === "hits" ? contacts : (from === "rest" ? rest : close)[Math.round(time)];
    const point = places.slice(3 * place, 3 * place + 3);
    state.time = time;
    if (point.length < 3) return;
    state.chosen?.free();
    state.parts = state.parts.filter((part) => part !== state.chosen);
    state.chosen = vertexArray(gl, points, [["start", point, 3], ["color", new Float32Array(CHOSEN_COLOR), 3], ["toi", new Float32Array([0]), 1]]);
    state.parts.push(state.chosen);
    camera.center = turned([...point]);
    camera.distance = Math.min(camera.distance, 0.5 * state.shown.whole.radius);
  }

  function draw(now) {
    const { shown } = state;
    if (!shown) return;
    if (state.playing) {
      state.time = (state.time + (now - (state.last || now)) / 2500) % 1;
      showTime();
    }
    state.last = now;
    const { scale, width, height } = begin(shown.whole.radius);
    gl.enable(gl.POLYGON_OFFSET_FILL);
    for (const [part, length, only, offset] of [[shown.some, shown.lit.length, [...LIT_COLOR, 0.85], 0], [shown.all, shown.faces.length, [0, 0, 0, 0], 1]]) {
      gl.polygonOffset(offset, offset);
      set(triangles, { time: state.time, only });
      gl.bindVertexArray(part.array);
      gl.drawElements(gl.TRIANGLES, length, gl.UNSIGNED_INT, 0);
    }
    gl.disable(gl.POLYGON_OFFSET_FILL);
    const pixel = [(2 * scale) / width, (2 * scale) / height];
    set(lines, { pixel, time: state.time, fade: 1 });
    gl.bindVertexArray(shown.ropes.array);
    gl.drawArraysInstanced(gl.TRIANGLES, 0, 6, shown.edges.length / 2);
    set(strands, { time: state.time, size: 5 * scale });
    gl.bindVertexArray(shown.dust.array);
    gl.drawElements(gl.POINTS, shown.alone.length, gl.UNSIGNED_INT, 0);
    gl.depthMask(false);
    // Contacts behind a surface are drawn faintly over it. Cut curves belong to one end of the interval.
    const end = state.time < 0.5 ? 0 : 1;
    // Large markers of many contacts would hide one another and the surfaces.
    const marks = shown.marks[end], dots = shown.toi.length + marks.count;
    const size = Math.max(4, 15 - 2.2 * Math.log10(Math.max(1, dots)) ** 1.4) * scale;
    for (const [test, fade] of [[gl.GREATER, 0.45], [gl.LEQUAL, 1]]) {
      gl.depthFunc(test);
      set(lines, { pixel, time: 0, fade });
      gl.vertexAttrib3fv(gl.getAttribLocation(lines, "color"), CURVE_COLOR); // cut curves have one colour
      gl.bindVertexArray(shown.cuts[end].array);
      gl.drawArraysInstanced(gl.TRIANGLES, 0, 6, shown.curves[end].length / 6);
      set(points, { time: state.time, fade, size, core: dots > 300 ? 2 : 0.68 });
      gl.bindVertexArray(marks.array);
      gl.drawArrays(gl.POINTS, 0, marks.count);
      gl.bindVertexArray(shown.dots.array);
      gl.drawArrays(gl.POINTS, 0, shown.toi.length);
    }
    if (state.chosen) {
      gl.depthFunc(gl.ALWAYS);
      set(points, { time: state.time, fade: 1, size: 16 * scale, core: 0.6 });
      gl.bindVertexArray(state.chosen.array);
      gl.drawArrays(gl.POINTS, 0, 1);
    }
    gl.depthFunc(gl.LESS);
    gl.depthMask(true);
    if (state.playing) ask();
  }

  function showTime() {
    const [from, to] = data.intervals[state.index];
    byId("time").value = Math.round(1000 * state.time);
    byId("time-label").textContent = `time ${short(from + state.time * (to - from))}`;
  }

  byId("time").addEventListener("input", (event) => { state.time = event.target.value / 1000; showTime(); ask(); });
  byId("play").addEventListener("click", () => {
    state.playing = !state.playing;
    state.last = 0;
    byId("play").textContent = state.playing ? "Pause" : "Play";
    ask();
  });
  byId("frame-all").addEventListener("click", () => { if (state.shown) frame({ center: state.shown.whole.center, radius: 1.15 * state.shown.whole.radius }); });
  byId("frame-contacts").addEventListener("click", () => { if (state.shown) frame(state.shown.near); });
  return { show, turn };
}
