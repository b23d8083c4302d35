"""Writes a page that shows a repaired shot before and after, frame by frame, in one file that needs no network."""

from collections.abc import Callable, Iterable
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ..._atomic_file import OutputFile
from ...scene_replay.html_page import block, fill_page, inert, shared_part, spread
from ...scene_replay.page_view import choose_faces
from ...usd.scene import Scene
from ...usd.segment import Segment
from ...usd.write.points_layer import MovedFrame
from .findings import Finding, count_found
from .stretch import RepairedStretch, distortion

_ALL_FACES = 3_000_000  # about 25 MB, in the views of all frames together: divided by their number, the most of a frame
_FEWEST_FACES, _MOST_FACES = 2_000, 150_000  # within these bounds
_MOST_VIEWS = 1_500  # frames with a view
_STEPS = 1 << 16  # positions in the shot are rounded to this part of the size of what is shown
_MAX_ROWS = 200


def write_page(
    file: OutputFile,
    scene: Scene,
    *,
    stretches: Callable[[], Iterable[RepairedStretch]],
    before: list[Finding],
    after: list[Finding] | None,
    kept: dict[str, str],
    min_distance: float = 0.0,
    stopped: str = "",
) -> None:
    """Writes a page with a timeline, moved frames in 3D before and after, and the stretches, and moves it to its path.

    Args:
        file: The file.
        scene: The scene that was repaired.
        stretches: Returns its stretches with their frames, in order; called twice.
        before: What a replay has found in it.
        after: What a replay has found in the layer, None if that was not replayed.
        kept: Reasons of the meshes that are not moved, by name.
        min_distance: Distance that was to be kept, in the scene's unit of length.
        stopped: Why the repair was stopped, in words; empty if it was not.

    Raises:
        OSError: If the disk is full.
        ValueError: If the scene cannot be read again.
    """
    page = resources.files("warp_bsc.repairing.shot") / "page"
    shared = (shared_part(name) for name in ("blocks.js", "elements.js", "view3d.js"))
    head, between, end = fill_page(page / "page.html", [*shared, page / "repair.js"], _title(scene))
    file.write(head)
    summary = _Summary(scene, stretches())
    views = _Views(scene, summary)
    for number, moved in enumerate(frame for stretch in stretches() for frame in stretch.frames):
        if number in views.numbers:
            for text in views.of(moved, number):
                file.write(text)
    data = summary.data(before, after, kept, min_distance)
    data["partial"] = f"Partial: {stopped}. The layer has not been replayed." if stopped else ""
    data["notes"] += views.notes()
    for index, frame in enumerate(data["frames"]):
        frame["view"] = index if index in views.numbers else None
    file.write(between + inert(data) + end)
    file.commit()


class _Summary:
    """The numbers of a repair and its moved frames, with their segments, and which vertices of these are moved."""

    def __init__(self, scene: Scene, stretches: Iterable[RepairedStretch]):
        self._scene, self._stretches = scene, list(stretches)
        self.frames: list[dict[str, Any]] = []
        self.segments: list[Segment] = []
        self.segment_of: list[int] = []
        self.moved: list[np.ndarray] = []
        for stretch in self._stretches:
            distorted = stretch.distorted()
            for frame, move, ends in zip(stretch.frames, stretch.largest_moves, stretch.edge_ratios, strict=True):
                moved = len(frame.vertices)
                self.frames.append({"time": frame.time, "before": frame.before, "move": move, "moved": moved})
                self.frames[-1] |= {"edges": ends, "distortion": distortion(ends) if frame.time in distorted else 0.0}
                if not self.segments or frame.segment is not self.segments[-1]:
                    self.segments.append(frame.segment)
                    self.moved.append(np.zeros(frame.segment.vertex_count, dtype=bool))
                self.segment_of.append(len(self.segments) - 1)
                self.moved[-1][frame.vertices[frame.vertices < frame.segment.vertex_count]] = True

    def data(
        self, before: list[Finding], after: list[Finding] | None, kept: dict[str, str], min_distance: float
    ) -> dict[str, Any]:
        """Returns what the page's script shows beside the views; arguments are those of :func:`write_page`."""
        scene, stretches = self._scene, self._stretches
        unit = max((stretch.edge_length for stretch in stretches), default=1.0)
        largest = max((frame["move"] for frame in self.frames), default=0.0)
        moves = dict.fromkeys(scene.times, 0.0)
        for frame in self.frames:
            moves[frame["time"]] = max(moves[frame["time"]], frame["move"])
        uncertified = sum(len(stretch.uncertified) for stretch in stretches)
        left = {} if after is None else count_found(after, min_distance)
        found = count_found(before, min_distance).items()
        tiles = [(f"{left[what]:,}" if left else "?", f"{what}, of {number:,} before") for what, number in found]
        ratios = [stretch.edge_ratio for stretch in stretches]
        tiles += [
            (f"{len(moves.keys() & {frame['time'] for frame in self.frames}):,} of {len(moves):,}", "frames moved"),
            (f"{largest / unit:.3g}", "largest move, in edges"),
            (f"{max((high for _, high in ratios), default=1.0):.3g}", "longest edge against the scene"),
            (f"{min((low for low, _ in ratios), default=1.0):.3g}", "shortest edge against the scene"),
            (f"{sum(frame['distortion'] > 0 for frame in self.frames):,}", "frames that are not good"),
            ("yes" if not uncertified else f"all but {uncertified:,}", "moved frames certified"),
        ]
        return {
            "title": _title(scene),
            "subtitle": f"{scene.path}, time {scene.times[0]:g} to {scene.times[-1]:g}",
            "tiles": tiles,
            "edge_length": unit,
            "largest": largest or 1.0,
            "has_distance": min_distance > 0.0,
            "moves": [
                (time, following, moves[time])
                for time, following in pairwise([*scene.times, 2.0 * scene.times[-1] - scene.times[-2]])
            ],
            "before": _rows(scene, before),
            "after": None if after is None else _rows(scene, after),
            "frames": self.frames,
            "meshes": [{"name": name, "kept": name in kept} for name in scene.names],
            "up_axis": scene.up_axis,
            "stretches": [
                (
                    [f"{stretch.start:g} to {stretch.end:g}", "; ".join(stretch.reasons)],
                    f"{len(stretch.largest_moves):,}",
                    f"{stretch.moved:,}",
                    f"{stretch.largest_move / stretch.edge_length:.3f}",
                    f"{stretch.edge_ratio[0]:.2f} to {stretch.edge_ratio[1]:.2f}",
                )
                for stretch in stretches[:_MAX_ROWS]
            ],
            "facts": [
                ("File", scene.path),
                *scene.comments,
                ("Up axis", scene.up_axis),
                ("Metres per unit", f"{scene.meters_per_unit:g}"),
                ("Median edge length", f"{unit:g}"),
                ("Vertices", f"{scene.vertex_count:,}"),
                ("Triangles", f"{scene.face_count:,}"),
                *((f"Kept: {name}", reason) for name, reason in list(kept.items())[:_MAX_ROWS]),
                *(
                    (f"Not repaired: {a}", f"with {b}, which it crosses at first")
                    for a, b in before[0].unrepaired_pairs[:_MAX_ROWS]
                ),
            ],
            "notes": [
                "Moves are distances from the scene at the same time; edges are compared with the scene at the same "
                "time. A frame is not good if one is shorter than a third, or longer than twice.",
                *scene.warnings,
                *([f"{len(stretches) - _MAX_ROWS:,} stretches are not listed."] if len(stretches) > _MAX_ROWS else []),
            ],
        }


class _Views:
    """The blocks of the moved frames that have a view: triangles, positions in the shot, and displacements.

    These are all, or some, spread evenly, and the worst: the most distorted one, or the one with the largest move.
    """

    def __init__(self, scene: Scene, summary: _Summary):
        self._scene, self._summary = scene, summary
        count = len(summary.frames)
        self.numbers = set(spread(count, _MOST_VIEWS).tolist()) if count else set()
        if count > _MOST_VIEWS:
            worst = max(range(count), key=lambda n: (summary.frames[n]["distortion"], summary.frames[n]["move"]))
            self.numbers.add(worst)
        most = int(np.clip(_ALL_FACES // max(1, len(self.numbers)), _FEWEST_FACES, _MOST_FACES))
        self._faces = []  # by segment: all, or those around vertices that are moved at some time
        for segment, moved in zip(summary.segments, summary.moved, strict=True):
            x, lit = segment.start_positions, np.flatnonzero(moved[segment.faces].any(axis=1))
            self._faces.append(choose_faces(x[segment.faces[:, 0]], x[moved], lit, most))
        self._number = -1
        self._meshes = {name: number for number, name in enumerate(scene.names)}
        self._center: np.ndarray | None = None

    def of(self, moved: MovedFrame, number: int) -> list[str]:
        """Returns the blocks of a frame, with its number among all."""
        segment, before = moved.segment, self._number
        self._number = self._summary.segment_of[number]
        vertices, corners = np.unique(segment.faces[self._faces[self._number]], return_inverse=True)
        texts = []
        if self._number != before:
            names = [segment.meshes[mesh].name for mesh in segment.locate_vertices(vertices)[0]]
            meshes = np.array([self._meshes[name] for name in names], dtype=np.int64)
            texts.append(block(f"faces-{self._number}", {}, {"faces": corners, "mesh_of_vertex": meshes}))
        x = self._shot(moved)[vertices].astype(np.float64)
        if self._center is None:
            self._center = (x.min(axis=0) + x.max(axis=0)) / 2.0
        low = x.min(axis=0)
        step = max(float((x.max(axis=0) - low).max()) / (_STEPS - 1), np.finfo(np.float32).tiny)
        is_shown = np.isin(moved.vertices, vertices)
        rows = np.searchsorted(vertices, moved.vertices[is_shown])
        arrays = {"before": np.rint((x - low) / step).astype(np.int32), "moved": rows}
        arrays["displacement"] = moved.x[is_shown] - x[rows]
        facts = {"faces": self._number, "of": len(segment.faces), "low": (low - self._center).tolist(), "step": step}
        return [*texts, block(f"frame-{number}", facts, arrays)]

    def notes(self) -> list[str]:
        """Returns sentences on what the page omits."""
        notes = [f"Positions in the views are rounded to 1/{_STEPS:,} of the size of what is shown; moves are not."]
        count = len(self._summary.frames)
        if len(self.numbers) < count:
            notes.append(f"{len(self.numbers):,} of {count:,} moved frames have a view in 3D, spread evenly.")
        for segment, faces in zip(self._summary.segments, self._faces, strict=True):
            if len(faces) < len(segment.faces):
                shown = f"{len(faces):,} of {len(segment.faces):,}"
                notes.append(f"The views have the {shown} triangles around what is moved.")
        return list(dict.fromkeys(notes))

    def _shot(self, moved: MovedFrame) -> np.ndarray:
        """Returns the positions of the shot in a frame."""
        index = self._scene.times.index(moved.time)
        if moved.before or index == len(self._scene):
            return self._scene.interval(index - 1).x1
        return self._scene.interval(index).x0


def _rows(scene: Scene, findings: list[Finding]) -> list[tuple[float, float, int, int, int]]:
    """Returns for each interval its times, and the numbers of collisions, intersections and pairs too near."""
    rows = [
        (start, end, found.hits, found.crossings[0], found.near)
        for (start, end), found in zip(pairwise(scene.times), findings, strict=True)
    ]
    if findings[-1].crossings[1]:  # those at the end belong to the last bar
        start, end, hits, crossings, near = rows[-1]
        rows[-1] = start, end, hits, crossings + findings[-1].crossings[1], near
    return rows


def _title(scene: Scene) -> str:
    return f"Repair of {Path(scene.path).name}"
