"""The intersections at one time of a scene: edges that meet faces, cut curves, and parts inside other meshes."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from .._sorted_keys import distinct
from ..detection.at_rest.containment import Containment
from ..detection.at_rest.intersections import Intersections
from ..detection.mesh import CollisionMesh
from ..usd.segment import Segment
from ..usd.selection import Selection
from .scene_pairs import (
    CROSSES,
    DIAGONAL,
    EDGE,
    FACE,
    INSIDE,
    KINDS,
    NO_PAIRS,
    TOUCHES,
    VERTEX,
    ScenePairs,
    count_by_meshes,
    split_rows,
    take_rows,
)

_EDGE_FACE = KINDS.index("edge-face")


class Cuts(NamedTuple):
    """The segments in which two triangles meet: together, the curves in which surfaces cut each other.

    Attributes:
        points: Their ends, in world space and the scene's unit of length, shape [m, 2, 3].
        meshes: The two meshes, indices in ``segment.meshes``, shape [m, 2].
        faces: The two triangles, faces of the segment, the smaller first, shape [m, 2].
    """

    points: np.ndarray
    meshes: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True)
class IntersectionSummary:
    """The intersections at one time of a scene, in numbers: edges that meet faces, and parts inside other meshes.

    Attributes:
        time: Time code.
        crossings: Number of edges that pass through faces: pairs of an edge and a face.
        touches: Number of edges that only touch faces.
        mesh_pairs: Both numbers by the names of the two meshes, in the scene's order; twice the same name for a mesh
            that intersects itself.
        inside: Number of connected parts of a mesh that are wholly inside another mesh, by the name of the inner mesh
            and that of the outer one.
        ignored: Number of edges that meet faces and are ignored, by the names of the two meshes, in the scene's order.
    """

    time: float
    crossings: int
    touches: int
    mesh_pairs: dict[tuple[str, str], tuple[int, int]]
    inside: dict[tuple[str, str], int]
    ignored: dict[tuple[str, str], int]

    @property
    def is_empty(self) -> bool:
        """Whether nothing intersects."""
        return not self.mesh_pairs and not self.inside


@dataclass(frozen=True)
class SceneIntersections(ScenePairs):
    """The intersections at one time of a scene.

    The first rows are the edges that meet faces: the first element is the edge, the second the face. The other rows are
    the connected parts of meshes that are wholly inside other meshes: the first element is a vertex of the part, which
    is also the position, the second a face of the outer mesh.

    Attributes:
        time: Time code.
        crosses: Whether an edge passes through the face, bool, shape [n]; edges that do not, touch it.
        x: Positions of all vertices at that time, shape [vertex_count, 3].
        ignored: Number of edges that meet faces and are ignored, by the names of the two meshes, in the scene's order.
    """

    time: float
    crosses: np.ndarray
    x: np.ndarray = field(repr=False)
    ignored: dict[tuple[str, str], int] = field(default_factory=dict)

    BY_PAIR: ClassVar[tuple[str, ...]] = (*ScenePairs.BY_PAIR, "crosses")

    @property
    def crossings(self) -> int:
        """Number of edges that pass through faces."""
        return int(self.crosses.sum())

    @property
    def touches(self) -> int:
        """Number of edges that only touch faces."""
        return self.edge_rows.stop - self.crossings

    @cached_property
    def edge_rows(self) -> slice:
        """The rows of the edges that meet faces."""
        return slice(0, int((self.kind == _EDGE_FACE).sum()))

    @property
    def phase(self) -> np.ndarray:
        """Index in :data:`~warp_bsc.scene_replay.scene_pairs.ALL_PHASES`, shape [n]."""
        return np.where(self.kind == _EDGE_FACE, np.where(self.crosses, CROSSES, TOUCHES), INSIDE)

    @property
    def inside_rows(self) -> slice:
        """The rows of the parts of meshes that are inside other meshes."""
        return slice(self.edge_rows.stop, len(self))

    @cached_property
    def summary(self) -> IntersectionSummary:
        """The numbers."""
        crosses = self.crosses[self.edge_rows]
        by_meshes = count_by_meshes(self.segment, self.meshes[self.edge_rows], np.stack([crosses, ~crosses], axis=1))
        edges, inside = {names: (a, b) for names, (a, b) in by_meshes.items()}, self.mesh_names(self.inside_rows)
        return IntersectionSummary(self.time, self.crossings, self.touches, edges, dict(Counter(inside)), self.ignored)

    @cached_property
    def of_curves(self) -> np.ndarray:
        """Rows of the edges of curves that pass through faces, ascending, shape [m]."""
        (rows,) = np.nonzero(self.crosses)
        if not len(rows) or not self.segment.has_strands:
            return rows[:0]
        of_faces, _ = self.segment.faces_of_edges(self.vertices[rows, 0])
        return np.delete(rows, of_faces)

    @cached_property
    def cuts(self) -> Cuts:
        """The segments in which triangles cut each other, computed in floating point from the exact pairs.

        If an edge of one triangle passes through another triangle, they meet in a segment. It ends where edges of one
        meet the other, or in a corner that they share.
        """
        segment = self.segment
        if not self.crossings:
            return Cuts(np.zeros((0, 2, 3)), np.zeros((0, 2), dtype=np.int64), np.zeros((0, 2), dtype=np.int64))
        rows, sides = segment.faces_of_edges(self.vertices[self.edge_rows, 0])
        faces = np.sort(np.stack([sides, self.faces[rows, 1]], axis=1), axis=1)
        first, second = faces.T
        of_pair = segment.faces[faces]
        shared = np.argwhere(of_pair[:, 0, :, None] == of_pair[:, 1, None, :])
        corners = of_pair[shared[:, 0], 0, shared[:, 1]]
        points = np.concatenate([self.position[rows], self.x[corners].astype(np.float64)])
        keys = first.astype(np.int64) * len(segment.faces) + second
        crossed = distinct(keys[self.crosses[rows]])
        keys = np.concatenate([keys, keys[shared[:, 0]]])
        kept = np.isin(keys, crossed)
        ends = _farthest(keys[kept], points[kept])
        lasting = (ends[:, 0] != ends[:, 1]).any(axis=1)
        faces = np.stack(np.divmod(crossed, len(segment.faces)), axis=1)[lasting]
        return Cuts(ends[lasting], segment.locate_faces(faces)[0], faces)


def tangled_vertices(times: Sequence[SceneIntersections]) -> np.ndarray:
    """Returns the pairs of a vertex of an element and a vertex of a face that cross at some times of a segment.

    They are given by their :func:`pair_keys`, plus the squared number of vertices for each time before.
    Elements are faces, and edges of curves.
    """
    segment = times[0].segment
    number = np.repeat(np.arange(len(times)), [at.crossings for at in times])
    ends = np.concatenate([at.vertices[at.crosses, 0] for at in times])
    faces = np.concatenate([at.faces[at.crosses, 1] for at in times])
    rows, sides = segment.faces_of_edges(ends)
    keys = [(number[rows], segment.faces[sides], segment.faces[faces[rows]])]
    for i, at in enumerate(times):
        if len(at.of_curves):
            of_curves = at.vertices[at.of_curves, 0][:, [0, 1, 1]]
            keys.append((np.full(len(of_curves), i), of_curves, segment.faces[at.faces[at.of_curves, 1]]))
    number, first, second = (np.concatenate(arrays) for arrays in zip(*keys, strict=True))
    offsets = number[:, None, None] * segment.vertex_count**2
    return (pair_keys(segment, first[:, :, None], second[:, None, :]) + offsets).reshape(-1)


def pair_keys(segment: Segment, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Returns a number for each pair of vertices, given in two arrays, the same for both orders."""
    first, second = first.astype(np.int64), second.astype(np.int64)
    return np.minimum(first, second) * segment.vertex_count + np.maximum(first, second)


def name_intersections(
    segment: Segment,
    mesh: CollisionMesh,
    moments: Sequence[tuple[float, np.ndarray, Intersections, Containment]],
    selection: Selection,
) -> list[SceneIntersections]:
    """Names the intersections of some times that are checked by prims and elements.

    Excluded are edges and faces that the selection excludes or ignores, and those of a mesh with itself if only its
    transform moves it: where its parts touch, rounding of its positions would make them cross. Meshes that never move
    are checked.

    Args:
        segment: The segment.
        mesh: The detector's mesh, made of the segment.
        moments: Each time code, the positions of the segment's vertices there, shape [vertex_count, 3], the
            intersections of the mesh, and the parts inside other meshes, of the pairs that are checked.
        selection: The pairs of meshes that are checked.
    """
    if not any(len(found.pairs) + len(inside.bodies) for _, _, found, inside in moments):
        return [SceneIntersections(segment, **NO_PAIRS, time=t, crosses=at.crosses, x=x) for t, x, at, _ in moments]
    copies = np.repeat(np.arange(len(moments)), [len(found.pairs) for _, _, found, _ in moments])
    pairs = np.concatenate([found.pairs for _, _, found, _ in moments]).astype(np.int64)
    ends, faces = mesh.edges[pairs[:, 0]].astype(np.int64), pairs[:, 1]
    edge_meshes, points, diagonal = segment.locate_edges(ends)
    face_meshes, polygons = segment.locate_faces(faces)
    meshes = np.stack([edge_meshes, face_meshes], axis=1)
    counted = selection.counted_pairs(segment.meshes, meshes) & ~segment.are_stiff(ends, face_meshes)
    nowhere, shift = np.full_like(faces, -1), segment.vertex_count * copies[:, None]
    xs = np.concatenate([x for _, x, _, _ in moments]) if len(moments) > 1 else moments[0][1]
    arrays = {
        "kind": np.full(len(faces), _EDGE_FACE),
        "elements": np.stack([np.where(diagonal, DIAGONAL, EDGE), np.full(len(faces), FACE)], axis=1),
        "meshes": meshes,
        "indices": np.stack([points, np.stack([polygons, nowhere], axis=1)], axis=1),
        "vertices": np.stack([ends, np.full_like(ends, -1)], axis=1),
        "faces": np.stack([nowhere, faces], axis=1),
        "position": _meeting_points(*(xs[own + shift].astype(np.float64) for own in (ends, mesh.faces[faces]))),
        "crosses": np.concatenate([found.crosses for _, _, found, _ in moments]),
        "ignored": counted & selection.ignored_pairs(segment.meshes, meshes),
        "counted": counted,
    }
    named = []
    for (time, x, _, inside), part in zip(moments, split_rows(arrays, copies, len(moments)), strict=True):
        ignored, counted = part.pop("ignored"), part.pop("counted")
        of_ignored = {names: n for names, (n,) in count_by_meshes(segment, part["meshes"][ignored]).items()}
        rows = take_rows(part, counted & ~ignored)
        if len(inside.bodies):
            of_inside = _name_inside(segment, inside, x)
            rows = {name: np.concatenate([array, of_inside[name]]) for name, array in rows.items()}
        named.append(SceneIntersections(segment, **rows, time=time, x=x, ignored=of_ignored))
    return named


def _name_inside(segment: Segment, inside: Containment, x: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the arrays of :class:`SceneIntersections` for parts inside other meshes."""
    count = len(inside.bodies)
    nothing = np.full(count, -1)
    points = segment.find_points(inside.bodies[:, 0], inside.vertices)
    _, polygons = segment.locate_faces(inside.faces)
    return {
        "kind": np.full(count, KINDS.index("vertex-face")),
        "elements": np.tile([VERTEX, FACE], (count, 1)),
        "meshes": inside.bodies,
        "indices": np.stack([points, nothing, polygons, nothing], axis=1).reshape(-1, 2, 2),
        "vertices": np.stack([inside.vertices, nothing, nothing, nothing], axis=1).reshape(-1, 2, 2),
        "faces": np.stack([nothing, inside.faces], axis=1),
        "position": x[inside.vertices].astype(np.float64),
        "crosses": np.zeros(count, dtype=bool),
    }


def _meeting_points(edges: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Returns the points, shape [n, 3], in which edges, shape [n, 2, 3], meet faces, shape [n, 3, 3].

    For an edge in the plane of its face, that is the middle of its part in the face.
    """
    (p, q), (a, b, c) = edges.transpose(1, 0, 2), faces.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)

    def dot(x, y):
        return np.einsum("ni,ni->n", x, y)

    side_p, side_q = dot(p - a, normal), dot(q - a, normal)
    low, high = np.zeros(len(p)), np.ones(len(p))
    for x, y in ((a, b), (b, c), (c, a)):
        inward = np.cross(normal, y - x)
        at_p, at_q = dot(p - x, inward), dot(q - x, inward)
        with np.errstate(divide="ignore", invalid="ignore"):
            passes = at_p / (at_p - at_q)
        low = np.where(at_p < at_q, np.fmax(low, passes), low)
        high = np.where(at_p > at_q, np.fmin(high, passes), high)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(side_p != side_q, side_p / (side_p - side_q), 0.5 * (low + high))
    share = np.clip(np.nan_to_num(share, nan=0.5), 0.0, 1.0)[:, None]
    return (1.0 - share) * p + share * q


def _farthest(keys: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Returns two distant points of each key, ascending, shape [m, 2, 3]; both points of a key that has two."""
    order = np.argsort(keys, kind="stable")
    keys, points = keys[order], points[order]
    _, starts, numbers = np.unique(keys, return_index=True, return_inverse=True)
    ends = [points[starts]]
    for _ in range(2):  # from any point to the farthest, and from there to the farthest
        distance = np.square(points - ends[-1][numbers]).sum(axis=1)
        last = np.append(starts[1:], len(keys))[: len(starts)] - 1
        ends.append(points[np.lexsort((distance, numbers))[last]])
    return np.stack(ends[1:], axis=1)
