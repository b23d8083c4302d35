// The data of the page: JSON for the whole replay, and blocks of arrays, which are unpacked when they are shown.
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const KINDS = ["vertex-face", "edge-edge", "vertex-edge", "vertex-vertex", "edge through face", "edge touches face", "inside", "proximity"];
const AT_REST = 4, INSIDE = 6, PROXIMITY = 7; // AT_REST is the first kind that is not of collisions
const ELEMENTS = ["vertex", "face", "edge", "diagonal"];

// Returns the facts and the arrays of a block, or null if the page has no such block.
async function unpack(name) {
  const block = document.getElementById(name);
  if (!block) return null;
  const text = atob(block.textContent);
  const packed = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i += 1) packed[i] = text.charCodeAt(i);
  let bytes = packed;
  if (block.dataset.packed) {
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  }
  let at = 4 + new DataView(bytes.buffer).getUint32(0, true);
  const facts = JSON.parse(new TextDecoder().decode(bytes.subarray(4, at)));
  const result = { ...facts };
  for (const [key, kind, length] of facts.arrays) {
    // The first bytes of all numbers come before the second ones.
    const joined = new Uint8Array(4 * length);
    for (let byte = 0; byte < 4; byte += 1)
      for (let i = 0; i < length; i += 1) joined[4 * i + byte] = bytes[at + byte * length + i];
    at += 4 * length;
    result[key] = kind === "f" ? new Float32Array(joined.buffer) : new Int32Array(joined.buffer);
  }
  return result;
}

// Returns all rows of the table as columns: collisions by interval, intersections and proximities by time.
async function loadRows() {
  const total = data.rows.reduce((sum, counts) => sum + counts[0] + counts[1] + counts[2], 0);
  const rows = {
    count: total,
    interval: new Int32Array(total), // for rows at a time: the interval that starts then, or the last interval at its end
    place: new Int32Array(total), // in its block
    kind: new Uint8Array(total),
    elements: new Uint8Array(total),
    time: new Float64Array(total),
    toi: new Float32Array(total), // 0 or 1 for rows at a time
    distance: new Float32Array(total), // of proximities
    phase: new Int8Array(total).fill(-1),
    separate: new Int8Array(total).fill(-1),
  };
  const numbers = ["first", "second", "first_0", "first_1", "second_0", "second_1"];
  for (const key of numbers) rows[key] = new Int32Array(total);
  const names = data.rows.flatMap((counts, index) => ["hits", "rest", "near"].filter((_, which) => counts[which]).map((name) => ({ name, index })));
  let at = 0;
  const together = 64; // blocks that are unpacked at the same time
  for (let first = 0; first < names.length; first += together) {
    const some = names.slice(first, first + together);
    const blocks = await Promise.all(some.map(({ name, index }) => unpack(`${name}-${index}`)));
    for (const [which, block] of blocks.entries()) {
      const { name, index } = some[which], isRest = name !== "hits";
      const interval = Math.min(index, data.intervals.length - 1);
      const [start, end] = data.intervals[interval];
      const length = block.first.length;
      rows.interval.fill(interval, at, at + length);
      for (const key of numbers) rows[key].set(block[key], at);
      rows.elements.set(block.elements, at);
      rows.kind.set(block.kind, at);
      for (let i = 0; i < length; i += 1) {
        rows.place[at + i] = i;
        rows.toi[at + i] = isRest ? index - interval : block.toi[i];
        rows.time[at + i] = start + rows.toi[at + i] * (end - start);
      }
      if (block.distance) rows.distance.set(block.distance, at);
      if (block.phase) rows.phase.set(block.phase, at);
      if (block.separate) rows.separate.set(block.separate, at);
      at += length;
    }
  }
  return rows;
}

// Returns an element of a row, such as "vertex 12" or "edge 4-5".
function elementText(rows, row, isSecond) {
  const kind = isSecond ? rows.elements[row] % 4 : rows.elements[row] >> 2;
  const [i, j] = isSecond ? [rows.second_0[row], rows.second_1[row]] : [rows.first_0[row], rows.first_1[row]];
  return j < 0 ? `${ELEMENTS[kind]} ${i}` : `${ELEMENTS[kind]} ${i}-${j}`;
}
