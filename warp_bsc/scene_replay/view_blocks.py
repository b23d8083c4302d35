"""The blocks of a page's view in 3D: the triangles of each interval, and an outline of the others."""

from collections.abc import Iterator

import numpy as np

from ..usd.segment import Segment
from .html_page import block, spread
from .page_view import choose_faces, find_outline
from .results import IntervalResult

_ALL_FACES = 1_500_000  # in the views of all intervals together; divided by their number, the limit of an interval ...
_FEWEST_FACES, _MOST_FACES = 1_000, 150_000  # ... within these bounds
_ALL_OUTLINES, _FEWEST_OUTLINE, _MOST_OUTLINE = 200_000, 500, 20_000  # likewise, of the outlines
_BYTES = 16 << 20  # of all views together
_STEPS = 1 << 20  # positions are rounded to this part of the size of what is shown


class ViewBlocks:
    """The blocks of the views of a replay.

    Attributes:
        without_view: Number of intervals that have no view, as the views would be too large together.
        partial_strands: Number of views without all curves and points.
    """

    def __init__(self, interval_count: int):
        """Divides the limits among the intervals."""
        self._most_faces = int(np.clip(_ALL_FACES // interval_count, _FEWEST_FACES, _MOST_FACES))
        self._most_outline = int(np.clip(_ALL_OUTLINES // interval_count, _FEWEST_OUTLINE, _MOST_OUTLINE))
        self._bytes = 0
        self._faces: tuple[Segment, int] | None = None  # the segment whose faces are all in the page, and their block
        self._outline: tuple[Segment, int, np.ndarray] | None = None  # its segment, its block, and its vertices
        self.without_view = 0
        self.partial_strands = 0

    def of(
        self, result: IntervalResult, positions: np.ndarray, numbers: np.ndarray, center: np.ndarray
    ) -> Iterator[str]:
        """Yields the blocks of an interval: all of its triangles, or those around some positions, and an outline.

        Edges of curves, and points, are included, each up to the largest number of triangles.

        Args:
            result: The interval.
            positions: The positions, shape [n, 3].
            numbers: Numbers in the page of the segment's meshes.
            center: Origin of the page.
        """
        interval, segment = result.contacts.interval, result.contacts.segment
        if not len(segment.faces) and not segment.has_strands:
            return
        if self._bytes > _BYTES:
            self.without_view += 1
            return
        lit = result.contacts.colliding_faces
        shown = choose_faces(interval.x0[segment.faces[:, 0]], positions, lit, self._most_faces)
        texts = []
        self.partial_strands += max(len(segment.free_edges), len(segment.points)) > self._most_faces
        are_all = len(shown) == len(segment.faces)
        if are_all and self._faces and self._faces[0] is segment:
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
            if are_all and len(vertices) == segment.vertex_count:
                self._faces = segment, number
        facts: dict[str, float] = {"faces": number, "of": len(segment.faces)}
        at_ends = interval.x0 - center, interval.x1 - center
        facts["step"], arrays = moving_points(*(x[vertices] for x in at_ends))
        if not are_all:
            if self._outline is None or self._outline[0] is not segment:
                outline = find_outline(segment, interval.x0, self._most_outline)
                meshes = numbers[segment.locate_vertices(outline.vertices)[0]]
                of_outline = {"faces": outline.faces, "mesh_of_vertex": meshes}
                texts.append(block(f"outline-{interval.index}", {}, of_outline))
                self._outline = segment, interval.index, outline.vertices
            facts["outline"] = self._outline[1]
            facts["outline_step"], of_outline = moving_points(*(x[self._outline[2]] for x in at_ends))
            arrays |= {f"outline_{name}": array for name, array in of_outline.items()}
        arrays["lit"] = np.searchsorted(shown, np.intersect1d(lit, shown))
        texts.append(block(f"view-{interval.index}", facts, arrays))
        self._bytes += sum(map(len, texts))
        yield from texts


def moving_points(start: np.ndarray, end: np.ndarray) -> tuple[float, dict[str, np.ndarray]]:
    """Returns points at the start and the end of an interval as integers that compress well, and their unit.

    ``start`` has the differences from each point to the next, the first one from 0; ``end`` has those from the start.
    Both are columns x, y and z, rounded to a millionth of the size of all, one after the other. The page's script adds
    them up again.

    Args:
        start: Positions, shape [n, 3].
        end: The same at the end.
    """
    both = np.stack([start, end])
    size = float((both.max(axis=(0, 1)) - both.min(axis=(0, 1))).max()) if both.size else 0.0
    # A point far from the others must not exceed 32 bits.
    step = max(size / _STEPS, float(np.abs(both).max(initial=0.0)) / (1 << 28), float(np.finfo(np.float32).tiny))
    first, last = np.rint(both / step).astype(np.int64)
    columns = np.diff(first, axis=0, prepend=0), last - first
    # Small numbers of both signs become small numbers without one, whose first bytes are all 0.
    start, end = (np.where(part < 0, -2 * part - 1, 2 * part).T.reshape(-1) for part in columns)
    return step, {"start": start, "end": end}
