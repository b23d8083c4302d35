"""The collisions of one interval as the artist knows them: prims, their own elements, places in world space."""

from dataclasses import dataclass, field

import numpy as np

from ..detection.detector import Collisions
from ..detection.mesh import CollisionMesh
from ..usd.interval import Interval
from ..usd.selection import Selection

__all__ = ["DIAGONAL", "EDGE", "FACE", "KINDS", "VERTEX", "SceneContacts", "find_contacts"]

KINDS = ("vertex-face", "edge-edge")
"""The kinds of contact, by their numbers."""

VERTEX, FACE, EDGE, DIAGONAL = range(4)
"""The kinds of element; a diagonal is an edge of triangles that a polygon is cut into, and none of the prim's."""

_CHUNK = 4096
_WORDS = ("vertex", "face", "edge", "diagonal")


@dataclass(frozen=True)
class SceneContacts:
    """The pairs that collide in one interval, where and when: arrays with a row for each pair.

    Attributes:
        interval: The interval.
        kind: Index in :data:`KINDS`, shape [n].
        elements: What the two are: :data:`VERTEX`, :data:`FACE`, :data:`EDGE` or :data:`DIAGONAL`, shape [n, 2].
        meshes: The two meshes, indices in ``interval.segment.meshes``, shape [n, 2].
        indices: The numbers of the two elements in their prims, shape [n, 2, 2]: the point and -1 for a vertex, the
            polygon and -1 for a face, the points at both ends for the others.
        vertices: The vertices of the segment that the two have: one and -1 for a vertex, both ends for an edge, -1 for
            a face, shape [n, 2, 2].
        faces: The faces of the segment that the two are, else -1, shape [n, 2].
        toi: Times of impact, 0 at the start of the interval and 1 at its end, shape [n].
        time: The same as time codes, shape [n].
        position: Where they meet, in world space and the scene's unit of length, shape [n, 3].
        normal: Unit normals, against the velocity of the first relative to the second, shape [n, 3].
        counted: Which of the pairs that the detector found these are, vertex-face before edge-edge, booleans.
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

    def __len__(self):
        return len(self.kind)

    def chunks(self) -> list[slice]:
        """All rows, some at a time: text of them takes many times the room that they do."""
        return [slice(start, start + _CHUNK) for start in range(0, len(self), _CHUNK)]

    def mesh_names(self, rows: slice) -> list[tuple[str, str]]:
        """Names of the two meshes of some pairs."""
        names = [mesh.name for mesh in self.interval.segment.meshes]
        return [(names[first], names[second]) for first, second in self.meshes[rows].tolist()]

    def element_names(self, rows: slice) -> list[tuple[str, str]]:
        """The two elements of some pairs: ``"vertex 12"``, ``"face 3"``, ``"edge 4-5"`` or ``"diagonal 0-2"``."""

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
        """The faces of the segment that collide, or have an edge that does, ascending."""
        ends = self.vertices[self.elements >= EDGE]
        return np.union1d(self.faces[self.faces >= 0], self.interval.segment.faces_at_edges(np.unique(ends, axis=0)))

    def colliding_polygons(self) -> dict[int, np.ndarray]:
        """The polygons that collide, or have an edge or a vertex that does: by the mesh, ascending."""
        around = self.interval.segment.faces_around(self.vertices[self.elements == VERTEX][:, 0])
        meshes, polygons = self.interval.segment.locate_faces(np.union1d(self.colliding_faces, around))
        return {int(mesh): np.unique(polygons[meshes == mesh]) for mesh in np.unique(meshes)}


def find_contacts(
    interval: Interval, mesh: CollisionMesh, collisions: Collisions, selection: Selection
) -> SceneContacts:
    """Name what a detection found, of the pairs that count.

    Pairs of meshes that never move do not, nor do those that the selection leaves out, nor those of a mesh with itself
    that only its transform moves: whatever that does, what is apart in the mesh stays apart, and what touches there, at
    T-junctions or in coplanar faces, is taken to collide by nothing but rounding. (Where a transform turns by half a
    circle from one sample to the next, or scales by zero, the straight ways between do meet. The mesh does not.)

    Args:
        interval: The interval.
        mesh: Its meshes as the detector has them.
        collisions: What the detector found.
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
    arrays = (
        kind,
        elements,
        meshes,
        indices,
        all_vertices,
        all_faces,
        toi,
        interval.start + toi * (interval.end - interval.start),
        position,
        normal,
    )
    return SceneContacts(interval, *(array[counted] for array in arrays), counted)


def _are_stiff(segment, vertices, face_meshes, ends) -> np.ndarray:
    """Which pairs are of a mesh with itself that only its transform moves: vertices and faces, then edges.

    Vertices of it may be welded to others' and so may its edges: all meshes that they are of count.
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
