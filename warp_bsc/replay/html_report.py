"""Writes a page that shows the collisions of a replay interval by interval, in one file that needs no network.

Every interval is a block of compressed arrays, which the page's script unpacks when the interval is shown.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..usd.scene import Scene
from .html_page import block, fill_page, inert, shared_part, spread
from .limit import not_listed
from .outputs import RecordFile
from .page_view import choose_faces
from .results import IntervalResult
from .scene_contacts import SceneContacts
from .scene_intersections import SceneIntersections
from .scene_pairs import ScenePairs
from .scene_proximities import SceneProximities
from .summary import CERTIFIED_FOR, Summary

__all__ = ["ReportPage"]

_ALL_FACES = 1_500_000  # in the views of all intervals together; divided by their number, the limit of an interval ...
_FEWEST_FACES, _MOST_FACES = 1_000, 150_000  # ... within these bounds
_ALL_ROWS = 600_000  # in the table, likewise; the time to open the page grows with them
_FEWEST_ROWS, _MOST_ROWS = 100, 50_000
_VIEW_BYTES = 64 << 20  # of all views together
_MAX_PAIRS = 10_000  # of meshes
_MAX_ROWS = 10  # of the small tables
_MAX_DISAGREEMENTS = 200
_CROSSES, _TOUCHES, _INSIDE, _PROXIMITY = range(4, 8)  # kinds of rows, after those of collisions: see rows.js
_COLUMNS = ("first", "second", "elements", "first_0", "first_1", "second_0", "second_1")

_AtRest = SceneIntersections | SceneProximities


class ReportPage(RecordFile):
    """A page with a timeline, every interval in 3D, and a table of all collisions, intersections and proximities."""

    def __init__(self, path: str | os.PathLike, *, scene: Scene):
        """Opens the file.

        Args:
            path: The file.
            scene: The scene.

        Raises:
            OSError: If it cannot be written.
        """
        super().__init__(path)
        names = "blocks.js", "rows.js", "elements.js", "view3d.js", "viewer.js", "table.js", "page.js"
        page = fill_page(shared_part("page.html"), map(shared_part, names), _title(scene))
        self._before, self._between, self._after = page
        self._most_faces = int(np.clip(_ALL_FACES // len(scene), _FEWEST_FACES, _MOST_FACES))
        self._most_rows = int(np.clip(_ALL_ROWS // (2 * len(scene)), _FEWEST_ROWS, _MOST_ROWS))
        self._view_bytes = 0
        self._meshes: dict[str, int] = {}  # number of each mesh, by its name
        self._moves: list[bool] = []  # whether each moves
        self._faces: tuple[Any, int] | None = None  # the segment whose faces are all in the page, and their block
        self._center: np.ndarray | None = None  # of all positions in the page
        # Numbers of rows by interval: collisions, and intersections and proximities at its start.
        self._rows: list[tuple[int, int, int]] = []
        self._last: list[tuple[str, _AtRest]] = []  # intersections and proximities at the end of the last interval
        self._without_view = 0
        self._some_strands = 0  # number of views without all curves and points

    def head(self) -> str:
        """Returns the page up to the first interval."""
        return self._before

    def record(self, result: IntervalResult) -> Iterator[str]:
        """Yields the blocks of an interval: collisions, intersections and proximities at its start, and the view."""
        interval, contacts = result.contacts.interval, result.contacts
        index = interval.index
        if self._center is None:
            x = interval.x0.astype(np.float64)
            self._center = (x.min(axis=0) + x.max(axis=0)) / 2 if len(x) else np.zeros(3)
        numbers = self._number_meshes(contacts)
        rows = _choose_rows(contacts, self._most_rows)
        if len(rows):
            arrays = self._pairs(contacts, rows, numbers)
            arrays |= {"kind": contacts.kind[rows], "toi": contacts.toi[rows].astype(np.float32)}
            if contacts.phase is not None and contacts.separate is not None:
                arrays |= {"phase": contacts.phase[rows], "separate": contacts.separate[rows]}
            yield block(f"hits-{index}", {"of": len(contacts)}, arrays)
        at_rest, near = result.intersections or (), result.proximities or ()
        rest_rows, text = self._at_rest("rest", index, at_rest[0], numbers) if at_rest else (0, "")
        near_rows, more = self._at_rest("near", index, near[0], numbers) if near else (0, "")
        yield text + more
        positions = [contacts.position, *(found.position for found in (*at_rest, *near))]
        if index == 0 or sum(map(len, positions)):
            yield from self._view(result, np.concatenate(positions), numbers)
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
        data = _data(summary)
        data["rows"] = [*self._rows[: len(intervals)], (0, counts["rest"], counts["near"])]
        data["meshes"] = [{"name": name, "moves": moves} for name, moves in zip(self._meshes, self._moves, strict=True)]
        data["center"] = self._center.tolist() if self._center is not None else [0, 0, 0]
        data["notes"] += self._notes(summary, data["rows"])
        return text + self._between + inert(data) + self._after

    def shrink(self) -> bool:
        """Drops the last intervals."""
        self._last = []
        return super().shrink()

    def _number_meshes(self, contacts: SceneContacts) -> np.ndarray:
        """Returns the numbers in the page of a segment's meshes, shape [len(segment.meshes)]."""
        for mesh in contacts.segment.meshes:
            if self._meshes.setdefault(mesh.name, len(self._meshes)) == len(self._moves):
                self._moves.append(mesh.moves)
        return np.array([self._meshes[mesh.name] for mesh in contacts.segment.meshes], dtype=np.int64)

    def _pairs(self, pairs: ScenePairs, rows: np.ndarray, numbers: np.ndarray) -> dict[str, np.ndarray]:
        """Returns the arrays of some pairs: meshes, elements, their numbers in the prims, and positions."""
        indices, elements = pairs.indices[rows], pairs.elements[rows]
        meshes = numbers[pairs.meshes[rows]] if len(rows) else pairs.meshes[rows]
        columns = (meshes[:, 0], meshes[:, 1], 4 * elements[:, 0] + elements[:, 1], *indices.reshape(-1, 4).T)
        return dict(zip(_COLUMNS, columns, strict=True)) | {"position": self._placed(pairs.position[rows])}

    def _at_rest(self, name: str, index: int, found: _AtRest, numbers: np.ndarray) -> tuple[int, str]:
        """Returns the number of rows and the block of intersections or proximities at one time; no block for none."""
        if not len(found):
            return 0, ""
        rows = _choose_rows(found, self._most_rows)
        arrays = self._pairs(found, rows, numbers)
        facts = {"of": len(found)}
        if isinstance(found, SceneProximities):
            arrays |= {"kind": np.full(len(rows), _PROXIMITY), "distance": found.distance[rows]}
        else:
            kind = np.where(found.crosses[rows], _CROSSES, _TOUCHES)
            curves = found.cuts.points
            arrays |= {
                "kind": np.where(rows < found.edge_rows.stop, kind, _INSIDE),
                "curves": self._placed(curves[spread(len(curves), self._most_rows)]),
                "through": self._placed(found.position[np.intersect1d(rows, found.of_curves)]),
            }
            facts["curves"] = len(curves)
        return len(rows), block(f"{name}-{index}", facts, arrays)

    def _view(self, result: IntervalResult, positions: np.ndarray, numbers: np.ndarray) -> Iterator[str]:
        """Yields the blocks of the triangles that move in an interval: all, or those around the given positions.

        Edges of curves, and points, are included, each up to the largest number of triangles.
        """
        interval, segment = result.contacts.interval, result.contacts.segment
        if not len(segment.faces) and not segment.has_strands:
            return
        if self._view_bytes > _VIEW_BYTES:
            self._without_view += 1
            return
        lit = result.contacts.colliding_faces
        shown = choose_faces(interval.x0[segment.faces[:, 0]], positions, lit, self._most_faces)
        texts = []
        self._some_strands += max(len(segment.free_edges), len(segment.points)) > self._most_faces
        if len(shown) == len(segment.faces) and self._faces and self._faces[0] is segment:
            vertices, number = np.arange(segment.vertex_count), self._faces[1]
        else:
            elements = [segment.faces[shown]]
            if segment.has_strands:
                elements += [own[spread(len(own), self._most_faces)] for own in (segment.free_edges, segment.points)]
            vertices, corners = np.unique(np.concatenate([own.reshape(-1) for own in elements]), return_inverse=True)
            parts = np.split(corners, np.cumsum([own.size for own in elements])[:-1])
            number = interval.index
            arrays: dict[str, np.ndarray] = dict(zip(("faces", "edges", "points"), parts, strict=False))
            arrays["mesh_of_vertex"] = numbers[segment.locate_vertices(vertices)[0]]
            texts.append(block(f"faces-{number}", {}, arrays))
            if len(shown) == len(segment.faces) and len(vertices) == segment.vertex_count:
                self._faces = segment, number
        arrays = {
            "start": self._placed(interval.x0[vertices]),
            "end": self._placed(interval.x1[vertices]),
            "lit": np.searchsorted(shown, np.intersect1d(lit, shown)),
        }
        texts.append(block(f"view-{interval.index}", {"faces": number, "of": len(segment.faces)}, arrays))
        self._view_bytes += sum(map(len, texts))
        yield from texts

    def _placed(self, positions: np.ndarray) -> np.ndarray:
        """Returns positions relative to the page's center, in single precision."""
        assert self._center is not None  # since the first interval
        return (positions.astype(np.float64) - self._center).astype(np.float32)

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
        if self._some_strands:
            notes.append(f"{self._some_strands:,} views in 3D have only some of the curves or points, spread evenly.")
        if self._without_view:
            notes.append(f"{self._without_view:,} intervals have no view in 3D, as the page is full.")
        spans = [*summary.collision_spans, *summary.intersection_spans, *summary.proximity_spans]
        pairs = len({tuple(sorted(span.meshes)) for span in spans})
        if pairs > _MAX_PAIRS:
            notes.append(f"The page has {_MAX_PAIRS:,} of {pairs:,} pairs of meshes, those with the most collisions.")
        if ignored := summary.ignored:
            hits = sum(hits for _, hits in ignored)
            notes.append(f"{hits:,} collisions of {len(ignored):,} ignored pairs of meshes are left out.")
        return notes


def _data(summary: Summary) -> dict:
    """Returns the data of the whole replay that the page's script shows."""
    scene = summary.scene
    displayed = scene.display_names
    looked = bool(summary.intersections)
    intersecting = sum(not at.is_empty for at in summary.intersections)
    tiles = [
        (f"{summary.hits:,}", "collisions"),
        (f"{len(summary.colliding):,} of {len(summary.intervals):,}", "intervals with collisions"),
    ]
    if first := summary.first_contact:
        tiles.append((f"{first.time:.6g}", "time code of the first"))
    if looked:
        tiles.append((f"{intersecting:,} of {len(summary.intersections):,}", "times with intersections at rest"))
    if summary.clearance is not None:
        nearest = summary.nearest
        tiles.append((f"{nearest[0].distance:.4g}" if nearest else f"> {summary.clearance:g}", "smallest distance"))
    tiles += [
        (f"{len(scene.names):,}", "meshes" if len(scene.names) != 1 else "mesh"),
        (f"{scene.face_count:,}", "triangles"),
        ("yes" if summary.certified else "no", f"certified for {CERTIFIED_FOR}"),
    ]
    data = {
        "title": _title(scene),
        "subtitle": f"{scene.path}, time {scene.times[0]:g} to {scene.times[-1]:g}; method {summary.method} on "
        f"{summary.device}",
        "partial": "",
        "tiles": tiles,
        "intervals": [
            (
                interval.start,
                interval.end,
                interval.vertex_face_hits,
                interval.edge_edge_hits,
                *([interval.vertex_edge_hits + interval.vertex_vertex_hits] * scene.has_strands),
            )
            for interval in summary.intervals
        ],
        "rest": [(at.time, at.crossings, at.touches, sum(at.inside.values())) for at in summary.intersections],
        "near": [(at.time, at.pairs) for at in summary.proximities],
        "toi": summary.toi_counts,
        "pairs": _pairs_of_meshes(summary),
        "up_axis": scene.up_axis,
        "facts": [
            ("File", scene.path),
            *scene.comments,
            ("Up axis", scene.up_axis),
            ("Metres per unit", f"{scene.meters_per_unit:g}"),
            ("Time codes per second", f"{scene.time_codes_per_second:g}"),
            ("Vertices", f"{scene.vertex_count:,}"),
            *((f"Mesh {name}", displayed[name] or "no display name") for name in scene.names[:_MAX_ROWS]),
        ],
        "notes": [summary.motion, *scene.warnings],
        "validation": None,
    }
    if not summary.is_complete:
        data["partial"] = (
            f"Partial: {len(summary.intervals)} of {summary.interval_count} intervals were checked; {summary.stopped}."
        )
    if found := summary.validation:
        wrong = len(found.disagreements)
        text = (
            f"The exact checker decided {found.hits:,} collisions and {found.others:,} other pairs again: "
            f"{wrong:,} {'disagreement' if wrong == 1 else 'disagreements'}. Floating point had certified "
            f"{found.certified:,} of all {found.decided:,} pairs."
        )
        data["validation"] = {"text": text, "disagreements": found.disagreements[:_MAX_DISAGREEMENTS]}
    return data


def _pairs_of_meshes(summary: Summary) -> list[dict]:
    """Returns the pairs of meshes with collisions, intersections or proximities, and the spans of time of each kind.

    A pair has at most :data:`_MAX_ROWS` spans of each kind; the numbers ``more`` count the others.
    """
    hits = {tuple(sorted(meshes)): count for meshes, count in summary.mesh_pairs}
    spans: dict[tuple[str, ...], tuple[tuple[str, str], list, list, list]] = {}

    def spans_of(meshes: tuple[str, str]) -> tuple[tuple[str, str], list, list, list]:
        return spans.setdefault(tuple(sorted(meshes)), (meshes, [], [], []))

    for span in summary.collision_spans:
        spans_of(span.meshes)[1].append((span.since, span.until, span.hits))
    for span in summary.intersection_spans:
        inner = span.meshes[0] if span.inside else ""
        spans_of(span.meshes)[2].append((span.since, span.until, span.most, span.trend, inner))
    for span in summary.proximity_spans:
        spans_of(span.meshes)[3].append((span.since, span.until, span.distance))
    return [
        {
            "meshes": meshes,
            "hits": hits.get(key, 0),
            "spans": collisions[:_MAX_ROWS],
            "more": max(0, len(collisions) - _MAX_ROWS),
            "rest": at_rest[:_MAX_ROWS],
            "more_rest": max(0, len(at_rest) - _MAX_ROWS),
            "near": near[:_MAX_ROWS],
            "more_near": max(0, len(near) - _MAX_ROWS),
        }
        for key, (meshes, collisions, at_rest, near) in sorted(spans.items(), key=lambda item: -hits.get(item[0], 0))[
            :_MAX_PAIRS
        ]
    ]


def _choose_rows(pairs: ScenePairs, most: int) -> np.ndarray:
    """Returns the rows of the pairs in the page: all, or ``most``, spread evenly, with the first of each two meshes."""
    if len(pairs) <= most:
        return np.arange(len(pairs))
    firsts = np.unique(pairs.mesh_keys(), return_index=True)[1][:most]
    others = np.delete(np.arange(len(pairs)), firsts)
    return np.union1d(firsts, others[spread(len(others), most - len(firsts))])


def _title(scene):
    return f"Collisions in {Path(scene.path).name}"
