"""The part of a surface around its contours, which is searched alone where the rest is far larger."""

import numpy as np

from ..detection.mesh import changed_mesh
from .contours import trace_contours
from .elastic import within
from .surface import Surface, differ

_REACH = 16.0
"""Distance from the box of a contour, in edges, up to which cells are of the part: few contours need more."""
_LEAST_CELLS, _LARGEST_SHARE, _MOST_CONTOURS = 20_000, 0.5, 64
"""Number of cells of a surface below which a part gains nothing, its share of them above which, and contours likewise.
"""


class Part(Surface):
    """A part of a surface. Vertices that it shares with the rest stay.

    Attributes:
        vertices: Its vertices in the whole, int, shape [k].
    """

    def __init__(self, whole: Surface, is_kept: np.ndarray, boxes: list[tuple[np.ndarray, np.ndarray]]):
        """Takes the cells of a whole that meet boxes, bool, shape [n]: see :attr:`.CollisionMesh.cells`."""
        mesh, count = whole.mesh, len(whole.home)
        is_used, is_shared = (np.zeros(count, dtype=bool) for _ in range(2))
        is_used[mesh.cells[is_kept]] = is_shared[mesh.cells[~is_kept]] = True
        self._boxes = boxes
        self.vertices, self._whole, self._shared = np.flatnonzero(is_used), whole, is_shared[is_used]
        cells = (np.cumsum(is_used) - 1)[mesh.cells]
        sizes = np.cumsum([len(mesh.faces), len(mesh.free_edges)])
        split = zip(np.split(cells, sizes), np.split(is_kept, sizes), strict=True)
        faces, edges, points = (own[kept] for own, kept in split)
        labels = {name: getattr(mesh, name) for name in ("world", "group", "mask")}
        changes = {name: None if values is None else values[is_used] for name, values in labels.items()}
        changes |= {"faces": faces, "edges": edges[:, :2], "points": points[:, 0]}
        mesh = changed_mesh(mesh, vertex_count=len(self.vertices), **changes)
        fixed = whole.fixed[is_used] | self._shared
        super().__init__(mesh, whole.positions(whole.home)[is_used], fixed, rigid=whole.rigid.of[is_used])
        self.end = whole.end

    @staticmethod
    def around(whole: Surface, crossings: np.ndarray) -> "Part | None":
        """Returns the part around crossings, (edge, face), shape [m, 2]; None where the whole is searched as well."""
        cells = whole.mesh.cells
        if not len(crossings) or whole.keeps_distance or len(whole.tetrahedra) or len(cells) < _LEAST_CELLS:
            return None
        contours, reach = trace_contours(whole.mesh, crossings), _REACH * whole.edge
        if len(contours.kinds) > _MOST_CONTOURS:
            return None
        a, b, c = (whole.home[corners] for corners in cells.T)
        low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        is_kept, boxes = np.zeros(len(cells), dtype=bool), []
        for number in range(len(contours.kinds)):
            of_contour = crossings[contours.number == number]
            vertices = np.append(whole.mesh.edges[of_contour[:, 0]], whole.mesh.faces[of_contour[:, 1]])
            places = whole.home[vertices]
            box = places.min(axis=0) - reach, places.max(axis=0) + reach
            is_kept |= ((high >= box[0]) & (low <= box[1])).all(axis=1)
            boxes.append(box)
        return None if is_kept.mean() > _LARGEST_SHARE else Part(whole, is_kept, boxes)

    def is_apart(self, x: np.ndarray) -> bool:
        """Returns whether what moves to positions in units is apart from the rest, in boxes no other cell meets."""
        moved = differ(x, self.home)
        places = self.in_whole(x)[self.vertices[moved]]
        inside = [((places >= low) & (places <= high)).all(axis=1) for low, high in self._boxes]
        return bool(np.any(inside, axis=0).all()) and not within(self, moved, 1)[self._shared].any()

    def in_whole(self, x: np.ndarray) -> np.ndarray:
        """Returns positions of the whole, in its units."""
        positions = self._whole.positions(self._whole.home)
        positions[self.vertices] = self.positions(x)
        return self._whole.in_units(positions)
