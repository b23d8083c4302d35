// The shaders of the view in 3D of an interval.
"use strict";

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
