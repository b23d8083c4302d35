// The data of a page: JSON for the whole of it, and blocks of arrays, which are unpacked when they are shown.
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);

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

// Returns points at the start and the end of an interval, [x, y, z, x, ...], from columns of differences.
function addUp(starts, ends, step) {
  const length = starts.length / 3, start = new Float32Array(3 * length), end = new Float32Array(3 * length);
  const signed = (value) => (value & 1 ? -(value + 1) / 2 : value / 2);
  for (let axis = 0; axis < 3; axis += 1) {
    let at = 0;
    for (let i = 0; i < length; i += 1) {
      at += signed(starts[axis * length + i]);
      start[3 * i + axis] = step * at;
      end[3 * i + axis] = step * (at + signed(ends[axis * length + i]));
    }
  }
  return [start, end];
}
