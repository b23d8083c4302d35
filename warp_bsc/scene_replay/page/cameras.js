// The cameras of the scene, through which the view looks.
"use strict";

// Fills the list of cameras. Returns functions: `choose` a camera by its path, or none; and `at`, the lens of the one
// that is chosen at a share of an interval, null for the free view.
function makeCameras(onChange) {
  const list = byId("camera"), state = { number: -1, block: null };
  data.cameras.forEach(({ path }, number) => add(list, "option", { value: number }, path));
  list.hidden = !data.cameras.length;
  list.addEventListener("change", () => take(list.value === "" ? -1 : Number(list.value)));

  async function take(number) {
    state.number = number;
    list.value = number < 0 ? "" : String(number);
    const block = number < 0 ? null : await unpack(`camera-${number}`);
    if (state.number !== number) return; // another one was chosen meanwhile
    state.block = block;
    onChange();
  }

  function at(interval, share) {
    if (!state.block) return null;
    const { axes, window } = state.block, last = window.length / 4 - 1;
    const mixed = (values, width) => {
      const [from, to] = [interval, interval + 1].map((row) => values.subarray(width * Math.min(row, last), width * Math.min(row, last) + width));
      return Array.from(from, (value, i) => value + share * (to[i] - value));
    };
    const rows = mixed(axes, 12), [, up, backward, position] = [0, 3, 6, 9].map((start) => rows.slice(start, start + 3));
    // Directions between those of two times are not perpendicular.
    const unit = (vector) => vector.map((value) => value / (Math.hypot(...vector) || 1));
    const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    const back = unit(backward), right = unit(cross(up, back));
    return { right, up: cross(back, right), backward: back, position, window: mixed(window, 4), isPerspective: data.cameras[state.number].perspective };
  }

  return {
    at,
    path: () => data.cameras[state.number]?.path ?? "",
    choose: (path) => {
      const number = data.cameras.findIndex((camera) => camera.path === path);
      if (number !== state.number) take(number);
    },
  };
}
