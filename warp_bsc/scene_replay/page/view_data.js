// The data of the view of an interval, and what of it is visible.
"use strict";

const MESH_COLORS = [[0.52, 0.68, 0.86], [0.62, 0.78, 0.6], [0.8, 0.7, 0.55], [0.72, 0.62, 0.8], [0.55, 0.76, 0.76], [0.84, 0.66, 0.72]];
const REST_COLOR = [0.62, 0.64, 0.67];
const LIT_COLOR = [0.93, 0.28, 0.22];
const CONTACT_COLORS = [[0.78, 0.08, 0.06], [0.98, 0.6, 0.1], [0.85, 0.75, 0.1], [0.6, 0.45, 0.2]]; // by kind
const CURVE_COLOR = [0.55, 0.24, 0.92];
const STRAND_SHADE = 0.7; // of curves and points, which no light falls on
const NEAR_COLOR = [0.05, 0.6, 0.35];
const CHOSEN_COLOR = [0.05, 0.75, 0.95];

const NO_FLOATS = new Float32Array(0), NO_INTS = new Int32Array(0);
const meshColor = (mesh) => (data.meshes[mesh].moves ? MESH_COLORS[mesh % MESH_COLORS.length] : REST_COLOR);

// Returns the blocks of an interval as arrays, or null if the page has no view of it. `rest` and `near` are those at its
// start and at its end.
async function loadView(index) {
  const names = [`view-${index}`, `hits-${index}`, ...["rest", "near"].flatMap((name) => [`${name}-${index}`, `${name}-${index + 1}`])];
  const [view, hits, ...atEnds] = await Promise.all(names.map(unpack));
  if (!view) return null;
  const [topology, outline] = await Promise.all([unpack(`faces-${view.faces}`), "outline" in view ? unpack(`outline-${view.outline}`) : null]);
  const [start, end] = addUp(view.start, view.end, view.step);
  const shown = {
    of: view.of, start, end, lit: view.lit, hits: hits || { position: NO_FLOATS, toi: NO_FLOATS, kind: NO_INTS },
    faces: topology.faces, edges: topology.edges || NO_INTS, points: topology.points || NO_INTS, meshes: topology.mesh_of_vertex,
    rest: atEnds.slice(0, 2), near: atEnds.slice(2), outline: null,
  };
  if (outline) {
    const [from, to] = addUp(view.outline_start, view.outline_end, view.outline_step);
    shown.outline = { start: from, end: to, faces: outline.faces, meshes: outline.mesh_of_vertex };
  }
  for (const block of shown.rest) if (block) [block.from, block.to] = addUp(block.curve_start, block.curve_end, block.curve_step);
  return shown;
}

// Returns the elements of some corners each whose mesh is in a state; a vertex that meshes share counts for the first.
function inState(corners, size, meshes, isWanted) {
  const kept = [];
  for (let at = 0; at < corners.length; at += size) {
    let mesh = 0;
    for (let i = 0; i < size; i += 1) mesh = Math.max(mesh, meshes[corners[at + i]]);
    if (isWanted(mesh)) kept.push(at / size);
  }
  return kept;
}

// Returns the numbers of some rows, width by row.
function pick(values, width, rows) {
  const picked = new values.constructor(width * rows.length);
  rows.forEach((row, place) => picked.set(values.subarray(width * row, width * row + width), width * place));
  return picked;
}

// Returns the rows of a block whose two meshes are not hidden, and not marked as meant to meet.
function visibleRows(block) {
  const rows = [];
  if (block?.first) for (let i = 0; i < block.first.length; i += 1) if (!isHidden(block.first[i]) && !isHidden(block.second[i]) && !isMeant(block.first[i], block.second[i])) rows.push(i);
  return rows;
}
