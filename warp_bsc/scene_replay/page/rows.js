// The rows of the table, from the blocks of all intervals.
"use strict";

const KINDS = ["vertex-face", "edge-edge", "vertex-edge", "vertex-vertex", "edge through face", "edge touches face", "inside", "proximity"];
const AT_REST = 4, INSIDE = 6, PROXIMITY = 7; // AT_REST is the first kind that is not of collisions
const ELEMENTS = ["vertex", "face", "edge", "diagonal"];

// Returns all rows of the table as columns, in order of time: those at the start of an interval, then its collisions.
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
    position: new Float32Array(3 * total), // from the page's center
    phase: new Int8Array(total).fill(-1),
    separate: new Int8Array(total).fill(-1),
    isNew: new Uint8Array(total), // against the baseline
  };
  const numbers = ["first", "second", "first_0", "first_1", "second_0", "second_1"];
  for (const key of numbers) rows[key] = new Int32Array(total);
  const names = data.rows.flatMap((counts, index) => [["rest", 1], ["near", 2], ["hits", 0]].filter(([, which]) => counts[which]).map(([name]) => ({ name, index })));
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
      rows.position.set(block.position, 3 * at);
      if (block.distance) rows.distance.set(block.distance, at);
      if (block.new) rows.isNew.set(block.new, at);
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
