// Fills in the page from its data, and connects its parts.
"use strict";

// --- The state: the interval in the view, and the filters of the table. The address contains it after the #. ---

const state = { interval: -1, prims: [], text: "", kind: "", only: false };
const LAST = data.intervals.length - 1;
const edgesAt = (index) => (data.rest[index] ? data.rest[index][1] + data.rest[index][2] : 0);
const insideAt = (index) => (data.rest[index] ? data.rest[index][3] : 0);
const restAt = (index) => edgesAt(index) + insideAt(index);
const nearAt = (index) => (data.near[index] ? data.near[index][1] : 0);
const ofPoints = (interval) => interval[4] || 0; // of points with edges of curves and with points
const hitsIn = (index) => data.intervals[index][2] + data.intervals[index][3] + ofPoints(data.intervals[index]);
const atStart = (index) => restAt(index) + nearAt(index);
const isBusy = (index) => hitsIn(index) + atStart(index) + (index === LAST ? atStart(index + 1) : 0) > 0;
let table = null, rows = null, viewer = null;

function addressOf(interval, prims) {
  const parts = new URLSearchParams();
  if (interval >= 0) parts.set("interval", interval);
  prims.forEach((name) => parts.append("prim", name));
  return `#${parts}`;
}

function readAddress() {
  const parts = new URLSearchParams(location.hash.slice(1));
  state.prims = parts.getAll("prim").slice(0, 2);
  const interval = Number(parts.get("interval") ?? -1);
  if (Number.isInteger(interval) && interval >= 0 && interval <= LAST) showInterval(interval);
  filterRows();
}

function showInterval(index, at = null) {
  if (index < 0 || index > LAST) return;
  const isNew = index !== state.interval;
  state.interval = index;
  history.replaceState(null, "", addressOf(index, state.prims));
  markInterval();
  if (isNew && state.only) filterRows();
  viewer.show(index, at);
}

// Goes to the next interval, in the direction of the step, in which there is something to see.
function stepInterval(step, from = state.interval) {
  for (let index = from + step; index >= 0 && index <= LAST; index += step)
    if (isBusy(index)) return showInterval(index);
  return undefined;
}

function mostInterval() {
  let best = 0;
  const weight = (index) => hitsIn(index) * 1e6 + atStart(index);
  for (let index = 1; index <= LAST; index += 1) if (weight(index) > weight(best)) best = index;
  return best;
}

// --- The timeline ---

let timeline = null, mark = null;

function fillIntervals() {
  if (LAST < 0) return;
  addKey(byId("intervals-legend"), { class: "first" }, "vertex-face");
  addKey(byId("intervals-legend"), { class: "second" }, data.intervals[0].length > 4 ? "edge-edge, vertex-edge, vertex-vertex" : "edge-edge");
  if (data.rest.length) addKey(byId("intervals-legend"), { class: "third" }, "edges in faces and parts inside, at rest");
  if (data.near.length) addKey(byId("intervals-legend"), { class: "fourth" }, "proximities, at rest");
  const width = Math.max(340, Math.min(1100, byId("intervals").clientWidth || 1100));
  const together = Math.ceil(data.intervals.length / (width / 2.5));
  const bars = [], restBars = [], nearBars = [];
  for (let at = 0; at < data.intervals.length; at += together) {
    const some = data.intervals.slice(at, at + together);
    const sum = (column) => some.reduce((total, interval) => total + interval[column], 0);
    const [from, to] = [some[0][0], some[some.length - 1][1]];
    const rest = data.rest.slice(at, at + together);
    const most = (column) => rest.reduce((largest, sample) => Math.max(largest, sample[column]), 0);
    let tip = `time ${short(from)} to ${short(to)}\n${count(sum(2))} vertex-face\n${count(sum(3))} edge-edge`;
    const points = some.reduce((total, interval) => total + ofPoints(interval), 0);
    if (points) tip += `\n${count(points)} of points with curves and points`;
    if (rest.length) tip += `\n${together > 1 ? "at most " : ""}${count(most(1))} edges through faces`;
    if (rest.length && most(2)) tip += `, ${count(most(2))} touch`;
    if (rest.length && most(3)) tip += `\n${plural(most(3), "part")} inside`;
    const near = data.near.slice(at, at + together).reduce((largest, sample) => Math.max(largest, sample[1]), 0);
    if (near) tip += `\n${together > 1 ? "at most " : ""}${plural(near, "proximity", "proximities")}`;
    const click = () => {
      let best = at;
      for (let index = at; index < at + some.length; index += 1)
        if (hitsIn(index) * 1e6 + atStart(index) > hitsIn(best) * 1e6 + atStart(best)) best = index;
      showInterval(best);
    };
    const place = { from, to: to > from ? to : from + 1, tip, click };
    bars.push({ ...place, parts: [sum(2), sum(3) + points] });
    restBars.push({ ...place, parts: [most(1) + most(2) + most(3)] });
    nearBars.push({ ...place, parts: [near] });
  }
  timeline = addBars(byId("intervals"), bars, ["first", "second"], width, "time code", 200, 64);
  if (data.rest.length) addBars(byId("intervals"), restBars, ["third"], width, "", 80, 64);
  if (data.near.length) addBars(byId("intervals"), nearBars, ["fourth"], width, "", 80, 64);
  mark = add(timeline.chart, "rect", { class: "mark", y: 2, height: timeline.bottom - 1, rx: 3 });
}

function markInterval() {
  const [from, to] = data.intervals[state.interval];
  const [left, right] = [timeline.x(from), timeline.x(to > from ? to : from + 1)];
  mark.setAttribute("x", left - 1);
  mark.setAttribute("width", right - left + 2);
}

// --- The tables ---

// A link that filters the table by a prim.
function addPrim(parent, mesh) {
  const { name } = data.meshes[mesh];
  const link = add(parent, "a", { href: addressOf(-1, [name]), title: `Only ${name}`, class: "prim" });
  // The end of a long path stays visible, as it identifies the prim best.
  add(link, "bdi", {}, name);
  return link;
}

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
  data.meshes.map(({ name }, index) => [name, index]).sort(([a], [b]) => (a < b ? -1 : 1)).forEach(([, index], rank) => { ranks[index] = rank; });
  const PHASES = ["passes", "enters", "leaves", "stays"];
  const columns = [
    { title: "Time", number: true, class: "narrow", key: (row) => rows.time[row], fill: (cell, row) => { cell.textContent = short(rows.time[row]); } },
    { title: "Kind", class: "kind", key: (row) => rows.kind[row], fill: (cell, row) => {
      const kind = rows.kind[row];
      addKey(cell, { class: kind === PROXIMITY ? "fourth" : kind >= AT_REST ? "third" : kind ? "second" : "first" }, KINDS[kind]);
    } },
    side("First", "first", false),
    side("Second", "second", true),
    { title: data.near.length ? "Surfaces, distance" : "Surfaces", class: "wide-only narrow", key: (row) => (rows.kind[row] === PROXIMITY ? 100 + rows.distance[row] : rows.phase[row] * 2 + rows.separate[row]), fill: (cell, row) => {
      if (rows.kind[row] === PROXIMITY) cell.textContent = `${short(Number(rows.distance[row].toPrecision(6)))} apart`;
      if (rows.phase[row] >= 0) cell.textContent = PHASES[rows.phase[row]] + (rows.separate[row] === 1 ? ", separate before" : "");
    } },
  ];
  table = new LongTable(byId("rows"), columns, matchMedia("(max-width: 760px)").matches ? 66 : 44, showRow);
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
  const found = [];
  for (let row = 0; row < rows.count; row += 1) {
    const [first, second] = [rows.first[row], rows.second[row]];
    if (state.kind !== "" && rows.kind[row] !== Number(state.kind)) continue;
    if (state.only && rows.interval[row] !== state.interval) continue;
    if (selected.length && !((selected.length < 2 && second === selected[0]) || (first === selected[0] && (selected.length < 2 || second === selected[1])) || (selected.length > 1 && first === selected[1] && second === selected[0]))) continue;
    if (words.length) {
      const text = `${names[first]} ${elementText(rows, row, false)} ${names[second]} ${elementText(rows, row, true)}`;
      if (!words.every((word) => text.includes(word))) continue;
    }
    found.push(row);
  }
  table.show(found);
  const all = data.intervals.reduce((sum, _, index) => sum + hitsIn(index), 0) + data.rest.reduce((sum, _, index) => sum + restAt(index), 0) + data.near.reduce((sum, at) => sum + at[1], 0);
  byId("rows-count").textContent = `${count(found.length)} of ${plural(rows.count, "row")}${rows.count < all ? `; ${count(all)} were found, see the notes` : ""}`;
}

function fillPairs() {
  const numbers = new Map(data.meshes.map(({ name }, index) => [name, index]));
  const pairs = data.pairs;
  const range = (since, until) => (since === until ? `at ${short(since)}` : `${short(since)} to ${short(until)}`);
  const fillSpans = (cell, texts, more) => add(cell, "span", { class: "clip" }, texts.join("; ") + (more ? `; ${count(more)} more` : ""));
  const columns = [
    { title: "Meshes", key: (row) => pairs[row].meshes.join(" "), fill: (cell, row) => {
      const [first, second] = pairs[row].meshes;
      addPrim(cell, numbers.get(first));
      if (first === second) add(cell, "span", { class: "element" }, "with itself");
      else addPrim(cell, numbers.get(second));
      const both = add(cell, "a", { class: "element", href: addressOf(-1, first === second ? [first] : [first, second]) }, "rows of the two");
      both.hidden = first === second;
    } },
    { title: "Collisions", key: (row) => pairs[row].hits, fill: (cell, row) => {
      const { spans, more } = pairs[row];
      fillSpans(cell, spans.map(([since, until, hits]) => `${range(since, until)}: ${count(hits)}`), more);
    } },
    { title: "Intersections at rest", key: (row) => pairs[row].rest.reduce((most, span) => Math.max(most, span[2]), 0), fill: (cell, row) => {
      const { rest, more_rest } = pairs[row];
      const what = (most, inner) => (inner ? `${inner} inside` : plural(most, "edge"));
      fillSpans(cell, rest.map(([since, until, most, trend, inner]) => `${range(since, until)}: ${what(most, inner)}, ${trend}`), more_rest);
    } },
  ];
  if (data.near.length) columns.push({ title: "Proximities at rest", key: (row) => pairs[row].near.reduce((smallest, span) => Math.min(smallest, span[2]), Infinity), fill: (cell, row) => {
    const { near, more_near } = pairs[row];
    fillSpans(cell, near.map(([since, until, distance]) => `${range(since, until)}: ${short(Number(distance.toPrecision(6)))}`), more_near);
  } });
  byId("pairs-count").textContent = pairs.length ? plural(pairs.length, "pair") : "No meshes collide.";
  byId("pairs").hidden = !pairs.length;
  new LongTable(byId("pairs"), columns, 66, () => {}).show(pairs.map((_, index) => index));
}

// --- The small charts ---

function fillImpacts() {
  const bins = data.toi.length;
  const bars = data.toi.map((hits, bin) => ({
    from: bin / bins, to: (bin + 1) / bins, parts: [hits],
    tip: `${short(bin / bins)} to ${short((bin + 1) / bins)}\n${plural(hits, "collision")}`,
  }));
  addBars(byId("impacts"), bars, ["bar"], 520, "share of the interval");
}

function fillText() {
  fillHead();
  if (data.validation) {
    byId("validation-panel").hidden = false;
    const good = data.validation.disagreements.length === 0;
    add(byId("validation"), "p", { class: good ? "good" : "bad" }, data.validation.text);
    const list = add(byId("validation"), "ul");
    data.validation.disagreements.forEach((line) => add(list, "li", {}, line));
  }
}

// --- Mouse and keyboard ---

function listen() {
  let waiting = 0;
  byId("filter").addEventListener("input", (event) => {
    clearTimeout(waiting);
    waiting = setTimeout(() => { state.text = event.target.value; filterRows(); }, 120);
  });
  byId("kind").addEventListener("change", (event) => { state.kind = event.target.value; filterRows(); });
  byId("only-interval").addEventListener("change", (event) => { state.only = event.target.checked; filterRows(); });
  byId("previous").addEventListener("click", () => stepInterval(-1));
  byId("next").addEventListener("click", () => stepInterval(1));
  addEventListener("hashchange", readAddress);
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input:not([type=checkbox]), select")) return;
    const keys = {
      ArrowLeft: () => stepInterval(-1),
      ArrowRight: () => stepInterval(1),
      Home: () => stepInterval(1, -1),
      End: () => stepInterval(-1, LAST + 1),
      " ": () => byId("play").click(),
      f: () => byId("frame-contacts").click(),
      a: () => byId("frame-all").click(),
      "/": () => byId("filter").focus(),
    };
    const turns = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const action = event.shiftKey ? turns[event.key] && (() => viewer.turn(...turns[event.key])) : keys[event.key];
    if (!action || (event.key === " " && event.target.matches("button, summary, input"))) return;
    event.preventDefault();
    action();
  });
}

async function start() {
  fillText();
  fillIntervals();
  fillImpacts();
  fillPairs();
  viewer = makeViewer();
  listen();
  if (LAST >= 0 && !location.hash) showInterval(mostInterval());
  rows = await loadRows();
  fillTable();
  readAddress();
  if (state.interval < 0 && LAST >= 0) showInterval(mostInterval());
  document.body.dataset.state = "ready";
}

start();
