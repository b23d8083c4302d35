"""The collisions of one interval as the artist knows them: prims, their own elements, places in world space."""

from dataclasses import dataclass, field

import numpy as np

from .segment import Segment

__all__ = ["EDGE", "FACE", "KINDS", "VERTEX", "Contacts", "find_contacts"]

KINDS = ("vertex-face", "edge-edge")
"""The kinds of contact, by their numbers."""

VERTEX, FACE, EDGE = range(3)
"""The kinds of element."""


@dataclass(frozen=True)
class Contacts:
    """What meets in one interval, where and when: arrays with a row for each pair.

    Attributes:
        segment: The meshes.
        kind: Index in :data:`KINDS`, shape [n].
        elements: What the two are: :data:`VERTEX`, :data:`FACE` or :data:`EDGE`, shape [n, 2].
        meshes: The two meshes, indices in ``segment.meshes``, shape [n, 2].
        indices: The numbers of the two elements in their prims, shape [n, 2, 2]: the point and -1 for a vertex, the
            polygon and -1 for a face, the points at both ends for an edge.
        lit: Vertices of the segment for a vertex, and a face of it for faces and edges, shape [n, 2].
        ends: The vertices of the segment at both ends for an edge, else -1, shape [n, 2, 2].
        toi: Times of impact, 0 at the start of the interval and 1 at its end, shape [n].
        time: The same as time codes, shape [n].
        position: Where they meet, in world space and the scene's unit of length, shape [n, 3].
        normal: Unit normals, against the velocity of the first relative to the second, shape [n, 3].
    """

    segment: Segment = field(repr=False)
    kind: np.ndarray
    elements: np.ndarray
    meshes: np.ndarray
    indices: np.ndarray
    lit: np.ndarray
    ends: np.ndarray
    toi: np.ndarray
    time: np.ndarray
    position: np.ndarray
    normal: np.ndarray

    def __len__(self):
        return len(self.kind)

    def names(self, row: int) -> tuple[str, str]:
        """Names of the two meshes."""
        first, second = (self.segment.meshes[mesh].name for mesh in self.meshes[row])
        return first, second

    def element_names(self, row: int) -> tuple[str, str]:
        """The two elements in words, such as ``"vertex 12"``, ``"face 3"``, ``"edge 4-5"`` or ``"diagonal 0-2"``.

        A diagonal is an edge of the triangles that a polygon is cut into, and no edge of the prim's.
        """
        first, second = (self._element_name(row, side) for side in range(2))
        return first, second

    def _element_name(self, row, side):
        first, second = self.indices[row, side]
        element = self.elements[row, side]
        if element == VERTEX:
            return f"vertex {first}"
        if element == FACE:
            return f"face {first}"
        inside = self.segment.cuts_polygon(self.lit[row, side], (first, second))
        return f"{'diagonal' if inside else 'edge'} {first}-{second}"

    def colliding_polygons(self) -> dict[int, np.ndarray]:
        """The polygons that collide, that have an edge that does, or a vertex: by the mesh, ascending."""
        segment = self.segment
        vertices = self.lit[self.elements == VERTEX]
        faces = np.concatenate(
            [
                self.lit[self.elements == FACE],
                segment.faces_around(vertices),
                segment.faces_at_edges(np.unique(self.ends[self.elements == EDGE], axis=0)),
            ]
        )
        meshes, polygons = segment.locate_faces(np.unique(faces))
        return {int(mesh): np.unique(polygons[meshes == mesh]) for mesh in np.unique(meshes)}


def find_contacts(segment, mesh, collisions, x0, x1, start, end, selection) -> Contacts:
    """Name what a detection found, of the pairs that count.

    Pairs of meshes that never move do not, nor do those that the selection leaves out.

    Args:
        segment: The meshes.
        mesh: Their :class:`~warp_bsc.mesh.CollisionMesh`.
        collisions: What the detector found.
        x0: Positions at the start, shape [vertex_count, 3].
        x1: Positions at the end, shape [vertex_count, 3].
        start: Time code of the start.
        end: Time code of the end.
        selection: Which pairs of meshes count.
    """
    vertices, faces = collisions.vertex_face.T.astype(np.int64)
    ends = mesh.edges[collisions.edge_edge].astype(np.int64)  # (n, 2 edges, 2 ends)
    n_vertex_face, n_edge_edge = len(vertices), len(ends)
    n = n_vertex_face + n_edge_edge

    kind = np.repeat([0, 1], [n_vertex_face, n_edge_edge])
    elements = np.where(kind[:, None] == 0, [VERTEX, FACE], [EDGE, EDGE])
    meshes = np.zeros((n, 2), dtype=np.int64)
    indices = np.full((n, 2, 2), -1, dtype=np.int64)
    lit = np.zeros((n, 2), dtype=np.int64)
    all_ends = np.full((n, 2, 2), -1, dtype=np.int64)

    rows = slice(0, n_vertex_face)
    meshes[rows, 0], indices[rows, 0, 0] = segment.locate_vertices(vertices)
    meshes[rows, 1], indices[rows, 1, 0] = segment.locate_faces(faces)
    lit[rows] = np.stack([vertices, faces], axis=1)
    rows = slice(n_vertex_face, n)
    for side in range(2):
        meshes[rows, side], indices[rows, side], lit[rows, side] = segment.locate_edges(ends[:, side])
    all_ends[rows] = ends

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
    counted = moves[meshes].any(axis=1) & selection.counted_pairs([part.path for part in segment.meshes], meshes)
    arrays = (kind, elements, meshes, indices, lit, all_ends, toi, start + toi * (end - start), position, normal)
    return Contacts(segment, *(array[counted] for array in arrays))
