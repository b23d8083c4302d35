// Shows the worst interval in 3D: triangles that move from start to end, and contacts. WebGL 2, no library.
"use strict";

const MESH_COLORS = [[0.52, 0.68, 0.86], [0.62, 0.78, 0.6], [0.8, 0.7, 0.55], [0.72, 0.62, 0.8], [0.55, 0.76, 0.76], [0.84, 0.66, 0.72]];
const REST_COLOR = [0.62, 0.64, 0.67];
const LIT_COLOR = [0.93, 0.28, 0.22];
const CONTACT_COLORS = [[0.78, 0.08, 0.06], [0.98, 0.6, 0.1]];

const TRIANGLE_SHADER = `#version 300 es
in vec3 start; in vec3 end; in vec3 color;
uniform mat4 view; uniform mat4 projection; uniform float time;
out vec3 place; out vec3 tint;
void main() {
  vec4 at = view * vec4(mix(start, end, time), 1.0);
  place = at.xyz; tint = color;
  gl_Position = projection * at;
}`;
const TRIANGLE_COLOR = `#version 300 es
precision highp float;
in vec3 place; in vec3 tint;
uniform vec4 only;
out vec4 result;
void main() {
  vec3 normal = normalize(cross(dFdx(place), dFdy(place)));
  float light = 0.42 + 0.5 * abs(dot(normal, normalize(vec3(0.25, 0.45, 0.85)))) + 0.08 * abs(normal.y);
  result = vec4(mix(tint, only.rgb, only.a) * light, 1.0);
}`;
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

function decode(text, Type) {
  const bytes = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  return new Type(bytes.buffer);
}

function multiply(a, b) {
  const result = new Float32Array(16);
  for (let column = 0; column < 4; column += 1)
    for (let row = 0; row < 4; row += 1)
      for (let k = 0; k < 4; k += 1) result[4 * column + row] += a[4 * k + row] * b[4 * column + k];
  return result;
}

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

function vertexArray(gl, made, attributes, indices) {
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  for (const [name, values, width] of attributes) {
    const place = gl.getAttribLocation(made, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, width, gl.FLOAT, false, 0, 0);
  }
  if (indices) {
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
  }
  gl.bindVertexArray(null);
  return array;
}

function boxOf(arrays) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (const values of arrays)
    for (let i = 0; i < values.length; i += 1) {
      low[i % 3] = Math.min(low[i % 3], values[i]);
      high[i % 3] = Math.max(high[i % 3], values[i]);
    }
  const center = low.map((value, axis) => (value + high[axis]) / 2);
  return { center, radius: Math.max(1e-9, Math.hypot(...high.map((value, axis) => value - low[axis])) / 2) };
}

function showWorst(shown) {
  const message = byId("viewer-message");
  const fail = (text) => { message.textContent = text; message.hidden = false; };
  if (!shown) {
    byId("viewer").querySelector(".controls").hidden = true;
    return fail("There is nothing to show.");
  }
  const canvas = byId("canvas");
  const gl = canvas.getContext("webgl2", { antialias: true });
  byId("viewer-title").textContent = shown.title;
  if (!gl) return fail("This browser has no WebGL 2, which the view in 3D needs.");

  const start = decode(shown.start, Float32Array), end = decode(shown.end, Float32Array);
  const faces = decode(shown.faces, Uint32Array), lit = decode(shown.lit, Uint32Array);
  const meshes = decode(shown.mesh_of_vertex, Uint32Array);
  const contacts = decode(shown.contacts, Float32Array), toi = decode(shown.toi, Float32Array);
  const kinds = decode(shown.kinds, Uint32Array);
  const colorOf = shown.meshes.map(({ moves }, index) => (moves ? MESH_COLORS[index % MESH_COLORS.length] : REST_COLOR));
  const colors = new Float32Array(start.length);
  meshes.forEach((mesh, vertex) => colors.set(colorOf[mesh], 3 * vertex));
  const pointColors = new Float32Array(contacts.length);
  kinds.forEach((kind, point) => pointColors.set(CONTACT_COLORS[kind], 3 * point));

  const css = (color) => `rgb(${color.map((value) => Math.round(255 * value)).join(" ")})`;
  shown.meshes.slice(0, 8).forEach(({ name }, index) => addKey(byId("viewer-legend"), { fill: css(colorOf[index]) }, name));
  if (shown.meshes.length > 8) add(byId("viewer-legend"), "span", {}, `and ${count(shown.meshes.length - 8)} more`);
  if (lit.length) addKey(byId("viewer-legend"), { fill: css(LIT_COLOR) }, "faces that collide");
  if (!toi.length) {
    byId("viewer-heading").textContent = "First interval";
    byId("frame-contacts").hidden = true;
  }
  ["vertex-face contact", "edge-edge contact"].forEach((text, kind) => {
    if (kinds.includes(kind)) addKey(byId("viewer-legend"), { fill: css(CONTACT_COLORS[kind]), rx: 5 }, text);
  });

  const triangles = program(gl, TRIANGLE_SHADER, TRIANGLE_COLOR), points = program(gl, POINT_SHADER, POINT_COLOR);
  const positions = [["start", start, 3], ["end", end, 3], ["color", colors, 3]];
  const allFaces = vertexArray(gl, triangles, positions, faces), litFaces = vertexArray(gl, triangles, positions, lit);
  const dots = vertexArray(gl, points, [["start", contacts, 3], ["color", pointColors, 3], ["toi", toi, 1]]);

  // Up is the scene's: y in the view.
  const zUp = shown.up_axis === "Z";
  const turn = zUp ? ([x, y, z]) => [x, z, -y] : (point) => point;
  const moving = [];
  for (const values of [start, end])
    moving.push(values.filter((_, i) => shown.meshes[meshes[Math.floor(i / 3)]].moves));
  const whole = boxOf(moving.some((values) => values.length) ? moving : [start]), near = toi.length ? boxOf([contacts]) : { ...whole };
  const all = { center: whole.center, radius: 1.15 * whole.radius };
  near.radius = Math.max(near.radius * 1.6, whole.radius * 0.12);
  const camera = { yaw: 0.65, pitch: 0.42, distance: 1, center: [0, 0, 0] };
  const state = { time: 0, playing: false, last: 0, asked: false };
  const FIELD = 0.62;

  function frame(box) {
    camera.center = turn(box.center);
    camera.distance = ((0.8 * box.radius) / Math.sin(FIELD / 2)) * Math.max(1, canvas.clientHeight / Math.max(1, canvas.clientWidth));
    ask();
  }

  function draw(now) {
    state.asked = false;
    if (state.playing) {
      state.time = (state.time + (now - (state.last || now)) / 2500) % 1;
      showTime();
    }
    state.last = now;
    const scale = Math.min(2, devicePixelRatio || 1);
    const [width, height] = [Math.round(canvas.clientWidth * scale), Math.round(canvas.clientHeight * scale)];
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);

    const { distance, yaw, pitch, center } = camera;
    const [nearest, farthest] = [Math.max(distance - 3 * whole.radius, distance * 0.01), distance + 60 * whole.radius];
    const focal = 1 / Math.tan(FIELD / 2);
    const projection = new Float32Array(16);
    projection.set([focal / (width / height), 0, 0, 0, 0, focal, 0, 0, 0, 0, (nearest + farthest) / (nearest - farthest), -1, 0, 0, (2 * nearest * farthest) / (nearest - farthest), 0]);
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    const orbit = new Float32Array([cy, -sy * sp, sy * cp, 0, 0, cp, sp, 0, -sy, -cy * sp, cy * cp, 0, 0, 0, -distance, 1]);
    const shift = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, -center[0], -center[1], -center[2], 1]);
    const axes = zUp ? new Float32Array([1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]) : null;
    let view = multiply(orbit, shift);
    if (axes) view = multiply(view, axes);

    const set = (made) => {
      gl.useProgram(made);
      gl.uniformMatrix4fv(gl.getUniformLocation(made, "view"), false, view);
      gl.uniformMatrix4fv(gl.getUniformLocation(made, "projection"), false, projection);
      gl.uniform1f(gl.getUniformLocation(made, "time"), state.time);
    };
    set(triangles);
    gl.enable(gl.POLYGON_OFFSET_FILL);
    for (const [array, length, only, offset] of [[litFaces, lit.length, [...LIT_COLOR, 0.85], 0], [allFaces, faces.length, [0, 0, 0, 0], 1]]) {
      gl.polygonOffset(offset, offset);
      gl.uniform4fv(gl.getUniformLocation(triangles, "only"), only);
      gl.bindVertexArray(array);
      gl.drawElements(gl.TRIANGLES, length, gl.UNSIGNED_INT, 0);
    }
    set(points);
    // Many contacts would hide one another, and all else.
    gl.uniform1f(gl.getUniformLocation(points, "size"), Math.max(4, 15 - 2.2 * Math.log10(Math.max(1, toi.length)) ** 1.4) * scale);
    gl.uniform1f(gl.getUniformLocation(points, "core"), toi.length > 300 ? 2 : 0.68);
    gl.bindVertexArray(dots);
    gl.depthMask(false);
    // Contacts behind a surface shine through it faintly.
    for (const [test, fade] of [[gl.GREATER, 0.45], [gl.LEQUAL, 1]]) {
      gl.depthFunc(test);
      gl.uniform1f(gl.getUniformLocation(points, "fade"), fade);
      gl.drawArrays(gl.POINTS, 0, toi.length);
    }
    gl.depthFunc(gl.LESS);
    gl.depthMask(true);
    if (state.playing) ask();
  }

  function ask() {
    if (state.asked) return;
    state.asked = true;
    requestAnimationFrame(draw);
  }

  function showTime() {
    byId("time").value = Math.round(1000 * state.time);
    byId("time-label").textContent = `time ${short(shown.from + state.time * (shown.to - shown.from))}`;
  }

  const held = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, event);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => held.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const last = held.get(event.pointerId);
    if (!last || held.size > 1) return;
    const [dx, dy] = [event.clientX - last.clientX, event.clientY - last.clientY];
    held.set(event.pointerId, event);
    if (event.shiftKey || event.buttons === 2) {
      const step = (2 * camera.distance * Math.tan(FIELD / 2)) / canvas.clientHeight;
      const [cy, sy, cp, sp] = [Math.cos(camera.yaw), Math.sin(camera.yaw), Math.cos(camera.pitch), Math.sin(camera.pitch)];
      const [right, up] = [[cy, 0, -sy], [-sy * sp, cp, -cy * sp]];
      camera.center = camera.center.map((value, axis) => value - step * (dx * right[axis] - dy * up[axis]));
    } else {
      camera.yaw -= dx * 0.008;
      camera.pitch = Math.max(-1.55, Math.min(1.55, camera.pitch + dy * 0.008));
    }
    ask();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.distance *= Math.exp(Math.max(-0.5, Math.min(0.5, event.deltaY * 0.0015)));
    ask();
  }, { passive: false });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("keydown", (event) => {
    const steps = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
    if (!steps) return;
    event.preventDefault();
    camera.yaw -= steps[0];
    camera.pitch = Math.max(-1.55, Math.min(1.55, camera.pitch + steps[1]));
    ask();
  });
  byId("time").addEventListener("input", (event) => { state.time = event.target.value / 1000; showTime(); ask(); });
  byId("play").addEventListener("click", () => {
    state.playing = !state.playing;
    state.last = 0;
    byId("play").textContent = state.playing ? "Pause" : "Play";
    ask();
  });
  byId("frame-all").addEventListener("click", () => frame(all));
  byId("frame-contacts").addEventListener("click", () => frame(near));
  new ResizeObserver(ask).observe(canvas);
  state.time = shown.at;
  showTime();
  frame(toi.length ? { center: near.center, radius: Math.max(near.radius, 0.6 * whole.radius) } : all);
}
