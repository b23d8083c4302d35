"""The connected parts of bodies, which may share vertices."""

import numpy as np

from ..._sorted_keys import distinct, expand_ranges
from ..mesh import CollisionMesh
from .intersections import Intersections


class BodyParts:
    """The connected parts of bodies.

    A node is a vertex as one body has it: bodies may share vertices, but no part belongs to two bodies.

    Attributes:
        body: Body of each part, shape [part_count].
        closed: Whether an even number of its faces meet at each edge, shape [part_count].
        oriented: Whether its faces pass each edge as often in one direction as in the other, shape [part_count].
        of_face: Part of each face, then of each edge without faces, -1 for those that are left out, shape [n].
        first_vertex: The first vertex of each part, shape [part_count].
    """

    def __init__(self, mesh: CollisionMesh, bodies: np.ndarray):
        """Connects the faces and the edges without faces of each body; -1 leaves one out."""
        self._edges, count = mesh.edges, mesh.vertex_count
        is_taken = bodies >= 0
        faces, face_edges = mesh.cells[: len(bodies)][is_taken], mesh.cell_edges[: len(bodies)][is_taken]
        bodies = bodies[is_taken]
        # the nodes of a vertex that bodies share come after all vertices
        last_body = np.zeros(count, dtype=np.int64)
        last_body[faces] = bodies[:, None]
        is_shared = np.zeros(count, dtype=bool)
        is_shared[faces[last_body[faces] != bodies[:, None]]] = True
        nodes, self._node_vertices = _divide(faces, is_shared, bodies)
        edges, of_edges = _divide(face_edges, is_shared[mesh.edges[:, 0]] & is_shared[mesh.edges[:, 1]], bodies)

        roots = connect_cells(nodes, len(self._node_vertices))
        used = np.zeros(len(roots), dtype=bool)
        used[nodes] = True
        is_root = used & (roots == np.arange(len(roots)))
        part_count = int(is_root.sum())
        self._of_node = np.where(used, (np.cumsum(is_root) - 1)[roots], -1)
        self.of_face = np.full(len(is_taken), -1)
        self.of_face[is_taken] = of_face = self._of_node[nodes[:, 0]]
        self.body = np.zeros(part_count, dtype=np.int64)
        self.body[of_face] = bodies
        vertices, shared = np.arange(count), self._node_vertices[count:]
        first, last = np.searchsorted(shared, vertices), np.searchsorted(shared, vertices, side="right")
        self._first_node = np.where(is_shared, count + first, vertices)
        self._last_node = np.where(is_shared, count + last, vertices + 1)
        (nodes_used,) = np.nonzero(used)
        order = nodes_used[np.argsort(self._of_node[nodes_used], kind="stable")]
        self._ordered_vertices = self._node_vertices[order]
        self._starts = np.searchsorted(self._of_node[order], np.arange(part_count))
        self.first_vertex = self._ordered_vertices[self._starts]

        proper = edges >= 0  # others are between corners in one vertex
        of_side = np.broadcast_to(of_face[:, None], edges.shape)[proper]
        forward = faces == mesh.edges[face_edges, 0]
        counts = np.bincount(edges[proper], minlength=len(of_edges))
        sums = np.bincount(edges[proper], np.where(forward[proper], 1, -1), len(of_edges))
        self.closed = np.bincount(of_side, counts[edges[proper]] % 2, part_count) == 0
        self.closed &= np.bincount(of_side, minlength=part_count) > 0
        self.oriented = np.bincount(of_side, sums[edges[proper]] != 0, part_count) == 0

    def boxes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns lowest and highest corners of the parts' bounding boxes, float64, each of shape [part_count, 3]."""
        columns = [np.ascontiguousarray(column) for column in x[self._ordered_vertices].T]
        low, high = (
            np.stack([bound.reduceat(column, self._starts) for column in columns], axis=1).astype(np.float64)
            for bound in (np.minimum, np.maximum)
        )
        return low, high

    def meeting(self, found: Intersections) -> tuple[np.ndarray, np.ndarray]:
        """Returns keys of the pairs of parts that meet, and of the pairs in which an edge passes through a face.

        The part of the edge comes first in each key; parts that share vertices are among those that meet, in both
        orders.

        Args:
            found: The intersections.
        """
        rows, of_edge = self._parts_at_edges(self._edges[found.pairs[:, 0]].astype(np.int64))
        keys = pair_keys(np.stack([of_edge, self.of_face[found.pairs[rows, 1]]], axis=1), len(self.body))
        first_shared = len(self._first_node)  # nodes of the vertices that bodies share, sorted by vertex
        _, firsts, counts = np.unique(self._node_vertices[first_shared:], return_index=True, return_counts=True)
        of_node = self._of_node[first_shared:]
        one, other = expand_ranges(np.repeat(firsts, counts), np.repeat(firsts + counts, counts))
        sharing = pair_keys(np.stack([of_node[one], of_node[other]], axis=1), len(self.body))
        return distinct(np.concatenate([keys, sharing])), distinct(keys[found.crosses[rows]])

    def touching_edges(self, found: Intersections) -> tuple[np.ndarray, np.ndarray]:
        """Returns all edges of parts that meet faces of bodies, or have a vertex of them.

        The rest of a part, without its edges that touch a body, is on one side of that body, and has a vertex of one of
        these edges unless it is the whole part.

        Args:
            found: The intersections.

        Returns:
            Keys of the part and the body, ascending, shape [n], and the vertices of the edge, shape [n, 2].
        """
        rows, of_edge = self._parts_at_edges(self._edges[found.pairs[:, 0]].astype(np.int64))
        touching = [(of_edge, self.body[self.of_face[found.pairs[rows, 1]]], self._edges[found.pairs[rows, 0]])]
        (shared,) = np.nonzero((self._last_node - self._first_node > 1)[self._edges].any(axis=1))
        ends = self._edges[shared]
        rows, of_edge = self._parts_at_edges(ends.astype(np.int64))
        for end in range(2):
            places, others = self._parts_at(ends[rows, end])
            touching.append((of_edge[places], self.body[others], ends[rows[places]]))
        part, body, ends = (np.concatenate(arrays) for arrays in zip(*touching, strict=True))
        keys = pair_keys(np.stack([part, body], axis=1), int(self.body.max()) + 1)
        order = np.argsort(keys, kind="stable")
        return keys[order], ends[order].astype(np.int64)

    def _parts_at(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns all parts that have each vertex: rows of the argument, and the parts."""
        rows, nodes = expand_ranges(self._first_node[vertices], self._last_node[vertices])
        return rows, self._of_node[nodes]

    def _parts_at_edges(self, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns all parts that have both vertices of each edge: rows of the argument, and the parts."""
        rows, first = self._parts_at(ends[:, 0])
        other_rows, other = self._parts_at(ends[:, 1])
        count = len(self.body)
        both = np.intersect1d(rows * count + first, other_rows * count + other, assume_unique=True)
        return both // count, both % count


def _divide(elements: np.ndarray, is_shared: np.ndarray, bodies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the elements of each face, -1 for none, with a number for each body that shares them.

    Those shared, of m elements, have numbers from m on, sorted by element, then by body; also returned is the element
    of each number.
    """
    divided = elements.astype(np.int64)
    places = is_shared[elements] & (elements >= 0)
    body_count = int(bodies.max(initial=-1)) + 1
    keys = divided[places] * body_count + np.broadcast_to(bodies[:, None], divided.shape)[places]
    unique, numbers = np.unique(keys, return_inverse=True)
    divided[places] = len(is_shared) + numbers
    return divided, np.concatenate([np.arange(len(is_shared)), unique // max(1, body_count)])


def connect_cells(nodes: np.ndarray, count: int) -> np.ndarray:
    """Returns for each node the first one of those that cells connect with it, shape [count].

    Args:
        nodes: Nodes of each cell, int, shape [n, k].
        count: Number of nodes.
    """
    roots, nodes = np.arange(count), np.ascontiguousarray(nodes.T)  # faster to reduce
    while nodes.size:
        of_cells = roots[nodes]
        nodes = nodes[:, (of_cells != of_cells[0]).any(axis=0)]  # cells with one root keep that
        of_cells = roots[nodes]
        for row in of_cells:
            np.minimum.at(roots, row, of_cells.min(axis=0))
        while not np.array_equal(roots, roots[roots]):
            roots = roots[roots]
    return roots


def pair_keys(pairs: np.ndarray, count: int) -> np.ndarray:
    """Returns a number for each pair of numbers below ``count``, shape [n]."""
    return pairs[:, 0] * count + pairs[:, 1]
