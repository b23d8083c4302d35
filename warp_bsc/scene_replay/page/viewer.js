// Shows an interval in 3D: triangles that move from start to end, contacts, cut curves, and an outline of the rest.
"use strict";

// Makes the view and its controls. Returns functions that show an interval, turn the view, and choose a camera.
function makeViewer() {
  const message = byId("viewer-message");
  const say = (text) => { message.textContent = text; message.hidden = !text; };
  const canvas = byId("canvas");
  const cameras = makeCameras(() => { showTime(); onView(); });
  const { gl, camera, turned, ask, frame, begin, set, turn, lookThrough } = makeCanvas(canvas, data.up_axis === "Z", draw, () => cameras.choose(""));
  if (!gl) say("This browser has no WebGL 2, which the view in 3D needs.");
  if (LAST < 0) say("There is nothing to show.");

  const triangles = gl && program(gl, TRIANGLE_SHADER, TRIANGLE_COLOR);
  const points = gl && program(gl, POINT_SHADER, POINT_COLOR);
  const strands = gl && program(gl, STRAND_SHADER, STRAND_COLOR);
  const lines = gl && program(gl, CURVE_SHADER, CURVE_COLOR_SHADER);
  const state = { time: 0, playing: false, last: 0, index: -1, shown: null, parts: null, chosen: null, framed: false };
  onMeshStates = () => { if (state.shown) fillParts(); onView(); };

  // Shows an interval. `at`, if given, is a row of the table: {from, place, time}, from "hits", "rest" or "near".
  async function show(index, at = null) {
    const isNew = index !== state.index;
    state.index = index;
    const [from, to] = data.intervals[index];
    byId("viewer-heading").textContent = from === to ? `Time ${short(from)}` : `Time ${short(from)} to ${short(to)}`;
    canvas.setAttribute("aria-label", `${byId("viewer-heading").textContent} in 3D. Drag to turn, scroll to zoom.`);
    byId("selected").hidden = true;
    if (!gl) return;
    if (isNew) {
      const shown = await loadView(index);
      if (state.index !== index) return; // another one was selected meanwhile
      fill(shown, index);
    }
    if (!state.shown) return;
    if (at) choose(at);
    else if (isNew) state.time = state.shown.median;
    showTime();
  }

  function fill(shown, index) {
    freeParts();
    state.chosen?.free();
    state.chosen = null;
    state.shown = shown;
    const legend = byId("viewer-legend");
    legend.replaceChildren();
    let title = data.nothing ? "" : plural(hitsIn(index), "collision");
    const atEnds = (numberAt, one, how) => { title += `; ${plural(numberAt(index), one)} ${how} at the start, ${count(numberAt(index + 1))} at the end`; };
    if (data.rest.length && !data.nothing) atEnds(edgesAt, "edge", "in faces");
    if (insideAt(index) + insideAt(index + 1)) atEnds(insideAt, "part", "inside");
    if (data.near.length && !data.nothing) atEnds(nearAt, "pair", "within the clearance");
    const isEmpty = !shown;
    byId("viewer").querySelector(".controls").classList.toggle("idle", isEmpty);
    if (shown?.outline) title += `; ${count(shown.faces.length / 3)} of ${count(shown.of)} triangles near them are shown, and a grey outline of all`;
    byId("viewer-title").textContent = title;
    if (isEmpty) {
      say(hitsIn(index) + atStart(index) + atStart(index + 1) ? "The page is full and has no view of this interval; see the notes." : "Nothing collides or intersects here, so the page has no view of this interval.");
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      return;
    }
    say("");
    const { meshes, start, end, hits, rest, near } = shown;
    const present = [...new Set(meshes)];
    present.slice(0, 6).forEach((mesh) => addKey(legend, { fill: css(meshColor(mesh)) }, data.meshes[mesh].name));
    if (present.length > 6) {
      const more = add(legend, "button", { type: "button", class: "link" }, `and ${count(present.length - 6)} more`);
      more.addEventListener("click", () => { byId("mesh-list").open = true; byId("mesh-list").scrollIntoView({ block: "nearest" }); });
    }
    if (shown.outline) addKey(legend, { fill: css(REST_COLOR), "fill-opacity": 0.5 }, "outline of all meshes");
    if (shown.lit.length) addKey(legend, { fill: css(LIT_COLOR) }, "faces that collide");
    CONTACT_COLORS.forEach((color, kind) => {
      if (hits.kind.includes(kind)) addKey(legend, { fill: css(color), rx: 5 }, `${KINDS[kind]} contact`);
    });
    if (rest.some((block) => block?.from.length)) addKey(legend, { fill: css(CURVE_COLOR), y: 3, height: 4 }, "curves where surfaces cut");
    if (rest.some((block) => block?.kind.includes(INSIDE))) addKey(legend, { fill: css(CURVE_COLOR), rx: 5 }, "part of a mesh inside another");
    if (rest.some((block) => block?.through.length)) addKey(legend, { fill: css(CURVE_COLOR), rx: 5 }, "curve through a face");
    if (near.some((block) => block)) addKey(legend, { fill: css(NEAR_COLOR), rx: 5 }, "proximity");

    const moving = [start, end].map((values) => values.filter((_, i) => data.meshes[meshes[Math.floor(i / 3)]].moves));
    const everything = boxOf(shown.outline ? [start, end, shown.outline.start, shown.outline.end] : [start, end]);
    shown.reach = everything.radius + Math.hypot(...everything.center);
    shown.whole = shown.outline ? everything : boxOf(moving.some((values) => values.length) ? moving : [start]);
    const places = [hits, ...rest, ...near].filter((block) => block?.position.length).map((block) => block.position);
    shown.close = places.length ? boxOf(places) : { ...shown.whole };
    shown.close.radius = Math.max(shown.close.radius * 1.2, shown.whole.radius * 0.12);
    shown.median = hits.toi.length ? Array.from(hits.toi).sort((a, b) => a - b)[hits.toi.length >> 1] : 0;
    byId("frame-contacts").hidden = !places.length;
    fillParts();
    if (!state.framed) {
      const { close, whole } = shown;
      frame(places.length ? { center: close.center, radius: Math.max(close.radius, 0.6 * whole.radius) } : { center: whole.center, radius: 1.15 * whole.radius });
      state.framed = true;
    }
  }

  function freeParts() {
    if (state.parts) Object.values(state.parts).flat().forEach((part) => part.free());
    state.parts = null;
  }

  // Uploads what is visible of the interval.
  function fillParts() {
    freeParts();
    const { shown } = state, { meshes, start, end, faces, hits, outline } = shown;
    const colors = new Float32Array(start.length);
    meshes.forEach((mesh, vertex) => colors.set(meshColor(mesh), 3 * vertex));
    const positions = [["start", start, 3], ["end", end, 3], ["color", colors, 3]];
    const surface = (attributes, corners, rows) => ({ length: 3 * rows.length, ...vertexArray(gl, triangles, attributes, pick(corners, 3, rows)) });
    const solid = inState(faces, 3, meshes, (mesh) => meshStates[mesh] === SOLID), isSolid = new Set(solid);
    const ghosts = inState(faces, 3, meshes, (mesh) => meshStates[mesh] === GHOST);
    const dots = (place, color, toi) => ({ count: place.length / 3, ...vertexArray(gl, points, [["start", place, 3], ["color", color, 3], ["toi", toi, 1]]) });
    const rows = visibleRows(hits), pointColors = new Float32Array(3 * rows.length);
    rows.forEach((row, place) => pointColors.set(CONTACT_COLORS[hits.kind[row]], 3 * place));
    const segments = (values, stride, places, more = []) => vertexArray(gl, lines, [...["start", "end", "start_1", "end_1"].map((name, i) => [name, values, 3, [stride, places[i]]]), ...more]);
    const free = inState(shown.edges, 2, meshes, (mesh) => !isHidden(mesh)), ropes = new Float32Array(12 * free.length), ropeColors = new Float32Array(3 * free.length);
    free.forEach((edge, place) => {
      const ends = shown.edges.subarray(2 * edge, 2 * edge + 2);
      [start, end].forEach((values, when) => ends.forEach((vertex, i) => ropes.set(values.subarray(3 * vertex, 3 * vertex + 3), 12 * place + 6 * when + 3 * i)));
      ropeColors.set(meshColor(meshes[ends[0]]).map((value) => STRAND_SHADE * value), 3 * place);
    });
    const alone = shown.points.filter((vertex) => !isHidden(meshes[vertex]));
    const shades = colors.map((value) => STRAND_SHADE * value);
    state.parts = {
      solid: surface(positions, faces, solid),
      ghosts: surface(positions, faces, ghosts),
      lit: surface(positions, faces, shown.lit.filter((face) => isSolid.has(face))),
      outline: outline ? surface([["start", outline.start, 3], ["end", outline.end, 3]], outline.faces, inState(outline.faces, 3, outline.meshes, (mesh) => !isHidden(mesh))) : [],
      dots: dots(pick(hits.position, 3, rows), pointColors, pick(hits.toi, 1, rows)),
      // of intersections and proximities at the start, and at the end
      cuts: shown.rest.map((block) => cutsOf(block, segments)),
      marks: [0, 1].map((end_) => marksOf(shown.rest[end_], shown.near[end_], dots)),
      ropes: { count: free.length, ...segments(ropes, 48, [0, 12, 24, 36], [["color", ropeColors, 3, [12, 0]]]) },
      dust: { count: alone.length, ...vertexArray(gl, strands, [...positions.slice(0, 2), ["color", shades, 3]], alone) },
    };
    ask();
  }

  // The curves in which visible meshes cut each other.
  function cutsOf(block, segments) {
    const rows = [], length = block ? block.from.length / 3 : 0;
    for (let i = 0; i < length; i += 1) {
      const [first, second] = block.curve_meshes.subarray(2 * i, 2 * i + 2);
      if (!isHidden(first) && !isHidden(second) && !isMeant(first, second)) rows.push(i);
    }
    const values = new Float32Array(6 * rows.length);
    rows.forEach((row, place) => [block.from, block.to].forEach((ends, i) => values.set(ends.subarray(3 * row, 3 * row + 3), 6 * place + 3 * i)));
    return { count: rows.length, ...segments(values, 24, [0, 12, 0, 12]) };
  }

  // Markers of parts inside others, curves through faces, and proximities.
  function marksOf(rest, near, dots) {
    const through = new Set(rest?.through);
    const atRest = visibleRows(rest).filter((row) => rest.kind[row] === INSIDE || through.has(row)), atNear = visibleRows(near);
    const places = new Float32Array([...(rest ? pick(rest.position, 3, atRest) : []), ...(near ? pick(near.position, 3, atNear) : [])]);
    const colors = [...atRest.flatMap(() => CURVE_COLOR), ...atNear.flatMap(() => NEAR_COLOR)];
    return dots(places, new Float32Array(colors), new Float32Array(places.length / 3));
  }

  // Marks the position of a row, and moves the view to it.
  function choose({ from, place, time }) {
    const { hits, rest, near } = state.shown;
    const block = from === "hits" ? hits : (from === "rest" ? rest : near)[Math.round(time)];
    state.time = time;
    if (!block) return;
    const point = block.position.slice(3 * place, 3 * place + 3);
    state.chosen?.free();
    state.chosen = vertexArray(gl, points, [["start", point, 3], ["color", new Float32Array(CHOSEN_COLOR), 3], ["toi", new Float32Array([0]), 1]]);
    camera.center = turned([...point]);
    camera.distance = Math.min(camera.distance, 0.5 * state.shown.whole.radius);
  }

  function drawSurface(part, values) {
    if (!part.length) return;
    set(triangles, { time: state.time, only: [0, 0, 0, 0], transparency: 0, ...values });
    gl.bindVertexArray(part.array);
    gl.drawElements(gl.TRIANGLES, part.length, gl.UNSIGNED_INT, 0);
  }

  function draw(now) {
    const { shown, parts } = state;
    if (!shown) return;
    if (state.playing) {
      state.time = (state.time + (now - (state.last || now)) / 2500) % 1;
      showTime();
    }
    state.last = now;
    const { scale, width, height } = begin(shown.whole.radius, shown.reach);
    if (parts.outline.length) {
      // The nearest faces of the outline alone, and behind all that is shown in full.
      gl.colorMask(false, false, false, false);
      drawSurface(parts.outline, {});
      gl.colorMask(true, true, true, true);
      gl.depthFunc(gl.LEQUAL);
      drawSurface(parts.outline, { only: [...REST_COLOR, 1], transparency: 0.55 });
      gl.depthFunc(gl.LESS);
      gl.clear(gl.DEPTH_BUFFER_BIT);
    }
    gl.enable(gl.POLYGON_OFFSET_FILL);
    for (const [part, only, offset] of [[parts.lit, [...LIT_COLOR, 0.85], 0], [parts.solid, [0, 0, 0, 0], 1]]) {
      gl.polygonOffset(offset, offset);
      drawSurface(part, { only });
    }
    gl.disable(gl.POLYGON_OFFSET_FILL);
    const pixel = [(2 * scale) / width, (2 * scale) / height];
    set(lines, { pixel, time: state.time, fade: 1 });
    gl.bindVertexArray(parts.ropes.array);
    gl.drawArraysInstanced(gl.TRIANGLES, 0, 6, parts.ropes.count);
    set(strands, { time: state.time, size: 5 * scale });
    gl.bindVertexArray(parts.dust.array);
    gl.drawElements(gl.POINTS, parts.dust.count, gl.UNSIGNED_INT, 0);
    gl.depthMask(false);
    drawSurface(parts.ghosts, { transparency: 0.85 });
    drawMarks(parts, scale, pixel);
    gl.depthFunc(gl.LESS);
    gl.depthMask(true);
    if (state.playing) ask();
  }

  // Contacts behind a surface are drawn faintly over it. Cut curves belong to one end of the interval.
  function drawMarks(parts, scale, pixel) {
    const end = state.time < 0.5 ? 0 : 1, marks = parts.marks[end], cuts = parts.cuts[end];
    // Large markers of many contacts would hide one another and the surfaces.
    const number = parts.dots.count + marks.count, isCrowded = number > 20000;
    const size = Math.max(isCrowded ? 2.5 : 4, 15 - 2.2 * Math.log10(Math.max(1, number)) ** 1.4) * scale;
    for (const [test, fade] of [[gl.GREATER, isCrowded ? 0.12 : 0.45], [gl.LEQUAL, 1]]) {
      gl.depthFunc(test);
      set(lines, { pixel, time: 0, fade: test === gl.LEQUAL ? 1 : 0.45 });
      gl.vertexAttrib3fv(gl.getAttribLocation(lines, "color"), CURVE_COLOR); // cut curves have one colour
      gl.bindVertexArray(cuts.array);
      gl.drawArraysInstanced(gl.TRIANGLES, 0, 6, cuts.count);
      set(points, { time: state.time, fade, size, core: number > 300 ? 2 : 0.68 });
      for (const part of [marks, parts.dots]) {
        gl.bindVertexArray(part.array);
        gl.drawArrays(gl.POINTS, 0, part.count);
      }
    }
    if (state.chosen) {
      gl.depthFunc(gl.ALWAYS);
      set(points, { time: state.time, fade: 1, size: 16 * scale, core: 0.6 });
      gl.bindVertexArray(state.chosen.array);
      gl.drawArrays(gl.POINTS, 0, 1);
    }
  }

  function showTime() {
    if (state.index < 0) return;
    const [from, to] = data.intervals[state.index];
    byId("time").value = Math.round(1000 * state.time);
    byId("time-label").textContent = `time ${short(from + state.time * (to - from))}`;
    lookThrough(cameras.at(state.index, state.time));
  }

  byId("time").addEventListener("input", (event) => { state.time = event.target.value / 1000; showTime(); });
  byId("play").addEventListener("click", () => {
    state.playing = !state.playing;
    state.last = 0;
    byId("play").textContent = state.playing ? "Pause" : "Play";
    ask();
  });
  byId("frame-all").addEventListener("click", () => { if (state.shown) frame({ center: state.shown.whole.center, radius: 1.15 * state.shown.whole.radius }); });
  byId("frame-contacts").addEventListener("click", () => { if (state.shown) frame(state.shown.close); });
  return { show, turn, chooseCamera: cameras.choose, cameraPath: cameras.path };
}
