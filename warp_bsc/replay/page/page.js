// Fills in the page from the data in it. Text goes in as text, never as markup.
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const SVG = "http://www.w3.org/2000/svg";
const byId = (id) => document.getElementById(id);
const count = (number) => number.toLocaleString("en");
const short = (number) => String(Number(number.toPrecision(7)));
const plural = (number, one) => `${count(number)} ${one}${number === 1 ? "" : "s"}`;

function add(parent, name, attributes = {}, text = null) {
  const svg = name === "svg" || parent.namespaceURI === SVG;
  const element = svg ? document.createElementNS(SVG, name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== null) element.textContent = text;
  return parent.appendChild(element);
}

function addKey(parent, style, text) {
  const key = add(parent, "span", { class: "key" });
  const icon = add(key, "svg", { viewBox: "0 0 10 10" });
  add(icon, "rect", { width: 10, height: 10, rx: 2, ...style });
  add(key, "span", {}, text);
}

function addTable(parent, headers, rows, empty) {
  if (!rows.length) return add(parent, "p", { class: "muted small" }, empty);
  const table = add(parent, "table");
  const head = add(add(table, "thead"), "tr");
  headers.forEach(([text, number]) => add(head, "th", number ? { class: "number" } : {}, text));
  const body = add(table, "tbody");
  for (const row of rows) {
    const line = add(body, "tr");
    row.forEach((cell, column) => {
      const box = add(line, "td", headers[column][1] ? { class: "number" } : {});
      const [text, under] = Array.isArray(cell) ? cell : [cell, ""];
      add(box, "span", {}, text);
      if (under) add(box, "span", { class: "muted" }, under);
    });
  }
  return table;
}

// --- Charts ---

const tip = byId("tip");

function addTip(element, text) {
  element.addEventListener("pointermove", (event) => {
    tip.textContent = text;
    tip.hidden = false;
    tip.style.left = `${Math.min(event.clientX + 14, innerWidth - tip.offsetWidth - 8)}px`;
    tip.style.top = `${event.clientY + 16}px`;
  });
  element.addEventListener("pointerleave", () => { tip.hidden = true; });
}

function niceStep(range, parts) {
  const raw = Math.max(range / parts, 1e-12);
  const power = 10 ** Math.floor(Math.log10(raw));
  return power * [1, 2, 5, 10].find((factor) => power * factor >= raw * 0.999);
}

// Bars: {from, to, parts: [numbers, one a class], tip}.
function addBars(parent, bars, classes, width, xLabel) {
  const most = Math.max(1, ...bars.map((bar) => bar.parts.reduce((a, b) => a + b, 0)));
  const height = 230, left = Math.max(46, 8 * count(most).length + 14), bottom = 40, top = 8, right = 20;
  const low = bars[0].from, high = bars[bars.length - 1].to;
  const x = (value) => left + ((value - low) / (high - low || 1)) * (width - left - right);
  const y = (value) => height - bottom - (value / most) * (height - bottom - top);
  const chart = add(parent, "svg", { viewBox: `0 0 ${width} ${height}`, role: "img" });
  const stepY = Math.max(1, niceStep(most, 4));
  for (let value = 0; value <= most; value += stepY) {
    add(chart, "line", { class: "grid", x1: left, x2: width - right, y1: y(value), y2: y(value) });
    add(chart, "text", { x: left - 7, y: y(value) + 4, "text-anchor": "end" }, count(value));
  }
  const stepX = niceStep(high - low, width / 110);
  for (let at = Math.ceil(low / stepX - 1e-9); at * stepX <= high + 1e-9 * stepX; at += 1) {
    const options = { x: x(at * stepX), y: height - bottom + 17, "text-anchor": "middle" };
    add(chart, "text", options, short(at * stepX));
  }
  add(chart, "text", { x: (left + width) / 2, y: height - 5, "text-anchor": "middle" }, xLabel);
  for (const bar of bars) {
    const gap = Math.min(1.5, (x(bar.to) - x(bar.from)) * 0.12);
    const box = { x: x(bar.from) + gap, width: Math.max(0.5, x(bar.to) - x(bar.from) - 2 * gap) };
    let sum = 0;
    bar.parts.forEach((part, index) => {
      if (part) add(chart, "rect", { ...box, class: classes[index], y: y(sum + part), height: y(sum) - y(sum + part) });
      sum += part;
    });
    const hover = { x: x(bar.from), width: x(bar.to) - x(bar.from), y: top, height: height - bottom - top };
    addTip(add(chart, "rect", { ...hover, class: "hover" }), bar.tip);
  }
}

function fillIntervals() {
  addKey(byId("intervals-legend"), { class: "first" }, "vertex-face");
  addKey(byId("intervals-legend"), { class: "second" }, "edge-edge");
  const together = Math.ceil(data.intervals.length / 400);
  const bars = [];
  for (let at = 0; at < data.intervals.length; at += together) {
    const some = data.intervals.slice(at, at + together);
    const sum = (column) => some.reduce((total, interval) => total + interval[column], 0);
    const [from, to] = [some[0][0], some[some.length - 1][1]];
    const text = `time ${short(from)} to ${short(to)}\n${count(sum(2))} vertex-face\n${count(sum(3))} edge-edge`;
    bars.push({ from, to, parts: [sum(2), sum(3)], tip: text });
  }
  if (bars.length) addBars(byId("intervals"), bars, ["first", "second"], 1100, "time code");
}

function fillImpacts() {
  const bins = data.toi.length;
  const bars = data.toi.map((hits, bin) => ({
    from: bin / bins, to: (bin + 1) / bins, parts: [hits],
    tip: `${short(bin / bins)} to ${short((bin + 1) / bins)}\n${plural(hits, "collision")}`,
  }));
  addBars(byId("impacts"), bars, ["bar"], 520, "share of the interval");
}

function fillStages() {
  const total = data.stages.reduce((sum, [, milliseconds]) => sum + milliseconds, 0) || 1;
  const digits = (milliseconds) => (milliseconds < 100 ? milliseconds.toFixed(1) : count(Math.round(milliseconds)));
  const rows = data.stages.map(([name, milliseconds]) => [name, "", `${digits(milliseconds)} ms`]);
  const table = addTable(byId("stages"), [["Stage"], [""], ["All intervals", true]], rows, "Nothing was measured.");
  table.querySelectorAll("tbody tr").forEach((line, index) => {
    const share = Math.max(0.5, (100 * data.stages[index][1]) / total);
    const svg = add(line.children[1], "svg", { viewBox: "0 0 100 10", width: "100%", height: 12, preserveAspectRatio: "none" });
    add(svg, "rect", { class: "bar", width: share, height: 10, rx: 1 });
  });
}

function fillText() {
  byId("title").textContent = data.title;
  byId("subtitle").textContent = data.subtitle;
  byId("partial").textContent = data.partial;
  byId("partial").hidden = !data.partial;
  for (const [value, label] of data.tiles) {
    const tile = add(byId("tiles"), "div", { class: "tile" });
    add(tile, "b", {}, value);
    add(tile, "span", {}, label);
  }
  addTable(byId("pairs"), [["Meshes"], ["Collisions", true]],
    data.pairs.map(({ text, under, hits }) => [[text, under], count(hits)]), "No meshes collide.");
  if (data.more_pairs) add(byId("pairs"), "p", { class: "muted small" }, `and ${plural(data.more_pairs, "more pair")}`);
  addTable(byId("worst"), [["Interval"], ["Collisions", true], ["First at", true], ["Which is"]],
    data.worst.map(({ start, end, hits, time, what }) => [`${short(start)} → ${short(end)}`, count(hits), short(time), what]),
    "No interval has collisions.");
  addTable(byId("facts"), [["What"], ["Value"]], data.facts, "");
  data.notes.forEach((note) => add(byId("notes"), "li", {}, note));
  if (data.validation) {
    byId("validation-panel").hidden = false;
    const good = data.validation.disagreements.length === 0;
    add(byId("validation"), "p", { class: good ? "good" : "bad" }, data.validation.text);
    const list = add(byId("validation"), "ul");
    data.validation.disagreements.forEach((line) => add(list, "li", {}, line));
  }
}

fillText();
fillIntervals();
fillImpacts();
fillStages();
showWorst(data.view);
