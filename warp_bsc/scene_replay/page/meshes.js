// Which meshes the view shows, as a ghost or not at all, and the list in which that is chosen.
"use strict";

const SOLID = 0, GHOST = 1, HIDDEN = 2;
const meshStates = new Uint8Array(data.meshes.length);
const isHidden = (mesh) => meshStates[mesh] === HIDDEN;
const meshNumbers = new Map(data.meshes.map(({ name }, mesh) => [name, mesh]));
const MOST_NAMED = 40; // meshes in an address
let meshTable = null, pairTable = null, onMeshStates = () => {};

function setMeshes(meshes, state) {
  meshes.forEach((mesh) => { meshStates[mesh] = state; });
  showMeshStates();
}

// Shows these meshes alone.
function isolateMeshes(meshes) {
  meshStates.fill(HIDDEN);
  setMeshes(meshes, SOLID);
}

function showAllMeshes() {
  meshStates.fill(SOLID);
  showMeshStates();
}

function showMeshStates() {
  const hidden = meshStates.reduce((sum, state) => sum + (state === HIDDEN), 0), ghosts = meshStates.reduce((sum, state) => sum + (state === GHOST), 0);
  const parts = [hidden && `${count(hidden)} hidden`, ghosts && plural(ghosts, "ghost")].filter(Boolean);
  byId("meshes-count").textContent = [plural(data.meshes.length, "mesh", "meshes"), ...parts].join(", ");
  byId("show-all").hidden = !parts.length;
  meshTable?.refresh();
  pairTable?.refresh();
  onMeshStates();
}

// Adds what the address needs to show the same: the meshes in each state, or the ones that are shown if that is shorter.
function addMeshStates(parts) {
  const inState = (state) => data.meshes.filter((_, mesh) => meshStates[mesh] === state).map(({ name }) => name);
  const [solid, ghosts, hidden] = [SOLID, GHOST, HIDDEN].map(inState);
  const [key, names] = solid.length < hidden.length ? ["only", solid] : ["hide", hidden];
  if (names.length + ghosts.length > MOST_NAMED || !(hidden.length + ghosts.length)) return;
  names.forEach((name) => parts.append(key, name));
  ghosts.forEach((name) => parts.append("ghost", name));
}

function readMeshStates(parts) {
  const numbers = (key) => parts.getAll(key).map((name) => data.meshes.findIndex((mesh) => mesh.name === name)).filter((mesh) => mesh >= 0);
  const only = numbers("only");
  meshStates.fill(only.length ? HIDDEN : SOLID);
  only.forEach((mesh) => { meshStates[mesh] = SOLID; });
  numbers("hide").forEach((mesh) => { meshStates[mesh] = HIDDEN; });
  setMeshes(numbers("ghost"), GHOST);
}

// Adds buttons that isolate, ghost or hide some meshes, and returns their box; a second click on ghost or hide shows them again.
function addMeshButtons(parent, meshes) {
  const box = add(parent, "span", { class: "states" });
  const one = meshes.length === 1 ? "this mesh" : "these two meshes";
  const button = (text, title, isOn, act) => {
    const element = add(box, "button", { type: "button", title, "aria-pressed": isOn }, text);
    element.addEventListener("click", act);
  };
  const areAll = (state) => meshes.every((mesh) => meshStates[mesh] === state);
  const areAlone = areAll(SOLID) && meshStates.every((state, mesh) => state === HIDDEN || meshes.includes(mesh)) && meshes.length < data.meshes.length;
  button("Isolate", `Show ${one} alone`, areAlone, () => (areAlone ? showAllMeshes() : isolateMeshes(meshes)));
  button("Ghost", `Show ${one} faintly`, areAll(GHOST), () => setMeshes(meshes, areAll(GHOST) ? SOLID : GHOST));
  button("Hide", `Hide ${one} and their contacts`, areAll(HIDDEN), () => setMeshes(meshes, areAll(HIDDEN) ? SOLID : HIDDEN));
  return box;
}

// Returns the numbers of all meshes by their names.
function meshOrder() {
  return data.meshes.map((_, mesh) => mesh).sort((a, b) => (data.meshes[a].name < data.meshes[b].name ? -1 : 1));
}

function fillMeshes() {
  const order = meshOrder();
  const columns = [
    { title: "Mesh", key: (mesh) => data.meshes[mesh].name, fill: (cell, mesh) => {
      const name = add(cell, "span", { class: `mesh-name ${isHidden(mesh) ? "off" : ""}` });
      addSwatch(name, { fill: css(meshColor(mesh)), "fill-opacity": meshStates[mesh] === GHOST ? 0.35 : 1 });
      addPrim(name, mesh);
    } },
    { title: "In the view", class: "buttons", key: (mesh) => meshStates[mesh], fill: (cell, mesh) => addMeantButton(addMeshButtons(cell, [mesh]), [mesh]) },
  ];
  meshTable = new LongTable(byId("meshes"), columns, isNarrow ? 53 : 36, () => {});
  const filter = () => {
    const words = byId("mesh-filter").value.toLowerCase().split(/\s+/).filter(Boolean);
    meshTable.show(order.filter((mesh) => words.every((word) => data.meshes[mesh].name.toLowerCase().includes(word))));
  };
  byId("mesh-filter").addEventListener("input", filter);
  byId("mesh-filter").hidden = data.meshes.length < 9;
  byId("show-all").addEventListener("click", showAllMeshes);
  byId("mesh-list").addEventListener("toggle", () => meshTable.refresh());
  filter();
  showMeshStates();
}
