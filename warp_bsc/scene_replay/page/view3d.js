// A view in 3D: a canvas, its camera, and what WebGL 2 needs. No library.
"use strict";

// The normal of a triangle follows from the place of its points.
const TRIANGLE_COLOR = `#version 300 es
precision highp float;
in vec3 place; in vec3 tint;
uniform vec4 only; uniform float transparency;
out vec4 result;
void main() {
  vec3 normal = normalize(cross(dFdx(place), dFdy(place)));
  float light = 0.42 + 0.5 * abs(dot(normal, normalize(vec3(0.25, 0.45, 0.85)))) + 0.08 * abs(normal.y);
  result = vec4(mix(tint, only.rgb, only.a) * light, 1.0 - transparency);
}`;

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

// Attributes: [name, values, width], followed by stride and offset in bytes for values by instance.
function vertexArray(gl, made, attributes, indices) {
  const array = gl.createVertexArray(), buffers = [];
  const fill = (target, values) => {
    const buffer = gl.createBuffer();
    buffers.push(buffer);
    gl.bindBuffer(target, buffer);
    gl.bufferData(target, values, gl.STATIC_DRAW);
  };
  gl.bindVertexArray(array);
  for (const [name, values, width, strided] of attributes) {
    const place = gl.getAttribLocation(made, name);
    fill(gl.ARRAY_BUFFER, values);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, width, gl.FLOAT, false, ...(strided || [0, 0]));
    if (strided) gl.vertexAttribDivisor(place, 1);
  }
  if (indices) fill(gl.ELEMENT_ARRAY_BUFFER, indices);
  gl.bindVertexArray(null);
  return { array, free: () => { gl.deleteVertexArray(array); buffers.forEach((buffer) => gl.deleteBuffer(buffer)); } };
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

const css = (color) => `rgb(${color.map((value) => Math.round(255 * value)).join(" ")})`;

const FIELD = 0.62; // of view, an angle

// Makes a canvas with a camera that mouse and fingers turn, move and zoom. `draw`, given the time, is called when the
// canvas is to be drawn: after `ask`. Without WebGL 2, `gl` is null. `onFree` is called when somebody moves the view away
// from the lens of `lookThrough`.
function makeCanvas(canvas, isZUp, draw, onFree = () => {}) {
  const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true }); // to be printed
  // Up is the scene's: y in the view.
  const turned = isZUp ? ([x, y, z]) => [x, z, -y] : (point) => point;
  const camera = { yaw: 0.65, pitch: 0.42, distance: 1, center: [0, 0, 0] };
  let isAsked = false, view = null, projection = null, lens = null;

  function ask() {
    if (isAsked || !gl) return;
    isAsked = true;
    requestAnimationFrame((now) => { isAsked = false; draw(now); });
  }

  // Shows what a lens sees, or the free view for null. A lens has a position, its directions right, up and backward, the
  // window that it sees, left, right, bottom and top, at a distance of 1, and whether it is a perspective one.
  function lookThrough(value) {
    lens = value;
    ask();
  }

  // Goes on with the free view, from where the lens is.
  function free() {
    if (!lens) return;
    const [backward, position] = [turned(lens.backward), turned(lens.position)];
    camera.yaw = Math.atan2(backward[0], backward[2]);
    camera.pitch = Math.asin(Math.max(-1, Math.min(1, backward[1])));
    camera.center = position.map((value, axis) => value - camera.distance * backward[axis]);
    lens = null;
    onFree();
  }

  function frame(box) {
    free();
    camera.center = turned(box.center);
    camera.distance = ((0.8 * box.radius) / Math.sin(FIELD / 2)) * Math.max(1, canvas.clientHeight / Math.max(1, canvas.clientWidth));
    ask();
  }

  // The part of the canvas that a lens fills: the largest one of its shape.
  function gate(width, height) {
    if (!lens) return [0, 0, width, height];
    const [left, right, bottom, top] = lens.window, shape = (right - left) / (top - bottom);
    const size = [Math.min(width, height * shape), Math.min(height, width / shape)].map((value) => Math.max(1, Math.round(value)));
    return [Math.floor((width - size[0]) / 2), Math.floor((height - size[1]) / 2), ...size];
  }

  // Sets the matrices to those of the lens, for a scene in a sphere around the origin.
  function useLens(reach) {
    const { right, up, backward, position, window: [left, r, bottom, top], isPerspective } = lens;
    const along = position.reduce((sum, value, axis) => sum + value * backward[axis], 0); // of the origin, ahead
    const far = Math.max(along + reach, 1e-3 * reach), near = isPerspective ? Math.max(along - reach, 1e-4 * far) : along - reach;
    const toLens = (direction) => -direction.reduce((sum, value, axis) => sum + value * position[axis], 0);
    view = new Float32Array([0, 1, 2].flatMap((axis) => [right[axis], up[axis], backward[axis], 0]).concat(toLens(right), toLens(up), toLens(backward), 1));
    const [x, y] = [2 / (r - left), 2 / (top - bottom)], [dx, dy] = [(r + left) / (r - left), (top + bottom) / (top - bottom)];
    projection = new Float32Array(isPerspective
      ? [x, 0, 0, 0, 0, y, 0, 0, dx, dy, (near + far) / (near - far), -1, 0, 0, (2 * near * far) / (near - far), 0]
      : [x, 0, 0, 0, 0, y, 0, 0, 0, 0, 2 / (near - far), 0, -dx, -dy, (near + far) / (near - far), 1]);
  }

  // Clears the canvas, and places the camera for a scene of some radius; `reach` is that of a sphere around the origin
  // with all of it, for a lens. Returns pixels by pixel of CSS, and the size of the part that is drawn to.
  function begin(radius, reach = radius) {
    const scale = Math.min(2, devicePixelRatio || 1);
    const [width, height] = [Math.round(canvas.clientWidth * scale), Math.round(canvas.clientHeight * scale)];
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(0, 0, 0, lens ? 0.12 : 0); // beside the gate
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const part = gate(width, height);
    gl.viewport(...part);
    if (lens) {
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(...part);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT);
    }
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);

    if (lens) {
      useLens(reach);
      return { scale, width: part[2], height: part[3] };
    }
    const { distance, yaw, pitch, center } = camera;
    const [nearest, farthest] = [Math.max(distance - 3 * radius, distance * 0.01), distance + 60 * radius];
    const focal = 1 / Math.tan(FIELD / 2);
    projection = new Float32Array(16);
    projection.set([focal / (width / height), 0, 0, 0, 0, focal, 0, 0, 0, 0, (nearest + farthest) / (nearest - farthest), -1, 0, 0, (2 * nearest * farthest) / (nearest - farthest), 0]);
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    const orbit = new Float32Array([cy, -sy * sp, sy * cp, 0, 0, cp, sp, 0, -sy, -cy * sp, cy * cp, 0, 0, 0, -distance, 1]);
    const shift = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, -center[0], -center[1], -center[2], 1]);
    view = multiply(orbit, shift);
    if (isZUp) view = multiply(view, new Float32Array([1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]));
    return { scale, width, height };
  }

  // Sets the camera and other values of a program: numbers, or lists of them.
  function set(made, values) {
    gl.useProgram(made);
    gl.uniformMatrix4fv(gl.getUniformLocation(made, "view"), false, view);
    gl.uniformMatrix4fv(gl.getUniformLocation(made, "projection"), false, projection);
    for (const [name, value] of Object.entries(values)) {
      const place = gl.getUniformLocation(made, name);
      if (Array.isArray(value)) gl[`uniform${value.length}fv`](place, value);
      else gl.uniform1f(place, value);
    }
  }

  function turn(dx, dy) {
    free();
    camera.yaw -= 0.1 * dx;
    camera.pitch = Math.max(-1.55, Math.min(1.55, camera.pitch + 0.1 * dy));
    ask();
  }

  function move(dx, dy) {
    free();
    const step = (2 * camera.distance * Math.tan(FIELD / 2)) / canvas.clientHeight;
    const [cy, sy, cp, sp] = [Math.cos(camera.yaw), Math.sin(camera.yaw), Math.cos(camera.pitch), Math.sin(camera.pitch)];
    const [right, up] = [[cy, 0, -sy], [-sy * sp, cp, -cy * sp]];
    camera.center = camera.center.map((value, axis) => value - step * (dx * right[axis] - dy * up[axis]));
  }

  const held = new Map(); // pointers that are down, by their last events
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, event);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => held.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const last = held.get(event.pointerId);
    if (!last) return;
    const [dx, dy] = [event.clientX - last.clientX, event.clientY - last.clientY];
    held.set(event.pointerId, event);
    if (held.size === 2) {
      const other = [...held.values()].find(({ pointerId }) => pointerId !== event.pointerId);
      const from = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY) || 1;
      camera.distance *= from(last) / from(event);
      move(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons === 2) move(dx, dy);
    else turn(dx * 0.08, dy * 0.08);
    ask();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    free();
    camera.distance *= Math.exp(Math.max(-0.5, Math.min(0.5, event.deltaY * 0.0015)));
    ask();
  }, { passive: false });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  new ResizeObserver(ask).observe(canvas);
  return { gl, camera, turned, ask, frame, begin, set, turn, lookThrough };
}
