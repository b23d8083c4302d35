// Makes the elements of a page: keys, tables, bar charts. Text is inserted as text, never as markup.
"use strict";

const SVG = "http://www.w3.org/2000/svg";
const byId = (id) => document.getElementById(id);
const count = (number) => number.toLocaleString("en");
const short = (number) => String(Number(number.toPrecision(Math.abs(number) < 1e4 ? 6 : 9)));
const plural = (number, one, many = `${one}s`) => `${count(number)} ${number === 1 ? one : many}`;

function add(parent, name, attributes = {}, text = null) {
  const svg = name === "svg" || parent.namespaceURI === SVG;
  const element = svg ? document.createElementNS(SVG, name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== null) element.textContent = text;
  return parent.appendChild(element);
}

function addSwatch(parent, style) {
  const icon = add(parent, "svg", { viewBox: "0 0 10 10", class: "swatch" });
  add(icon, "rect", { width: 10, height: 10, rx: 2, ...style });
}

function addKey(parent, style, text) {
  const key = add(parent, "span", { class: "key" });
  addSwatch(key, style);
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

// Fills in title, numbers, facts and notes.
function fillHead() {
  byId("title").textContent = data.title;
  byId("subtitle").textContent = data.subtitle;
  byId("partial").textContent = data.partial;
  byId("partial").hidden = !data.partial;
  for (const [value, label] of data.tiles) {
    const tile = add(byId("tiles"), "div", { class: "tile" });
    add(tile, "b", {}, value);
    add(tile, "span", {}, label);
  }
  addTable(byId("facts"), [["What"], ["Value"]], data.facts, "");
  data.notes.forEach((note) => add(byId("notes"), "li", {}, note));
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

// Opens a download of a file, given its text in parts.
function download(name, type, parts) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob(parts, { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

// Copies a text, and says so on the button for a moment.
async function copy(text, button) {
  let isCopied = true;
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    // Not permitted, for example in a frame: the older way needs a selection.
    const area = add(document.body, "textarea", { class: "copied" });
    area.value = text;
    area.select();
    isCopied = document.execCommand("copy");
    area.remove();
  }
  const label = button.dataset.label ?? (button.dataset.label = button.textContent);
  button.textContent = isCopied ? "Copied" : "Not permitted";
  setTimeout(() => { button.textContent = label; }, 1500);
}

function niceStep(range, parts) {
  const raw = Math.max(range / parts, 1e-12);
  const power = 10 ** Math.floor(Math.log10(raw));
  return power * [1, 2, 5, 10].find((factor) => power * factor >= raw * 0.999);
}

const labelWidth = (most) => 8 * count(most).length + 14; // of the labels of an axis

// Bars: {from, to, parts: [numbers, one a class], tip}.
function addBars(parent, bars, classes, width, xLabel, height = 230, least = 46) {
  const most = Math.max(1, ...bars.map((bar) => bar.parts.reduce((a, b) => a + b, 0)));
  const left = Math.max(least, labelWidth(most)), bottom = xLabel ? 40 : 6, top = 8, right = 20;
  const low = bars[0].from, high = bars[bars.length - 1].to;
  const x = (value) => left + ((value - low) / (high - low || 1)) * (width - left - right);
  const y = (value) => height - bottom - (value / most) * (height - bottom - top);
  const chart = add(parent, "svg", { viewBox: `0 0 ${width} ${height}`, role: "img" });
  const stepY = Math.max(1, niceStep(most, 4));
  for (let value = 0; value <= most; value += stepY) {
    add(chart, "line", { class: "grid", x1: left, x2: width - right, y1: y(value), y2: y(value) });
    add(chart, "text", { x: left - 7, y: y(value) + 4, "text-anchor": "end" }, count(value));
  }
  const stepX = xLabel ? niceStep(high - low, width / 80) : Infinity;
  for (let at = Math.ceil(low / stepX - 1e-9); at * stepX <= high + 1e-9 * stepX; at += 1) {
    const options = { x: x(at * stepX), y: height - bottom + 17, "text-anchor": "middle" };
    add(chart, "text", options, short(at * stepX));
  }
  if (xLabel) add(chart, "text", { x: (left + width) / 2, y: height - 5, "text-anchor": "middle" }, xLabel);
  for (const bar of bars) {
    const gap = Math.min(1.5, (x(bar.to) - x(bar.from)) * 0.12);
    const box = { x: x(bar.from) + gap, width: Math.max(0.5, x(bar.to) - x(bar.from) - 2 * gap) };
    let sum = 0;
    bar.parts.forEach((part, index) => {
      if (part) add(chart, "rect", { ...box, class: classes[index], y: y(sum + part), height: y(sum) - y(sum + part) });
      sum += part;
    });
    const hover = { x: x(bar.from), width: x(bar.to) - x(bar.from), y: top, height: height - bottom - top };
    const area = add(chart, "rect", { ...hover, class: "hover" });
    addTip(area, bar.tip);
    if (bar.click) area.addEventListener("click", bar.click);
  }
  return { chart, x, bottom: height - bottom };
}
