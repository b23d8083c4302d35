// The charts of a page: the timeline, whose bars show their intervals, and the times of impact.
"use strict";

let timeline = null, mark = null; // the first chart of the timeline, and the mark of the interval in the view

// Returns bars of one interval each, or of several if there are too many: {from, to, rows, tip, click}.
function intervalBars(width) {
  const together = Math.ceil(data.intervals.length / (width / 2.5)), bars = [];
  for (let at = 0; at < data.intervals.length; at += together) {
    const some = data.intervals.slice(at, at + together), rest = data.rest.slice(at, at + together);
    const sum = (column) => some.reduce((total, interval) => total + interval[column], 0);
    const [from, to] = [some[0][0], some[some.length - 1][1]];
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
    bars.push({ from, to: to > from ? to : from + 1, tip, click, hits: [sum(2), sum(3) + points], rest: [most(1) + most(2) + most(3)], near: [near] });
  }
  return bars;
}

// Fills in a chart for collisions, one for intersections and one for proximities, if there are any.
function fillIntervals() {
  if (LAST < 0 || data.nothing) return;
  const width = Math.max(340, Math.min(1100, byId("intervals").clientWidth || 1100));
  const bars = intervalBars(width), total = (bar, key) => bar[key].reduce((sum, part) => sum + part, 0);
  const most = (key) => Math.max(...bars.map((bar) => total(bar, key)));
  const charts = [["hits", ["first", "second"]], ["rest", ["third"]], ["near", ["fourth"]]].filter(([key]) => most(key) > 0);
  const least = Math.max(64, ...charts.map(([key]) => labelWidth(most(key))));
  const edges = data.intervals[0].length > 4 ? "edge-edge, vertex-edge, vertex-vertex" : "edge-edge";
  const keys = { hits: [["first", "vertex-face"], ["second", edges]], rest: [["third", "edges in faces and parts inside, at rest"]], near: [["fourth", "proximities, at rest"]] };
  charts.forEach(([key, classes], place) => {
    keys[key].forEach(([style, text]) => addKey(byId("intervals-legend"), { class: style }, text));
    const own = bars.map((bar) => ({ ...bar, parts: bar[key] }));
    const chart = addBars(byId("intervals"), own, classes, width, place ? "" : "time code", place ? 80 : 200, least);
    timeline = timeline || chart;
  });
  byId("timeline").hidden = !charts.length;
  if (timeline) mark = add(timeline.chart, "rect", { class: "mark", y: 2, height: timeline.bottom - 1, rx: 3 });
}

function markInterval() {
  if (!mark) return;
  const [from, to] = data.intervals[state.interval];
  const [left, right] = [timeline.x(from), timeline.x(to > from ? to : from + 1)];
  mark.setAttribute("x", left - 1);
  mark.setAttribute("width", right - left + 2);
}

function fillImpacts() {
  const bins = data.toi.length;
  byId("impacts-panel").hidden = !data.toi.some((hits) => hits);
  if (byId("impacts-panel").hidden) return;
  const bars = data.toi.map((hits, bin) => ({
    from: bin / bins, to: (bin + 1) / bins, parts: [hits],
    tip: `${short(bin / bins)} to ${short((bin + 1) / bins)}\n${plural(hits, "collision")}`,
  }));
  addBars(byId("impacts"), bars, ["bar"], Math.min(520, byId("impacts").clientWidth || 520), "share of the interval");
}
