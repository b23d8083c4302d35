"""Names the collisions of one interval in terms of the scene: prims, their own elements, points in world space."""

from dataclasses import dataclass, field

import numpy as np

from ..detection.detector import Collisions
from ..detection.mesh import CollisionMesh
from ..usd.interval import Interval
from ..usd.selection import Selection

__all__ = ["DIAGONAL", "EDGE", "FACE", "KINDS", "VERTEX", "SceneContacts", "find_contacts"]

KINDS = ("vertex-face", "edge-edge")
"""Labels of the kinds of contact, by their numbers."""

VERTEX, FACE, EDGE, DIAGONAL = range(4)
"""The kinds of element. A diagonal is an edge between two triangles of one polygon, which the prim does not have."""

_CHUNK = 4096
_WORDS = ("vertex", "face", "edge", "diagonal")


@dataclass(frozen=True)
class SceneContacts:
    """The pairs that collide in one interval, where and when: arrays with a row for each pair.

    Attributes:
        interval: The interval.
        kind: Index in :data:`KINDS`, shape [n].
        elements: Kinds of the two elements: :data:`VERTEX`, :data:`FACE`, :data:`EDGE` or :data:`DIAGONAL`, shape
            [n, 2].
        meshes: The two meshes, indices in ``interval.segment.meshes``, shape [n, 2].
        indices: Indices of the two elements in their prims, shape [n, 2, 2]: the point and -1 for a vertex, the polygon
            and -1 for a face, the points at both ends for an edge or a diagonal.
        vertices: Vertices of the segment at the two elements, shape [n, 2, 2]: the vertex and -1 for a vertex, both
            ends for an edge or a diagonal, -1 twice for a face.
        faces: Face of the segment for a face, else -1, shape [n, 2].
        toi: Times of impact, 0 at the start of the interval and 1 at its end, shape [n].
        time: The same as time codes, shape [n].
        position: Points of contact, in world space and the scene's unit of length, shape [n, 3].
        normal: Unit normals, against the velocity of the first element relative to the second, shape [n, 3].
        counted: Which of the pairs that the detector found are among these, vertex-face before edge-edge, bool.
    """

    interval: Interval = field(repr=False)
    kind: np.ndarray
    elements: np.ndarray
    meshes: np.ndarray
    indices: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray
    toi: np.ndarray
    time: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    counted: np.ndarray = field(repr=False)

    def __len__(self) -> int:
        return len(self.kind)

    def chunks(self) -> list[slice]:
        """Returns all rows as slices of limited length: their text takes many times their memory."""
        return [slice(start, start + _CHUNK) for start in range(0, len(self), _CHUNK)]

    def mesh_names(self, rows: slice) -> list[tuple[str, str]]:
        """Returns the names of the two meshes of some pairs."""
        names = [mesh.name for mesh in self.interval.segment.meshes]
        return [(names[first], names[second]) for first, second in self.meshes[rows].tolist()]

    def element_names(self, rows: slice) -> list[tuple[str, str]]:
        """Returns the elements of some pairs: ``"vertex 12"``, ``"face 3"``, ``"edge 4-5"`` or ``"diagonal 0-2"``."""

        def name(element, indices):
            first, second = indices
            return f"{_WORDS[element]} {first}" if second < 0 else f"{_WORDS[element]} {first}-{second}"

        return [
            (name(first, first_indices), name(second, second_indices))
            for (first, second), (first_indices, second_indices) in zip(
                self.elements[rows].tolist(), self.indices[rows].tolist(), strict=True
            )
        ]

    @property
    def colliding_faces(self) -> np.ndarray:
        """Faces of the segment that collide or have an edge that collides, ascending."""
        ends = self.vertices[self.elements >= EDGE]
        return np.union1d(self.faces[self.faces >= 0], self.interval.segment.faces_at_edges(np.unique(ends, axis=0)))

    def colliding_polygons(self) -> dict[int, np.ndarray]:
        """Returns the polygons that collide, or have an edge or a vertex that collides, ascending, by mesh."""
        around = self.interval.segment.faces_around(self.vertices[self.elements == VERTEX][:, 0])
        meshes, polygons = self.interval.segment.locate_faces(np.union1d(self.colliding_faces, around))
        return {int(mesh): np.unique(polygons[meshes == mesh]) for mesh in np.unique(meshes)}


def find_contacts(
    interval: Interval, mesh: CollisionMesh, collisions: Collisions, selection: Selection
) -> SceneContacts:
    """Names the pairs that a detection found and that count.

    Excluded are pairs of meshes that never move, pairs that the selection excludes, and pairs of a mesh with itself if
    only its transform moves it. Elements that are apart in such a mesh stay apart, and elements that touch, at
    T-junctions or in coplanar faces, would collide by rounding alone. (If a transform turns by half a circle from one
    sample to the next, or scales by zero, the straight ways of the vertices meet although the mesh does not.)

    Args:
        interval: The interval.
        mesh: The detector's mesh, made of the interval's segment.
        collisions: Collisions of that mesh in the interval.
        selection: Which pairs of meshes count.
    """
    segment, x0, x1 = interval.segment, interval.x0, interval.x1
    vertices, faces = collisions.vertex_face.T.astype(np.int64)
    ends = mesh.edges[collisions.edge_edge].astype(np.int64)  # (n, 2 edges, 2 ends)
    n_vertex_face, n_edge_edge = len(vertices), len(ends)
    n = n_vertex_face + n_edge_edge

    kind = np.repeat([0, 1], [n_vertex_face, n_edge_edge])
    elements = np.where(kind[:, None] == 0, [VERTEX, FACE], [EDGE, EDGE])
    meshes = np.zeros((n, 2), dtype=np.int64)
    indices = np.full((n, 2, 2), -1, dtype=np.int64)
    all_vertices = np.full((n, 2, 2), -1, dtype=np.int64)
    all_faces = np.full((n, 2), -1, dtype=np.int64)

    rows = slice(0, n_vertex_face)
    meshes[rows, 0], indices[rows, 0, 0] = segment.locate_vertices(vertices)
    meshes[rows, 1], indices[rows, 1, 0] = segment.locate_faces(faces)
    all_vertices[rows, 0, 0], all_faces[rows, 1] = vertices, faces
    rows = slice(n_vertex_face, n)
    for side in range(2):
        meshes[rows, side], indices[rows, side], diagonal = segment.locate_edges(ends[:, side])
        elements[rows, side][diagonal] = DIAGONAL
    all_vertices[rows] = ends

    toi = np.concatenate([collisions.vertex_face_toi, collisions.edge_edge_toi])
    normal = np.concatenate([collisions.vertex_face_normal, collisions.edge_edge_normal])

    def at_impact(corners, times):
        times = times[:, None, None]
        return (1.0 - times) * x0[corners].astype(np.float64) + times * x1[corners].astype(np.float64)

    corners = at_impact(mesh.faces[faces], toi[:n_vertex_face])
    on_faces = np.einsum("ni,nij->nj", collisions.vertex_face_coordinates, corners)
    s = collisions.edge_edge_coordinates[:, :1]
    first = at_impact(ends[:, 0], toi[n_vertex_face:])
    position = np.concatenate([on_faces, (1.0 - s) * first[:, 0] + s * first[:, 1]])

    moves = np.array([part.moves for part in segment.meshes])
    counted = moves[meshes].any(axis=1) & selection.counted_pairs(segment.meshes, meshes)
    counted &= ~_are_stiff(segment, vertices, meshes[:n_vertex_face, 1], ends)
    arrays = {
        "kind": kind,
        "elements": elements,
        "meshes": meshes,
        "indices": indices,
        "vertices": all_vertices,
        "faces": all_faces,
        "toi": toi,
        "time": interval.start + toi * (interval.end - interval.start),
        "position": position,
        "normal": normal,
    }
    return SceneContacts(interval, **{name: array[counted] for name, array in arrays.items()}, counted=counted)


def _are_stiff(segment, vertices, face_meshes, ends) -> np.ndarray:
    """Returns which pairs are of a mesh with itself that only its transform moves: vertices and faces, then edges.

    Vertices and edges may be welded to those of other meshes: they belong to all of these.
    """
    are_stiff = np.zeros(len(vertices) + len(ends), dtype=bool)
    stiff = np.array([mesh.moves and not mesh.deforms for mesh in segment.meshes], dtype=bool)
    if not stiff.any():
        return are_stiff
    rows, meshes = segment.meshes_at_vertices(vertices)
    found = [rows[stiff[meshes] & (meshes == face_meshes[rows])]]
    keys = []
    for side in range(2):
        rows, meshes = segment.meshes_at_edges(ends[:, side])
        keys.append((rows * len(stiff) + meshes)[stiff[meshes]])
    found.append(len(vertices) + np.intersect1d(*keys) // len(stiff))
    are_stiff[np.concatenate(found)] = True
    return are_stiff
