"""The collisions of one interval in terms of the scene: prims, their own elements, points in world space."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from .._sorted_keys import KeySet
from ..detection.arcs.rigid_motion import RigidMotion, points_on_arcs
from ..detection.detector import Collisions
from ..detection.mesh import CollisionMesh
from ..detection.run.settings import PairKind
from ..usd.interval import Interval, positions_of
from ..usd.selection import Selection
from .scene_intersections import SceneIntersections, pair_keys, tangled_vertices
from .scene_pairs import NO_PAIRS, VERTEX, ScenePairs, are_stiff, count_by_meshes, name_elements, split_rows, take_rows


@dataclass(frozen=True)
class SceneContacts(ScenePairs):
    """The pairs that collide in one interval, with positions and times: arrays with a row for each pair.

    Attributes:
        interval: The interval.
        toi: Times of impact, 0 at the start of the interval and 1 at its end, shape [n].
        time: The same as time codes, shape [n].
        normal: Unit normals, against the velocity of the first element relative to the second, shape [n, 3].
        counted: Whether each pair that the detector found is one of these, vertex-face before edge-edge, bool.
        ignored: Number of colliding pairs that are ignored, by the names of their two meshes, in the scene's order.
        separate: Whether the two meshes neither intersected nor touched at the start of the interval, shape [n]; for a
            mesh with itself, whether no two parts of it did. False where ``phase`` is -1. None if intersections were
            not checked.
        phase: Index in :data:`~warp_bsc.scene_replay.scene_pairs.PHASES`, shape [n]. The surface at an element consists
            of all faces with a vertex of it; for a curve, of all its edges with one. -1 for two curves, and for pairs
            with a point, which cannot cross at rest. None if intersections were not checked.
    """

    interval: Interval = field(repr=False)
    toi: np.ndarray
    time: np.ndarray
    normal: np.ndarray
    counted: np.ndarray = field(repr=False)
    ignored: dict[tuple[str, str], int]
    separate: np.ndarray | None = None
    phase: np.ndarray | None = None

    BY_PAIR: ClassVar[tuple[str, ...]] = (*ScenePairs.BY_PAIR, "toi", "time", "normal", "separate", "phase")

    @cached_property
    def colliding_faces(self) -> np.ndarray:
        """Faces of the segment that collide or have an edge that collides, ascending."""
        ends = self.vertices[self.vertices[:, :, 1] >= 0]
        return np.union1d(self.faces[self.faces >= 0], self.segment.faces_at_edges(np.unique(ends, axis=0)))

    def colliding_polygons(self) -> dict[int, np.ndarray]:
        """Returns the polygons that collide, or have an edge or a vertex that collides, ascending, by mesh."""
        around = self.segment.faces_around(self.vertices[self.elements == VERTEX][:, 0])
        meshes, polygons = self.segment.locate_faces(np.union1d(self.colliding_faces, around))
        return {int(mesh): np.unique(polygons[meshes == mesh]) for mesh in np.unique(meshes)}


def find_contacts(
    intervals: Sequence[Interval],
    mesh: CollisionMesh,
    collisions: Collisions,
    selection: Selection,
    arcs: RigidMotion | None = None,
) -> list[SceneContacts]:
    """Names the detected pairs of each interval that are checked by prims and elements.

    Excluded are pairs of meshes that never move, pairs that the selection excludes or ignores, pairs of a mesh with
    itself if only its transform moves it, and edges of one curve that are near along it, as thick curves always touch
    themselves there. Elements that are apart in a mesh that its transform moves stay apart; elements that touch, at
    T-junctions or in coplanar faces, would collide by rounding alone. (If a transform that has no turn at a constant
    rate turns by half a circle from one sample to the next, or scales by zero, the straight paths of the vertices meet
    although the mesh does not.)

    Args:
        intervals: Intervals of one segment; one, if that has curves or points, or if vertices move on arcs.
        mesh: The detector's mesh, made of that segment: of its meshes, or of its curves and points as well, with a copy
            of them for each interval.
        collisions: Collisions of that mesh, each copy of which moves as in its interval.
        selection: The pairs of meshes that are checked.
        arcs: The motion of the vertices on arcs; None if all move straight.
    """
    segment = intervals[0].segment
    if not len(collisions):
        nothing = {"toi": np.zeros(0), "time": np.zeros(0), "normal": np.zeros((0, 3)), "counted": np.zeros(0, bool)}
        return [SceneContacts(segment, **NO_PAIRS, **nothing, interval=at, ignored={}) for at in intervals]

    ends = mesh.edges[collisions.edge_edge].astype(np.int64)  # (n, 2 edges, 2 ends)
    apart = ~np.isin(collisions.edge_edge, mesh.free_edges).all(axis=1)
    if not apart.all():
        apart |= ~segment.are_neighbours(ends[:, 0], ends[:, 1])
    ends = ends[apart]
    vertices, faces = collisions.vertex_face.T.astype(np.int64)
    points, point_ends = collisions.vertex_edge[:, 0].astype(np.int64), mesh.edges[collisions.vertex_edge[:, 1]]
    both = collisions.vertex_vertex.astype(np.int64)
    tois, normal = ([getattr(collisions, f"{kind.label}_{what}") for kind in PairKind] for what in ("toi", "normal"))
    tois[1], normal[1] = tois[1][apart], normal[1][apart]
    x0, x1 = positions_of(intervals)

    def at_impact(corners: np.ndarray, times: np.ndarray) -> np.ndarray:
        if arcs is not None:
            return points_on_arcs(arcs, x0, x1, corners, times[:, None])
        times = times[:, None, None]
        return (1.0 - times) * x0[corners].astype(np.float64) + times * x1[corners].astype(np.float64)

    on_edge = np.concatenate([collisions.edge_edge_coordinates[apart, :1], collisions.vertex_edge_coordinates[:, :1]])
    edges = np.concatenate([at_impact(ends[:, 0], tois[1]), at_impact(point_ends, tois[2])])
    position = [
        np.einsum("ni,nij->nj", collisions.vertex_face_coordinates, at_impact(mesh.faces[faces], tois[0])),
        (1.0 - on_edge) * edges[:, 0] + on_edge * edges[:, 1],
        at_impact(both, tois[3]).mean(axis=1),
    ]
    copies = np.zeros(sum(map(len, tois)), dtype=np.int64)
    if len(intervals) > 1:
        copies = np.concatenate([vertices, ends[:, 0, 0]]) // segment.vertex_count
        vertices, ends, faces = vertices % segment.vertex_count, ends % segment.vertex_count, faces % len(segment.faces)
    named = name_elements(segment, vertices, faces, ends, (points, point_ends.astype(np.int64), both))
    arrays = {"toi": tois, "position": position, "normal": normal}
    arrays = named | {name: np.concatenate(parts) for name, parts in arrays.items()}
    first, second = named["meshes"].T
    stiff = (first == second) & np.array([part.moves and not part.deforms for part in segment.meshes])[first]
    if segment.welded and not len(mesh.free_edges) + len(mesh.points):  # elements may be of several meshes
        stiff = are_stiff(segment, vertices, named["meshes"][: len(vertices), 1], ends)
    parts = split_rows(arrays | {"stiff": stiff}, copies, len(intervals))
    return [_select(interval, part, selection) for interval, part in zip(intervals, parts, strict=True)]


def _select(interval: Interval, arrays: dict[str, np.ndarray], selection: Selection) -> SceneContacts:
    """Returns the contacts that are checked, given the arrays of all, and which are ``stiff``, of one stiff mesh."""
    segment, meshes = interval.segment, arrays["meshes"]
    moves = np.array([part.moves for part in segment.meshes])
    counted = moves[meshes].any(axis=1) & selection.counted_pairs(segment.meshes, meshes) & ~arrays.pop("stiff")
    ignored = counted & selection.ignored_pairs(segment.meshes, meshes)
    counted &= ~ignored
    arrays = arrays | {"time": interval.start + arrays["toi"] * (interval.end - interval.start)}
    return SceneContacts(
        segment,
        **take_rows(arrays, counted),
        interval=interval,
        counted=counted,
        ignored={names: number for names, (number,) in count_by_meshes(segment, meshes[ignored]).items()},
    )


def join_contacts(contacts: SceneContacts, others: SceneContacts) -> SceneContacts:
    """Returns the contacts of one interval followed by others of it; ``counted`` is that of the first ones."""
    names = *ScenePairs.BY_PAIR, "toi", "time", "normal"
    joined = {name: np.concatenate([getattr(contacts, name), getattr(others, name)]) for name in names}
    return replace(contacts, **joined, ignored=dict(Counter(contacts.ignored) + Counter(others.ignored)))


def compare_contacts(
    contacts: Sequence[SceneContacts], at_rest: Sequence[tuple[SceneIntersections, SceneIntersections]]
) -> list[SceneContacts]:
    """Returns the contacts of intervals of a segment with ``separate`` and ``phase``.

    Args:
        contacts: The contacts of each interval.
        at_rest: The intersections at its start and at its end.
    """
    segment, counts = contacts[0].segment, [len(one) for one in contacts]
    separate, phase = np.zeros(sum(counts), dtype=bool), np.full(sum(counts), -1)
    pairs = contacts[0]
    if len(contacts) > 1:
        joined = {name: np.concatenate([getattr(one, name) for one in contacts]) for name in ScenePairs.BY_PAIR}
        pairs = ScenePairs(segment, **joined)
    (rows,) = np.nonzero(_may_cross(pairs)) if len(pairs) else (np.zeros(0, dtype=np.int64),)
    if len(rows):
        times = list({id(found): found for both in at_rest for found in both}.values())
        number_of = {id(found): number for number, found in enumerate(times)}
        starts, ends = np.repeat([[number_of[id(found)] for found in both] for both in at_rest], counts, axis=0)[rows].T
        shift = len(segment.meshes) ** 2
        crossing = np.concatenate([found.mesh_keys() + number * shift for number, found in enumerate(times)])
        separate[rows] = ~KeySet(crossing).has(pairs.mesh_keys()[rows] + starts * shift)
        phase[rows] = 0
        firsts, others = pairs.vertices[rows, 0], pairs.vertices[rows, 1][:, [0, 1, 1]]
        seconds = np.where((pairs.kind[rows] == 0)[:, None], segment.faces[pairs.faces[rows, 1]], others)
        firsts = np.where(firsts < 0, firsts[:, :1], firsts)
        tangled = KeySet(tangled_vertices(times))
        for weight, numbers in ((2, starts), (1, ends)):
            rest = np.arange(len(rows))  # those that no pair of vertices has shown yet to cross; one often suffices
            for one, other in np.ndindex(2, 3):
                keys = pair_keys(segment, firsts[rest, one], seconds[rest, other])
                found = tangled.has(keys + numbers[rest] * segment.vertex_count**2)
                phase[rows[rest[found]]] += weight
                rest = rest[~found]
    parts = map(slice, np.cumsum([0, *counts]), np.cumsum(counts))
    return [replace(one, separate=separate[own], phase=phase[own]) for one, own in zip(contacts, parts, strict=False)]


def _may_cross(contacts: ScenePairs) -> np.ndarray:
    """Returns whether each pair is of a surface and a surface or curve, which can cross at rest, bool, shape [n]."""
    segment = contacts.segment
    if not segment.has_strands:
        return np.ones(len(contacts), dtype=bool)
    has_faces = np.array([mesh.faces.stop > mesh.faces.start for mesh in segment.meshes])
    of_point = (contacts.elements[:, 0] == VERTEX) & np.isin(contacts.vertices[:, 0, 0], segment.points)
    return has_faces[contacts.meshes].any(axis=1) & ~of_point
