// The tables of a page: all findings, with filters and exports, and the pairs of meshes.
"use strict";

const PHASES = ["passes", "enters", "leaves", "stays"];

// A link that filters the table by a prim.
function addPrim(parent, mesh) {
  const { name } = data.meshes[mesh];
  if (data.nothing) return add(parent, "bdi", { class: "prim" }, name); // there are no rows
  const link = add(parent, "a", { href: addressOf(-1, [name]), title: `Only ${name}`, class: "prim" });
  // The end of a long path stays visible, as it identifies the prim best.
  add(link, "bdi", {}, name);
  return link;
}

// Whether some pairs of meshes intersect at the first time already, and others begin later.
const isMixed = new Set(data.pairs.map((pair) => pair.is_initial)).size > 1;

function fillTable() {
  const side = (title, mesh, isSecond) => ({
    title,
    fill: (cell, row) => {
      addPrim(cell, rows[mesh][row]);
      add(cell, "span", { class: "element" }, elementText(rows, row, isSecond));
    },
    key: (row) => ranks[rows[mesh][row]] * 2 ** 32 + rows[isSecond ? "second_0" : "first_0"][row],
  });
  const ranks = [];
  meshOrder().forEach((mesh, rank) => { ranks[mesh] = rank; });
  const columns = [
    { title: "Time", number: true, class: "narrow", key: (row) => rows.time[row], fill: (cell, row) => { cell.textContent = short(rows.time[row]); } },
    { title: "Kind", class: "kind", key: (row) => rows.kind[row], fill: (cell, row) => {
      const kind = rows.kind[row];
      addKey(cell, { class: kind === PROXIMITY ? "fourth" : kind >= AT_REST ? "third" : kind ? "second" : "first" }, KINDS[kind]);
      if (rows.isNew[row]) add(cell, "span", { class: "new", title: "Not in the baseline" }, "new");
    } },
    side("First", "first", false),
    side("Second", "second", true),
    { title: data.near.length ? "Surfaces, distance" : "Surfaces", class: "wide-only surfaces", key: (row) => (rows.kind[row] === PROXIMITY ? 100 + rows.distance[row] : rows.phase[row] * 2 + rows.separate[row]), fill: (cell, row) => {
      if (rows.kind[row] === PROXIMITY) cell.textContent = `${short(Number(rows.distance[row].toPrecision(6)))} apart`;
      if (rows.phase[row] >= 0) cell.textContent = PHASES[rows.phase[row]] + (rows.separate[row] === 1 ? ", separate before" : "");
    } },
  ];
  table = new LongTable(byId("rows"), columns, isNarrow ? 66 : 44, showRow, { index: isMixed ? -1 : 0, way: 1 });
  KINDS.forEach((text, kind) => { if (rows.kind.includes(kind)) add(byId("kind"), "option", { value: kind }, text); });
}

// Shows the interval of a row, with the row's place in the middle.
function showRow(row) {
  const kind = rows.kind[row];
  showInterval(rows.interval[row], { from: kind === PROXIMITY ? "near" : kind >= AT_REST ? "rest" : "hits", place: rows.place[row], time: rows.toi[row] });
  const name = (isSecond) => `${data.meshes[rows[isSecond ? "second" : "first"][row]].name} ${elementText(rows, row, isSecond)}`;
  byId("selected").hidden = false;
  byId("selected").textContent = `${KINDS[rows.kind[row]]} at time ${short(rows.time[row])}: ${name(false)} and ${name(true)}`;
}

// Saves the rows that the filters leave, in their order, with the columns of the CSV file of a replay.
function saveCsv() {
  const quoted = (value) => (/[",\n\r]/.test(value) ? `"${String(value).replaceAll('"', '""')}"` : value);
  const side = (row, isSecond) => {
    const { name, path } = data.meshes[rows[isSecond ? "second" : "first"][row]];
    const [i, j] = isSecond ? [rows.second_0[row], rows.second_1[row]] : [rows.first_0[row], rows.first_1[row]];
    return [quoted(name), quoted(path ?? name), elementText(rows, row, isSecond), i, j < 0 ? "" : j];
  };
  const texts = ["interval,start,end,kind,first_mesh,first_prim,first_element,first_index,first_index_2,second_mesh,second_prim,second_element,second_index,second_index_2,time,toi,x,y,z,phase,separate,distance\n"];
  for (const row of table.rows) {
    const kind = rows.kind[row], interval = rows.interval[row];
    const place = [0, 1, 2].map((axis) => data.center[axis] + rows.position[3 * row + axis]);
    const toi = kind < AT_REST ? rows.toi[row] : "";
    const phase = rows.phase[row] >= 0 ? PHASES[rows.phase[row]] : "", separate = rows.separate[row] < 0 ? "" : rows.separate[row] === 1;
    const values = [interval, ...data.intervals[interval].slice(0, 2), KINDS[kind], ...side(row, false), ...side(row, true), rows.time[row], toi, ...place, phase, separate, kind === PROXIMITY ? rows.distance[row] : ""];
    texts.push(`${values.join(",")}\n`);
  }
  download("findings.csv", "text/csv", texts);
}

// Copies the paths of all prims in the rows that the filters leave, a line each.
function copyPaths() {
  const meshes = new Set();
  for (const row of table.rows) meshes.add(rows.first[row]).add(rows.second[row]);
  const paths = new Set([...meshes].map((mesh) => data.meshes[mesh].path ?? data.meshes[mesh].name));
  copy([...paths].sort().join("\n"), byId("copy-paths"));
}

function filterRows() {
  byId("chips").replaceChildren();
  state.prims.forEach((name, index) => {
    const others = state.prims.filter((_, other) => other !== index);
    add(byId("chips"), "a", { class: "chip", href: addressOf(state.interval, others), title: "Remove this filter" }, `${name} ×`);
  });
  if (!table) return;
  const words = state.text.toLowerCase().split(/\s+/).filter(Boolean);
  const names = data.meshes.map(({ name }) => name.toLowerCase());
  const selected = state.prims.map((name) => data.meshes.findIndex((mesh) => mesh.name === name));
  const initial = new Set(data.pairs.filter((pair) => pair.is_initial).map(({ meshes }) => pairKey(...meshes.map((name) => meshNumbers.get(name)))));
  const found = [], old = []; // those of pairs that meet at the first time already come last
  let meant = 0;
  for (let row = 0; row < rows.count; row += 1) {
    const [first, second] = [rows.first[row], rows.second[row]];
    if (state.kind !== "" && rows.kind[row] !== Number(state.kind)) continue;
    if (state.onlyNew && !rows.isNew[row]) continue;
    if (state.only && rows.interval[row] !== state.interval) continue;
    if (selected.length && !((selected.length < 2 && second === selected[0]) || (first === selected[0] && (selected.length < 2 || second === selected[1])) || (selected.length > 1 && first === selected[1] && second === selected[0]))) continue;
    if (words.length) {
      const text = `${names[first]} ${elementText(rows, row, false)} ${names[second]} ${elementText(rows, row, true)}`;
      if (!words.every((word) => text.includes(word))) continue;
    }
    if (isMeant(first, second)) meant += 1;
    else (initial.has(pairKey(first, second)) ? old : found).push(row);
  }
  const later = found.length && old.length ? `, those of pairs that begin after the first time first` : "";
  for (const row of old) found.push(row);
  table.show(found);
  byId("save-csv").disabled = byId("copy-paths").disabled = !found.length;
  const all = data.intervals.reduce((sum, _, index) => sum + hitsIn(index), 0) + data.rest.reduce((sum, _, index) => sum + restAt(index), 0) + data.near.reduce((sum, at) => sum + at[1], 0);
  byId("rows-count").textContent = `${count(found.length)} of ${plural(rows.count, "row")}${rows.count < all ? `; ${count(all)} were found, see the notes` : ""}${later}${meant ? `; ${plural(meant, "more is meant", "more are meant")}` : ""}`;
}

function fillPairs() {
  const numbers = meshNumbers, pairs = data.pairs;
  const range = (since, until) => (since === until ? `at ${short(since)}` : `${short(since)} to ${short(until)}`);
  const fillSpans = (cell, texts, more) => add(cell, "span", { class: "clip" }, texts.join("; ") + (more ? `; ${count(more)} more` : ""));
  const columns = [
    { title: "Meshes", key: (row) => pairs[row].meshes.join(" "), fill: (cell, row) => {
      const [first, second] = pairs[row].meshes;
      addPrim(cell, numbers.get(first));
      if (first === second) add(cell, "span", { class: "element" }, "with itself");
      else addPrim(cell, numbers.get(second));
      const tools = add(cell, "span", { class: "tools" });
      if (pairs[row].new.length) add(tools, "span", { class: "new", title: "Not in the baseline" }, "new");
      add(tools, "a", { class: "element", href: addressOf(-1, first === second ? [first] : [first, second]) }, "Rows");
      if (pairs[row].is_initial) add(tools, "span", { class: "element" }, "from the start");
      const both = [numbers.get(first), numbers.get(second)];
      addMeantButton(addMeshButtons(tools, [...new Set(both)]), both);
    } },
    { title: "Depth", number: true, class: "narrow", key: (row) => pairs[row].depth?.[0] ?? -1, fill: (cell, row) => {
      if (!pairs[row].depth) return;
      const [depth, time] = pairs[row].depth;
      add(cell, "span", {}, data.centimetres ? `${short(Number((depth * data.centimetres).toPrecision(3)))} cm` : short(Number(depth.toPrecision(4))));
      add(cell, "span", { class: "muted" }, `at ${short(time)}`);
    } },
    { title: "Collisions", class: "wide-only", key: (row) => pairs[row].hits, fill: (cell, row) => {
      const { spans, more_spans } = pairs[row];
      fillSpans(cell, spans.map(([since, until, hits]) => `${range(since, until)}: ${count(hits)}`), more_spans);
    } },
    { title: "Intersections at rest", class: "wide-only", key: (row) => pairs[row].rest.reduce((most, span) => Math.max(most, span[2]), 0), fill: (cell, row) => {
      const { rest, more_rest } = pairs[row];
      const what = (most, inner) => (inner ? `${inner} inside` : plural(most, "edge"));
      fillSpans(cell, rest.map(([since, until, most, trend, inner]) => `${range(since, until)}: ${what(most, inner)}, ${trend}`), more_rest);
    } },
  ];
  if (data.near.length) columns.push({ title: "Proximities at rest", class: "wide-only", key: (row) => pairs[row].near.reduce((smallest, span) => Math.min(smallest, span[2]), Infinity), fill: (cell, row) => {
    const { near, more_near } = pairs[row];
    fillSpans(cell, near.map(([since, until, distance]) => `${range(since, until)}: ${short(Number(distance.toPrecision(6)))}`), more_near);
  } });
  if (data.has_baseline) columns.splice(2, 0, { title: "New", class: "wide-only", key: (row) => pairs[row].new.length + pairs[row].more_new, fill: (cell, row) => {
    fillSpans(cell, pairs[row].new.map(([what, start, end]) => `${what} ${start === end ? `at ${short(start)}` : `in ${short(start)} to ${short(end)}`}`), pairs[row].more_new);
  } });
  byId("pairs-panel").hidden = !pairs.length || Boolean(data.nothing);
  byId("depth-note").hidden = !pairs.some(({ depth }) => depth);
  pairTable = new LongTable(byId("pairs"), columns, 92, () => {}, { index: -1, way: 1 });
  showPairs();
}

function showPairs() {
  const shown = data.pairs.map((_, row) => row).filter((row) => !isMeant(...data.pairs[row].meshes.map((name) => meshNumbers.get(name))));
  const later = shown.filter((row) => !data.pairs[row].is_initial).length;
  const first = later && later < shown.length ? `${plural(later, "begins", "begin")} after the first time and ${later === 1 ? "comes" : "come"} first; of each kind ` : "";
  byId("pairs-count").textContent = shown.length > 1 ? `${plural(shown.length, "pair")}; ${first}the deepest first` : plural(shown.length, "pair");
  pairTable.show(shown);
}
