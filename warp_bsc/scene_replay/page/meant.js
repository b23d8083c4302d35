// Meshes that are meant to meet: marked here, listed apart, and saved as a triage file.
"use strict";

// The entries of the file: meshes, one or two names, reason, who, date. Those that the replay has read have `hits`, the
// collisions that it has only counted because of them; the findings of the others are in the page.
let entries = data.triage ?? [], changes = 0, meantTable = null, meantRows = [], toMark = [];
const meantPairs = new Set(), meantMeshes = new Set(); // of entries that the replay has not read

const pairKey = (first, second) => Math.min(first, second) * data.meshes.length + Math.max(first, second);
const isMeant = (first, second) => meantPairs.has(pairKey(first, second)) || (first !== second && (meantMeshes.has(first) || meantMeshes.has(second)));

// Adds the button that marks two meshes, or one with all others.
function addMeantButton(parent, meshes) {
  if (!data.triage) return;
  const title = meshes.length === 1 ? "This mesh is meant to meet all others" : "These are meant to meet";
  add(parent, "button", { type: "button", title }, "Meant").addEventListener("click", () => {
    const names = meshes.map((mesh) => data.meshes[mesh].name);
    toMark = names.sort();
    byId("mark-what").textContent = `Meant to meet: ${names.length === 1 ? `${names[0]} and all others` : names[0] === names[1] ? `${names[0]} and itself` : names.join(" and ")}`;
    byId("mark-reason").value = "";
    byId("mark-do").disabled = true;
    byId("mark").hidden = false;
    byId("mark").scrollIntoView({ block: "center" });
    byId("mark-reason").focus({ preventScroll: true });
  });
}

function markAsMeant() {
  const [reason, who] = ["mark-reason", "mark-who"].map((id) => byId(id).value.trim()), now = new Date();
  if (!reason || !who) return;
  const date = new Date(now - 60000 * now.getTimezoneOffset()).toISOString().slice(0, 10); // of this place
  byId("mark").hidden = true;
  change([...entries.filter(({ meshes }) => String(meshes) !== String(toMark)), { meshes: toMark, reason, who, date }]);
}

const keepChanges = (event) => event.preventDefault(); // asks before the page is left

// Takes other entries, in the order of their meshes, and shows what is meant then.
function change(others) {
  const compare = (a, b) => (a < b ? -1 : a > b ? 1 : 0);
  entries = others.sort((a, b) => compare(a.meshes.join("\n"), b.meshes.join("\n")));
  changes += 1;
  addEventListener("beforeunload", keepChanges);
  meantPairs.clear();
  meantMeshes.clear();
  for (const { meshes, hits } of entries) {
    const [first, second] = meshes.map((name) => meshNumbers.get(name));
    if (hits !== undefined) continue;
    if (meshes.length === 1) meantMeshes.add(first);
    else meantPairs.add(pairKey(first, second));
  }
  showMeant();
  showPairs();
  filterRows();
  onMeshStates();
}

function showMeant() {
  const pairs = data.pairs.filter(({ meshes }) => isMeant(...meshes.map((name) => meshNumbers.get(name))));
  const hitsOf = ({ meshes, hits }) => hits ?? pairs.reduce((sum, pair) => sum + (meshes.every((name) => pair.meshes.includes(name)) && (meshes[0] === meshes[1]) === (pair.meshes[0] === pair.meshes[1]) ? pair.hits : 0), 0);
  meantRows = [...entries, ...data.ignored].map((entry) => ({ ...entry, entry, number: hitsOf(entry) }));
  const [ignored, hits] = data.ignored_counts;
  byId("meant-panel").hidden = !meantRows.length && !changes;
  byId("meant-count").textContent = `${plural(ignored + pairs.length, "pair")} of meshes, ${plural(pairs.reduce((sum, pair) => sum + pair.hits, hits), "collision")}, not counted`;
  byId("verdict").textContent = data.verdict + (pairs.length ? ` Of these, ${plural(pairs.length, "pair is", "pairs are")} marked as meant.` : "");
  byId("save-triage").hidden = !data.triage;
  byId("unsaved").textContent = changes ? `${plural(changes, "change")} not saved yet. The file belongs beside the scene; --triage reads it.` : "";
  meantTable.show(meantRows.map((_, row) => row));
}

function fillMeant() {
  const columns = [
    { title: "Meshes", key: (row) => meantRows[row].meshes.join("\n"), fill: (cell, row) => {
      const { meshes } = meantRows[row];
      for (const name of new Set(meshes)) add(add(cell, "span", { class: "prim", title: name }), "bdi", {}, name);
      if (meshes.length === 1 || meshes[0] === meshes[1]) add(cell, "span", { class: "element" }, meshes.length === 1 ? "with all others" : "with itself");
    } },
    { title: "Reason", key: (row) => meantRows[row].reason, fill: (cell, row) => {
      const { reason, who, date, entry } = meantRows[row];
      add(cell, "span", { class: "clip", title: reason }, reason);
      if (!who) return;
      const tools = add(cell, "span", { class: "tools states" });
      add(tools, "span", { class: "element" }, `${who}, ${date}`);
      add(tools, "button", { type: "button", title: "Take this out of the file" }, "Not meant").addEventListener("click", () => change(entries.filter((other) => other !== entry)));
    } },
    { title: "Collisions", number: true, class: "narrow wide-only", key: (row) => meantRows[row].number, fill: (cell, row) => { cell.textContent = count(meantRows[row].number); } },
  ];
  meantTable = new LongTable(byId("meant-rows"), columns, isNarrow ? 108 : 78, () => {});
  byId("save-triage").textContent = `Save ${data.triage_name}`;
  byId("mark-do").addEventListener("click", markAsMeant);
  byId("mark-cancel").addEventListener("click", () => { byId("mark").hidden = true; });
  for (const id of ["mark-reason", "mark-who"]) {
    byId(id).addEventListener("input", () => { byId("mark-do").disabled = !byId("mark-reason").value.trim() || !byId("mark-who").value.trim(); });
    byId(id).addEventListener("keydown", (event) => { if (event.key === "Enter") markAsMeant(); });
  }
  byId("save-triage").addEventListener("click", saveTriage);
  byId("meant").addEventListener("toggle", () => meantTable.refresh());
  showMeant();
}

// Saves the file, an entry a line, so that the changes of several people merge.
function saveTriage() {
  const lines = entries.map((entry) => `{"meshes": [${entry.meshes.map((name) => JSON.stringify(name)).join(", ")}], ${["reason", "who", "date"].map((key) => `"${key}": ${JSON.stringify(entry[key])}`).join(", ")}}`);
  download(data.triage_name, "application/json", [`{"version": 1, "meant": [\n${lines.join(",\n")}\n]}\n`]);
  changes = 0;
  removeEventListener("beforeunload", keepChanges);
  showMeant();
}
