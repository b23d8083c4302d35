"""The collisions of one interval in terms of the scene: prims, their own elements, points in world space."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from .._sorted_keys import search
from ..detection.arcs.rigid_motion import RigidMotion
from ..detection.detector import Collisions
from ..detection.mesh import CollisionMesh
from ..usd.interval import Interval
from ..usd.selection import Selection
from .scene_arcs import positions_at
from .scene_intersections import SceneIntersections
from .scene_pairs import EDGE, NO_PAIRS, VERTEX, ScenePairs, are_stiff_pairs, count_by_meshes, name_elements, take_rows


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
        ends = self.vertices[self.elements >= EDGE]
        return np.union1d(self.faces[self.faces >= 0], self.segment.faces_at_edges(np.unique(ends, axis=0)))

    def colliding_polygons(self) -> dict[int, np.ndarray]:
        """Returns the polygons that collide, or have an edge or a vertex that collides, ascending, by mesh."""
        around = self.segment.faces_around(self.vertices[self.elements == VERTEX][:, 0])
        meshes, polygons = self.segment.locate_faces(np.union1d(self.colliding_faces, around))
        return {int(mesh): np.unique(polygons[meshes == mesh]) for mesh in np.unique(meshes)}


def find_contacts(
    interval: Interval,
    mesh: CollisionMesh,
    collisions: Collisions,
    selection: Selection,
    arcs: RigidMotion | None = None,
) -> SceneContacts:
    """Names the detected pairs that are checked by prims and elements.

    Excluded are pairs of meshes that never move, pairs that the selection excludes or ignores, pairs of a mesh with
    itself if only its transform moves it, and edges of one curve that are near along it, as thick curves always touch
    themselves there. Elements that are apart in a mesh that its transform moves stay apart; elements that touch, at
    T-junctions or in coplanar faces, would collide by rounding alone. (If a transform that has no turn at a constant
    rate turns by half a circle from one sample to the next, or scales by zero, the straight paths of the vertices meet
    although the mesh does not.)

    Args:
        interval: The interval.
        mesh: The detector's mesh, made of the interval's segment: of its meshes, or of its curves and points as well.
        collisions: Collisions of that mesh in the interval.
        selection: The pairs of meshes that are checked.
        arcs: The motion of the vertices on arcs; None if all move straight.
    """
    segment = interval.segment
    if not len(collisions):
        return SceneContacts(
            segment,
            **NO_PAIRS,
            interval=interval,
            toi=np.zeros(0),
            time=np.zeros(0),
            normal=np.zeros((0, 3)),
            counted=np.zeros(0, dtype=bool),
            ignored={},
        )

    ends = mesh.edges[collisions.edge_edge].astype(np.int64)  # (n, 2 edges, 2 ends)
    apart = ~np.isin(collisions.edge_edge, mesh.free_edges).all(axis=1)
    if not apart.all():
        apart |= ~segment.are_neighbours(ends[:, 0], ends[:, 1])
    ends = ends[apart]
    vertices, faces = collisions.vertex_face.T.astype(np.int64)
    points, point_ends = collisions.vertex_edge[:, 0].astype(np.int64), mesh.edges[collisions.vertex_edge[:, 1]]
    both = collisions.vertex_vertex.astype(np.int64)
    named = name_elements(segment, vertices, faces, ends, (points, point_ends.astype(np.int64), both))
    tois = (
        collisions.vertex_face_toi,
        collisions.edge_edge_toi[apart],
        collisions.vertex_edge_toi,
        collisions.vertex_vertex_toi,
    )

    def at_impact(corners: np.ndarray, times: np.ndarray) -> np.ndarray:
        return positions_at(interval, arcs, corners, times)

    on_edge = np.concatenate([collisions.edge_edge_coordinates[apart, :1], collisions.vertex_edge_coordinates[:, :1]])
    edges = np.concatenate([at_impact(ends[:, 0], tois[1]), at_impact(point_ends, tois[2])])
    position = [
        np.einsum("ni,nij->nj", collisions.vertex_face_coordinates, at_impact(mesh.faces[faces], tois[0])),
        (1.0 - on_edge) * edges[:, 0] + on_edge * edges[:, 1],
        at_impact(both, tois[3]).mean(axis=1),
    ]
    normal = [
        collisions.vertex_face_normal,
        collisions.edge_edge_normal[apart],
        collisions.vertex_edge_normal,
        collisions.vertex_vertex_normal,
    ]
    arrays = {"toi": tois, "position": position, "normal": normal}
    arrays = named | {name: np.concatenate(parts) for name, parts in arrays.items()}
    if len(mesh.free_edges) + len(mesh.points):
        first, second = named["meshes"].T
        stiff = (first == second) & np.array([part.moves and not part.deforms for part in segment.meshes])[first]
    else:
        stiff = are_stiff_pairs(segment, vertices, named["meshes"][: len(vertices), 1], ends)
    return _select(interval, arrays, stiff, selection)


def _select(
    interval: Interval, arrays: dict[str, np.ndarray], stiff: np.ndarray, selection: Selection
) -> SceneContacts:
    """Returns the contacts that are checked, given the arrays of all, and which are of one stiff mesh."""
    segment, meshes = interval.segment, arrays["meshes"]
    moves = np.array([part.moves for part in segment.meshes])
    counted = moves[meshes].any(axis=1) & selection.counted_pairs(segment.meshes, meshes) & ~stiff
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
    ignored = {
        meshes: contacts.ignored.get(meshes, 0) + others.ignored.get(meshes, 0)
        for meshes in {**contacts.ignored, **others.ignored}
    }
    return replace(contacts, **joined, ignored=ignored)


def compare_contacts(contacts: SceneContacts, start: SceneIntersections, end: SceneIntersections) -> SceneContacts:
    """Returns contacts with ``separate`` and ``phase``, given the intersections at the interval's start and end."""
    separate, phase = np.zeros(len(contacts), dtype=bool), np.full(len(contacts), -1)
    segment = contacts.segment
    (rows,) = np.nonzero(_may_cross(contacts)) if len(contacts) else (np.zeros(0, dtype=np.int64),)
    if len(rows):
        separate[rows] = ~np.isin(contacts.mesh_keys()[rows], start.mesh_keys())
        phase[rows] = 0
        firsts, others = contacts.vertices[rows, 0], contacts.vertices[rows, 1][:, [0, 1, 1]]
        seconds = np.where((contacts.kind[rows] == 0)[:, None], segment.faces[contacts.faces[rows, 1]], others)
        firsts = np.where(firsts < 0, firsts[:, :1], firsts)
        for weight, intersections in ((2, start), (1, end)):
            if len(tangled := intersections.tangled_vertices):
                keys = intersections.pair_keys(firsts[:, :, None], seconds[:, None, :]).reshape(-1)
                found = np.minimum(search(tangled, keys), len(tangled) - 1)
                phase[rows] += weight * (tangled[found] == keys).reshape(-1, 6).any(axis=1)
    return replace(contacts, separate=separate, phase=phase)


def _may_cross(contacts: SceneContacts) -> np.ndarray:
    """Returns whether each pair is of a surface and a surface or curve, which can cross at rest, bool, shape [n]."""
    segment = contacts.segment
    if not segment.has_strands:
        return np.ones(len(contacts), dtype=bool)
    has_faces = np.array([mesh.faces.stop > mesh.faces.start for mesh in segment.meshes])
    of_point = (contacts.elements[:, 0] == VERTEX) & np.isin(contacts.vertices[:, 0, 0], segment.points)
    return has_faces[contacts.meshes].any(axis=1) & ~of_point
