// Fills in the page from its data, and connects its parts.
"use strict";

// --- The state: the interval in the view, and the filters of the table. The address contains it after the #. ---

const state = { interval: -1, prims: [], text: "", kind: "", only: false, onlyNew: false, isReady: false };
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

// Writes what is shown to the address: interval and filter, and camera and meshes of the view.
function onView() {
  if (!state.isReady) return; // the address is still to be read
  const parts = new URLSearchParams(addressOf(state.interval, state.prims).slice(1));
  if (viewer?.cameraPath()) parts.set("camera", viewer.cameraPath());
  addMeshStates(parts);
  try {
    history.replaceState(null, "", `#${parts}`);
  } catch {
    // a page that stands in another one, as in a notebook, may have no address
  }
}

function readAddress() {
  const parts = new URLSearchParams(location.hash.slice(1));
  state.prims = parts.getAll("prim").slice(0, 2);
  // Links to prims and intervals leave the view as it is.
  if (["only", "hide", "ghost"].some((key) => parts.has(key))) readMeshStates(parts);
  if (parts.has("camera")) viewer.chooseCamera(parts.get("camera"));
  const interval = Number(parts.get("interval") ?? -1);
  if (Number.isInteger(interval) && interval >= 0 && interval <= LAST) showInterval(interval);
  filterRows();
  state.isReady = true;
  onView();
}

function showInterval(index, at = null) {
  if (index < 0 || index > LAST) return;
  const isNew = index !== state.interval;
  state.interval = index;
  onView();
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

// --- Text ---

function fillText() {
  fillHead();
  byId("verdict").hidden = !data.verdict || Boolean(data.nothing);
  byId("nothing").textContent = data.nothing;
  byId("nothing").hidden = !data.nothing;
  byId("nothing").classList.toggle("banner", !data.is_whole);
  byId("only-new-label").hidden = !data.has_baseline;
  for (const id of ["tiles", "timeline", "findings", "pairs-panel", "impacts-panel", "steps"]) byId(id).hidden = Boolean(data.nothing);
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
  byId("only-new").addEventListener("change", (event) => { state.onlyNew = event.target.checked; filterRows(); });
  byId("save-csv").addEventListener("click", saveCsv);
  byId("copy-paths").addEventListener("click", copyPaths);
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
  viewer = makeViewer();
  fillMeshes();
  fillPairs();
  fillMeant();
  listen();
  if (LAST >= 0 && !location.hash) showInterval(mostInterval());
  rows = await loadRows();
  fillTable();
  readAddress();
  if (state.interval < 0 && LAST >= 0) showInterval(mostInterval());
  document.body.dataset.state = "ready";
}

start();
