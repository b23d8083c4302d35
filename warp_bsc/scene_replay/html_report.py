"""Writes a page that shows the collisions of a replay interval by interval, in one file that needs no network.

Every interval is a block of compressed arrays, which the page's script unpacks when the interval is shown.
"""

import os
from collections.abc import Iterator

import numpy as np

from ..usd.scene import Scene
from .baseline import Baseline, Event, NewFinding
from .html_page import block, fill_page, inert, shared_part, spread
from .limit import not_listed
from .outputs import RecordFile
from .report_data import MAX_PAIRS, report_data, report_title
from .results import IntervalResult
from .scene_contacts import SceneContacts
from .scene_intersections import SceneIntersections
from .scene_pairs import CROSSES, INSIDE, ScenePairs
from .scene_proximities import SceneProximities
from .summary import Summary
from .view_blocks import ViewBlocks, moving_points

_ALL_ROWS = 300_000  # in the table; divided by the number of intervals, twice the limit of an interval ...
_FEWEST_ROWS, _MOST_ROWS = 100, 50_000  # ... within these bounds
_MOST_CAMERAS, _MOST_CAMERA_TIMES = 100, 100_000
_COLUMNS = ("first", "second", "elements", "first_0", "first_1", "second_0", "second_1")

_SCRIPTS = (
    "blocks.js", "rows.js", "elements.js", "table.js", "meshes.js", "view3d.js", "shaders.js", "view_data.js",
    "cameras.js", "viewer.js", "timeline.js", "findings.js", "meant.js", "page.js",
)  # fmt: skip

_WHY_NO_CAMERA = f"their views are not valid, or there are more than {_MOST_CAMERAS}"

_AtRest = SceneIntersections | SceneProximities


class ReportPage(RecordFile):
    """A page with a timeline, every interval in 3D, and a table of all collisions, intersections and proximities."""

    def __init__(self, path: str | os.PathLike, *, scene: Scene, baseline: Baseline | None = None):
        """Opens the file.

        Args:
            path: The file.
            scene: The scene.
            baseline: An earlier replay; the page marks what it does not contain. None marks nothing.

        Raises:
            OSError: If it cannot be written.
        """
        super().__init__(path)
        page = fill_page(shared_part("page.html"), map(shared_part, _SCRIPTS), report_title(scene))
        self._before, self._between, self._after = page
        self._baseline = baseline
        self._most_rows = int(np.clip(_ALL_ROWS // (2 * len(scene)), _FEWEST_ROWS, _MOST_ROWS))
        self._views = ViewBlocks(len(scene))
        self._meshes: dict[str, int] = {}  # number of each mesh, by its name
        self._facts: list[dict] = []  # name of each, whether it moves, and the prim's path if that is another one
        self._center: np.ndarray | None = None  # of all positions in the page
        # Numbers of rows by interval: collisions, and intersections and proximities at its start.
        self._rows: list[tuple[int, int, int]] = []
        self._last: list[tuple[str, _AtRest]] = []  # intersections and proximities at the end of the last interval

    def head(self) -> str:
        """Returns the page up to the first interval."""
        return self._before

    def record(self, result: IntervalResult) -> Iterator[str]:
        """Yields the blocks of an interval: collisions, intersections and proximities at its start, and the view."""
        interval, contacts = result.contacts.interval, result.contacts
        index = interval.index
        center = self._center
        if center is None:
            x = interval.x0.astype(np.float64)
            center = self._center = (x.min(axis=0) + x.max(axis=0)) / 2 if len(x) else np.zeros(3)
        numbers = self._number_meshes(contacts)
        rows = _choose_rows(contacts, self._most_rows)
        rows = rows[np.argsort(contacts.toi[rows], kind="stable")]
        if len(rows):
            arrays = self._pairs(contacts, rows, numbers)
            arrays |= {"kind": contacts.kind[rows], "toi": contacts.toi[rows].astype(np.float32)}
            if contacts.phase is not None and contacts.separate is not None:
                arrays |= {"phase": contacts.phase[rows], "separate": contacts.separate[rows]}
            arrays |= self._new("collides", contacts, rows, interval.start, interval.end)
            yield block(f"hits-{index}", {"of": len(contacts)}, arrays)
        at_rest, near = result.intersections or (), result.proximities or ()
        rest_rows, text = self._at_rest("rest", index, at_rest[0], numbers) if at_rest else (0, "")
        near_rows, more = self._at_rest("near", index, near[0], numbers) if near else (0, "")
        yield text + more
        positions = [contacts.position, *(found.position for found in (*at_rest, *near))]
        if index == 0 or sum(map(len, positions)):
            yield from self._views.of(result, np.concatenate(positions), numbers, center)
        self._rows[index:] = [(len(rows), rest_rows, near_rows)]
        self._last = [(name, found[1]) for name, found in (("rest", at_rest), ("near", near)) if found]

    def tail(self, summary: Summary) -> str:
        """Returns the block of the intersections at the end, the data of the whole replay, and the page's script."""
        counts, text = {"rest": 0, "near": 0}, ""
        intervals = summary.intervals
        for name, last in self._last:
            if intervals and last.time == intervals[-1].end > intervals[-1].start:
                numbers = np.array([self._meshes[mesh.name] for mesh in last.segment.meshes])
                counts[name], more = self._at_rest(name, len(intervals), last, numbers)
                text += more
        data = report_data(summary, self._baseline)
        data["rows"] = [*self._rows[: len(intervals)], (0, counts["rest"], counts["near"])]
        data["meshes"] = self._facts
        data["center"] = self._center.tolist() if self._center is not None else [0.0, 0.0, 0.0]
        data["notes"] += self._notes(summary, data["rows"])
        cameras, data["cameras"], left_out = self._cameras(summary, data["center"])
        text += cameras
        if left_out:
            data["notes"].append(f"{left_out:,} cameras cannot be chosen: {_WHY_NO_CAMERA}.")
        return text + self._between + inert(data) + self._after

    def shrink(self) -> bool:
        """Drops the last intervals."""
        self._last = []
        return super().shrink()

    def _number_meshes(self, contacts: SceneContacts) -> np.ndarray:
        """Returns the numbers in the page of a segment's meshes, shape [len(segment.meshes)]."""
        for mesh in contacts.segment.meshes:
            if self._meshes.setdefault(mesh.name, len(self._meshes)) == len(self._facts):
                path = {"path": mesh.path} if mesh.path != mesh.name else {}
                self._facts.append({"name": mesh.name, "moves": mesh.moves, **path})
        return np.array([self._meshes[mesh.name] for mesh in contacts.segment.meshes], dtype=np.int64)

    def _pairs(self, pairs: ScenePairs, rows: np.ndarray, numbers: np.ndarray) -> dict[str, np.ndarray]:
        """Returns the arrays of some pairs: meshes, elements, their numbers in the prims, and positions."""
        indices, elements = pairs.indices[rows], pairs.elements[rows]
        meshes = numbers[pairs.meshes[rows]] if len(rows) else pairs.meshes[rows]
        columns = (meshes[:, 0], meshes[:, 1], 4 * elements[:, 0] + elements[:, 1], *indices.reshape(-1, 4).T)
        position = self._from_center(pairs.position[rows]).astype(np.float32)
        return dict(zip(_COLUMNS, columns, strict=True)) | {"position": position}

    def _new(self, what: Event, pairs: ScenePairs, rows: np.ndarray, start: float, end: float) -> dict[str, np.ndarray]:
        """Returns the array that says which rows are not in the baseline; nothing without a baseline."""
        if self._baseline is None:
            return {}
        both, which = np.unique(pairs.meshes[rows], axis=0, return_inverse=True)
        names = [mesh.name for mesh in pairs.segment.meshes]
        lacks = [self._baseline.lacks(NewFinding(what, (names[i], names[j]), start, end)) for i, j in both]
        return {"new": np.array(lacks, dtype=int)[which.reshape(-1)]}

    def _new_intersections(self, found: SceneIntersections, rows: np.ndarray, kind: np.ndarray) -> dict:
        """Returns the array of :meth:`_new` for intersections of several kinds; edges that only touch are not new."""
        crosses, inside = (self._new(what, found, rows, found.time, found.time) for what in ("crosses", "is inside"))
        if not crosses:
            return {}
        return {"new": np.select([kind == CROSSES, kind == INSIDE], [crosses["new"], inside["new"]], 0)}

    def _at_rest(self, name: str, index: int, found: _AtRest, numbers: np.ndarray) -> tuple[int, str]:
        """Returns the number of rows and the block of intersections or proximities at one time; no block for none."""
        if not len(found):
            return 0, ""
        rows = _choose_rows(found, self._most_rows)
        # rows at rest have the phase as their kind, which is after those of collisions: see rows.js
        arrays = self._pairs(found, rows, numbers) | {"kind": found.phase[rows]}
        facts = {"of": len(found)}
        if isinstance(found, SceneProximities):
            arrays |= {"distance": found.distance[rows]}
            arrays |= self._new("is near", found, rows, found.time, found.time)
        else:
            cuts = spread(len(found.cuts.points), self._most_rows)
            step, points = moving_points(*(self._from_center(found.cuts.points[cuts])).transpose(1, 0, 2))
            arrays |= {
                "curve_start": points["start"],
                "curve_end": points["end"],
                "curve_meshes": numbers[found.cuts.meshes[cuts]] if len(cuts) else cuts,
                "through": np.flatnonzero(np.isin(rows, found.of_curves)),
            }
            arrays |= self._new_intersections(found, rows, arrays["kind"])
            facts |= {"curves": len(found.cuts.points), "curve_step": step}
        return len(rows), block(f"{name}-{index}", facts, arrays)

    def _cameras(self, summary: Summary, center: list[float]) -> tuple[str, list[dict], int]:
        """Returns the blocks of the scene's cameras, their facts, and the number of cameras left out."""
        scene = summary.scene
        if scene.stage is None:  # of mesh files
            return "", [], 0
        from ..usd.cameras import find_cameras, read_camera  # noqa: PLC0415 (imports pxr)

        found = find_cameras(scene.stage)
        times = list(scene.times[: len(summary.intervals) + 1])
        most = min(_MOST_CAMERAS, max(1, _MOST_CAMERA_TIMES // len(times)))
        read = [camera for own in found[:most] if (camera := read_camera(own, times))]
        texts = []
        for number, camera in enumerate(read):
            axes = camera.axes.copy()
            axes[:, 3] -= center
            texts.append(block(f"camera-{number}", {}, {"axes": axes, "window": camera.window}))
        facts = [{"path": camera.path, "perspective": camera.is_perspective} for camera in read]
        return "".join(texts), facts, len(found) - len(read)

    def _from_center(self, positions: np.ndarray) -> np.ndarray:
        """Returns positions relative to the page's center."""
        assert self._center is not None  # since the first interval
        return positions.astype(np.float64) - self._center

    def _notes(self, summary: Summary, rows: list[tuple[int, int, int]]) -> list[str]:
        """Returns sentences on what the page omits."""
        notes = []
        if summary.clearance is not None and summary.scene.has_strands:
            notes.append("Distances of curves and points are not checked, only their collisions.")
        most = f"an interval has at most {self._most_rows:,} rows, spread evenly, with at least one for each two meshes"
        rest = sum(at.crossings + at.touches + sum(at.inside.values()) for at in summary.intersections)
        near = sum(at.pairs for at in summary.proximities)
        names = "collisions", "intersections at rest", "proximities"
        missing = not_listed(summary, with_end=True)
        limited = (missing.collisions[0], missing.intersections[0], missing.proximities[0]) if missing else (0, 0, 0)
        if missing and any(limited):
            notes.append(f"{missing} This holds for other files of the replay, and the views in 3D, as well.")
        found = summary.hits - limited[0], rest - limited[1], near - limited[2]
        for name, listed, shown in zip(names, found, zip(*rows, strict=True), strict=True):
            if sum(shown) < listed:
                notes.append(f"The table has {sum(shown):,} of {listed:,} {name}: {most}. JSON and CSV files have all.")
        if partial := self._views.partial_strands:
            notes.append(f"{partial:,} views in 3D have only some of the curves or points, spread evenly.")
        if self._views.without_view:
            notes.append(f"{self._views.without_view:,} intervals have no view in 3D, as the page is full.")
        spans = [*summary.collision_spans, *summary.intersection_spans, *summary.proximity_spans]
        pairs = len({tuple(sorted(span.meshes)) for span in spans})
        if pairs > MAX_PAIRS:
            notes.append(f"The page has {MAX_PAIRS:,} of {pairs:,} pairs of meshes, those with the most collisions.")
        return [*notes, summary.not_counted] if summary.not_counted else notes


def _choose_rows(pairs: ScenePairs, most: int) -> np.ndarray:
    """Returns the rows of the pairs in the page: all, or ``most``, spread evenly, with the first of each two meshes."""
    if len(pairs) <= most:
        return np.arange(len(pairs))
    firsts = np.unique(pairs.mesh_keys(), return_index=True)[1][:most]
    others = np.delete(np.arange(len(pairs)), firsts)
    return np.union1d(firsts, others[spread(len(others), most - len(firsts))])
