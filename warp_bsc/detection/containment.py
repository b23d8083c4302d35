"""The parts of bodies that are wholly inside other bodies in one configuration, exactly."""

import functools
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from .. import checker
from .intersections import Intersections, vertices_on_faces
from .mesh import CollisionMesh

__all__ = ["Containment", "ContainmentFinder"]

_CHUNK = 1 << 20  # pairs in memory at a time


@dataclass(frozen=True, eq=False)
class Containment:
    """The connected parts of bodies that are wholly inside others: arrays with a row for each part and outer body.

    Attributes:
        bodies: The inner body and the outer one, sorted, int64, shape [n, 2].
        vertices: A vertex of the part that is strictly inside, shape [n].
        faces: A face of the outer body in sight of that vertex: the first along +x, shape [n].
    """

    bodies: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray


class ContainmentFinder:
    """Finds what is inside what, in one configuration after another, in meshes that consist of several bodies.

    A part of a body is what its faces and its edges without faces connect. A part is closed if an even number of its
    faces meet at each edge, and it has no other edges. Closed parts enclose what they wind around; where the faces of a
    part are not oriented alike, what a ray from it passes an odd number of times. All closed parts of a body count
    together, with their signs: what is in the cavity of a hollow body, whose inner surface is turned inwards, is not
    inside. Open parts enclose nothing.

    A part is wholly inside a body if it is inside at one of its vertices and its edges and faces pass through none of
    the body's. A part that touches the body is inside if none of its vertices is outside, and not all are on the body.

    No floating-point error can change the answer: signs that are not certain are computed exactly.
    """

    def __init__(self, mesh: CollisionMesh, bodies: np.ndarray):
        """Takes a mesh; finds its parts when they are needed first.

        Args:
            mesh: The mesh. Its faces turn counterclockwise seen from outside. Bodies may have vertices in common.
            bodies: Body of each face, then of each of ``mesh.free_edges``, integers from 0, shape [n].
        """
        self._mesh, self._bodies = mesh, bodies.astype(np.int64)

    def find(self, x: np.ndarray, found: Intersections, are_wanted: Callable[[np.ndarray], np.ndarray]) -> Containment:
        """Returns what is inside what in one configuration.

        Args:
            x: Positions, finite, any unit of length, shape [vertex_count, 3].
            found: The intersections of the mesh in this configuration.
            are_wanted: Returns which pairs of an inner and an outer body are looked for, given shape [m, 2].
        """
        none = Containment(np.zeros((0, 2), np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))
        if not len(self._bodies) or self._bodies.min() == self._bodies.max() or not self._parts.closed.any():
            return none
        parts = self._parts
        low, high = parts.boxes(x)
        (outer,) = np.nonzero(parts.closed)
        pairs = _enclosing(low, high, low[outer], high[outer], 3)
        pairs[:, 1] = outer[pairs[:, 1]]
        pairs = pairs[parts.body[pairs[:, 0]] != parts.body[pairs[:, 1]]]
        pairs = pairs[are_wanted(parts.body[pairs])]
        if not len(pairs):
            return none
        meeting, passing = parts.meeting(found)
        touching = _keys(pairs, len(low)), _keys(pairs[:, ::-1], len(low))
        is_touching = np.isin(touching[0], meeting) | np.isin(touching[1], meeting)
        # a part that passes through any part of a body is not inside it
        of_bodies = np.stack([passing // len(low), passing % len(low)], axis=1)
        of_bodies = np.concatenate([of_bodies, of_bodies[:, ::-1]])
        passing = of_bodies[:, 0] * len(low) + parts.body[of_bodies[:, 1]]
        kept = ~np.isin(pairs[:, 0] * len(low) + parts.body[pairs[:, 1]], passing)
        return self._decide(x, found, pairs[kept], is_touching[kept])

    @functools.cached_property
    def _parts(self) -> "_Parts":
        return _Parts(self._mesh, self._bodies)

    def _decide(self, x: np.ndarray, found: Intersections, pairs: np.ndarray, is_touching: np.ndarray) -> Containment:
        """Returns which parts are inside, given pairs of a part and a closed one that do not pass through each other.

        Args:
            x: As of :meth:`find`.
            found: As of :meth:`find`.
            pairs: Pairs of parts of which one's box is in the other's, shape [m, 2].
            is_touching: Whether they touch each other, shape [m].
        """
        parts = self._parts
        of_body = np.stack([pairs[:, 0], parts.body[pairs[:, 1]]], axis=1)
        cases, case_of_pair = np.unique(of_body, axis=0, return_inverse=True)
        case_of_pair = case_of_pair.reshape(-1)  # NumPy 2.0 shapes it otherwise
        touches = np.bincount(case_of_pair, is_touching, len(cases)) > 0
        case_of_query, vertices = self._choose_vertices(cases, touches, found)

        # the closed parts that each query is compared with, and their faces
        order = np.argsort(case_of_pair, kind="stable")
        counts = np.bincount(case_of_pair, minlength=len(cases))
        firsts = np.cumsum(counts) - counts
        rows, places = _expand(firsts[case_of_query], (firsts + counts)[case_of_query])
        compared = _keys(np.stack([rows, pairs[order[places], 1]], axis=1), len(parts.body))
        points = x[vertices].astype(np.float64)
        faces = self._faces_ahead(x, points, pairs[:, 1])
        corners = x[self._mesh.faces[faces]].astype(np.float64)
        low, high = corners.min(axis=1), corners.max(axis=1)

        def pair_up(box_low: np.ndarray, axes: int) -> np.ndarray:
            """Returns queries and faces of which the point is in the box, the first axes, of y, z and x, bounded."""
            turned = [1, 2, 0]
            found = _enclosing(points[:, turned], points[:, turned], box_low[:, turned], high[:, turned], axes)
            keys = found[:, 0] * len(parts.body) + parts.of_face[faces[found[:, 1]]]
            return found[np.isin(keys, compared)]

        on_surface = np.zeros(len(vertices), dtype=bool)
        if touches.any():
            met = pair_up(low, 3)
            met = met[touches[case_of_query[met[:, 0]]]]
            on_surface[met[vertices_on_faces(self._mesh, x, vertices[met[:, 0]], faces[met[:, 1]]), 0]] = True
        # rays along +x, of the others
        met = pair_up(np.where([True, False, False], -np.inf, low), 2)
        met = met[~on_surface[met[:, 0]]]
        signs = checker.rays_pass_faces(points[met[:, 0]], corners[met[:, 1]]).astype(np.int64)
        met, signs = met[signs != 0], signs[signs != 0]
        keys, pair_of_ray = np.unique(
            met[:, 0] * len(parts.body) + parts.of_face[faces[met[:, 1]]], return_inverse=True
        )
        turns = np.where(
            parts.oriented[keys % len(parts.body)],
            np.bincount(pair_of_ray, signs, len(keys)),
            np.bincount(pair_of_ray, minlength=len(keys)) % 2,
        )
        inside = np.bincount(keys // len(parts.body), turns, len(vertices)) != 0
        decided = ~on_surface
        yes = np.bincount(case_of_query, decided & inside, len(cases)) > 0
        no = np.bincount(case_of_query, decided & ~inside, len(cases)) > 0
        (kept,) = np.nonzero(yes & ~no)
        # the first query of each, and the face that its ray meets first
        (rows,) = np.nonzero(decided & inside)
        rows = rows[np.unique(case_of_query[rows], return_index=True)[1]]
        rows = rows[np.isin(case_of_query[rows], kept)]
        bodies = np.stack([parts.body[cases[kept, 0]], cases[kept, 1]], axis=1)
        distance = _distances_along_x(points[met[:, 0]], corners[met[:, 1]])
        nearest = met[np.lexsort((faces[met[:, 1]], distance, met[:, 0]))]
        first_faces = faces[nearest[np.searchsorted(nearest[:, 0], rows), 1]]
        order = np.lexsort((vertices[rows], bodies[:, 1], bodies[:, 0]))
        return Containment(bodies[order], vertices[rows[order]], first_faces[order])

    def _choose_vertices(
        self, cases: np.ndarray, touches: np.ndarray, found: Intersections
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns the vertices that decide whether parts are inside bodies.

        Args:
            cases: The parts and the bodies, sorted, shape [n, 2].
            touches: Whether they touch each other, shape [n]. If not, one vertex decides.
            found: The intersections.

        Returns:
            The case of each vertex, ascending, and the vertices, each of shape [m].
        """
        parts = self._parts
        chosen = [np.array([parts.first_vertex[part]]) for part in cases[:, 0]]
        if touches.any():
            of_edges, ends = parts.touching_edges(found)
            wanted = _keys(cases, int(parts.body.max()) + 1)
            first, last = np.searchsorted(of_edges, wanted), np.searchsorted(of_edges, wanted, side="right")
            for case in np.flatnonzero(touches & (last > first)):
                chosen[case] = np.unique(ends[first[case] : last[case]])
        case_of_vertex = np.repeat(np.arange(len(cases)), list(map(len, chosen)))
        return case_of_vertex, np.concatenate([np.zeros(0, np.int64), *chosen])

    def _faces_ahead(self, x: np.ndarray, points: np.ndarray, parts: np.ndarray) -> np.ndarray:
        """Returns the faces of some parts that are not on the same side of all rays from some points, ascending."""
        is_wanted = np.zeros(len(self._parts.body), dtype=bool)
        is_wanted[parts] = True
        low, high = points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)
        sides = np.zeros(len(x), dtype=np.uint8)
        for bit, is_aside in enumerate((x[:, 0] < low[0], *(x[:, 1:] < low[1:]).T, *(x[:, 1:] > high[1:]).T)):
            sides |= is_aside.astype(np.uint8) << bit
        a, b, c = (sides[corners] for corners in self._mesh.faces.T)
        return np.flatnonzero(is_wanted[self._parts.of_face[: len(a)]] & (a & b & c == 0))


class _Parts:
    """The connected parts of bodies.

    A node is a vertex as one body has it: bodies may share vertices, but no part belongs to two bodies.

    Attributes:
        body: Body of each part, shape [part_count].
        closed: Whether an even number of its faces meet at each edge, shape [part_count].
        oriented: Whether its faces pass each edge as often in one direction as in the other, shape [part_count].
        of_face: Part of each face, then of each edge without faces, shape [n].
        first_vertex: The first vertex of each part, shape [part_count].
    """

    def __init__(self, mesh: CollisionMesh, bodies: np.ndarray):
        """Connects the faces and the edges without faces of each body."""
        self._edges, count = mesh.edges, mesh.vertex_count
        faces, face_edges = mesh.cells[: len(bodies)], mesh.cell_edges[: len(bodies)]
        # the nodes of a vertex that bodies share come after all vertices
        last_body = np.zeros(count, dtype=np.int64)
        last_body[faces] = bodies[:, None]
        is_shared = np.zeros(count, dtype=bool)
        is_shared[faces[last_body[faces] != bodies[:, None]]] = True
        nodes, self._node_vertices = _divide(faces, is_shared, bodies)
        edges, of_edges = _divide(face_edges, is_shared[mesh.edges[:, 0]] & is_shared[mesh.edges[:, 1]], bodies)

        roots = _connect(nodes, len(self._node_vertices))
        used = np.zeros(len(roots), dtype=bool)
        used[nodes] = True
        is_root = used & (roots == np.arange(len(roots)))
        part_count = int(is_root.sum())
        self._of_node = np.where(used, (np.cumsum(is_root) - 1)[roots], -1)
        self.of_face = self._of_node[nodes[:, 0]]
        self.body = np.zeros(part_count, dtype=np.int64)
        self.body[self.of_face] = bodies
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
        of_side = np.broadcast_to(self.of_face[:, None], edges.shape)[proper]
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
        """Returns keys of the pairs of parts that meet, and of those of which an edge passes through a face.

        The part of the edge comes first in each key; parts that share vertices are among those that meet, in both
        orders.

        Args:
            found: The intersections.
        """
        rows, of_edge = self._parts_at_edges(self._edges[found.pairs[:, 0]].astype(np.int64))
        keys = _keys(np.stack([of_edge, self.of_face[found.pairs[rows, 1]]], axis=1), len(self.body))
        shared = self._node_vertices[self._sharing]
        _, firsts, counts = np.unique(shared, return_index=True, return_counts=True)
        of_node = self._of_node[self._sharing]
        ranges = np.repeat(firsts, counts), np.repeat(firsts + counts, counts)
        one, other = _expand(*ranges)
        sharing = _keys(np.stack([of_node[one], of_node[other]], axis=1), len(self.body))
        return np.union1d(keys, sharing), np.unique(keys[found.crosses[rows]])

    def touching_edges(self, found: Intersections) -> tuple[np.ndarray, np.ndarray]:
        """Returns all edges of parts that meet faces of bodies, or have a vertex of them.

        Whatever of a part is left without those of a body stays on one side of that body, and has a vertex of one of
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
        keys = _keys(np.stack([part, body], axis=1), int(self.body.max()) + 1)
        order = np.argsort(keys, kind="stable")
        return keys[order], ends[order].astype(np.int64)

    @property
    def _sharing(self) -> slice:
        """The nodes of the vertices that bodies share, sorted by vertex."""
        return slice(len(self._first_node), None)

    def _parts_at(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns all parts that have each vertex: rows of the argument, and the parts."""
        rows, nodes = _expand(self._first_node[vertices], self._last_node[vertices])
        return rows, self._of_node[nodes]

    def _parts_at_edges(self, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns all parts that have both vertices of each edge: rows of the argument, and the parts."""
        rows, first = self._parts_at(ends[:, 0])
        other_rows, other = self._parts_at(ends[:, 1])
        count = len(self.body)
        both = np.intersect1d(rows * count + first, other_rows * count + other)
        return both // count, both % count


def _divide(elements: np.ndarray, is_shared: np.ndarray, bodies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gives elements that bodies share a number for each body.

    Args:
        elements: Numbers of the elements of each face, -1 for none, shape [n, 3].
        is_shared: Which elements bodies may share, shape [m].
        bodies: Body of each face, shape [n].

    Returns:
        The elements of each face, those shared with new numbers from m on, shape [n, 3], and the element of each
        number, shape [k]. New numbers are sorted by element, then by body.
    """
    divided = elements.astype(np.int64)
    places = is_shared[elements] & (elements >= 0)
    body_count = int(bodies.max(initial=-1)) + 1
    keys = divided[places] * body_count + np.broadcast_to(bodies[:, None], divided.shape)[places]
    unique, numbers = np.unique(keys, return_inverse=True)
    divided[places] = len(is_shared) + numbers
    return divided, np.concatenate([np.arange(len(is_shared)), unique // max(1, body_count)])


def _connect(nodes: np.ndarray, count: int) -> np.ndarray:
    """Returns for each node the first one of those that cells connect with it, shape [count].

    Args:
        nodes: Nodes of each cell, shape [n, 3].
        count: Number of nodes.
    """
    roots = np.arange(count)
    while True:
        of_cells = roots[nodes]
        lowest = of_cells.min(axis=1)
        if (of_cells == lowest[:, None]).all():
            return roots
        for column in of_cells.T:
            np.minimum.at(roots, column, lowest)
        while not np.array_equal(roots, roots[roots]):
            roots = roots[roots]


def _enclosing(
    low: np.ndarray, high: np.ndarray, outer_low: np.ndarray, outer_high: np.ndarray, axes: int
) -> np.ndarray:
    """Returns the pairs of an inner box and an outer one that contains it, borders included.

    Outer boxes are grouped by size. For each group, boxes are put into a grid by their lowest corners; the cells are as
    large as the outer boxes, so that an outer box is in the cell of the inner box or in the one before along some axes.

    Args:
        low: Lowest corners of the inner boxes, shape [n, 3].
        high: Highest corners.
        outer_low: Lowest corners of the outer boxes, shape [m, 3].
        outer_high: Highest corners.
        axes: Number of axes, from the first one, along which the boxes are finite, and the grid has cells.

    Returns:
        Indices of the inner and the outer boxes, sorted, shape [k, 2].
    """
    found = [np.zeros((0, 2), dtype=np.int64)]
    near = np.zeros(0, dtype=np.int64)
    if len(low):
        (near,) = np.nonzero(((outer_low <= low.max(axis=0)) & (outer_high >= high.min(axis=0))).all(axis=1))
    if not len(near):
        return found[0]
    starts, outer_starts = 0.5 * low[:, :axes], 0.5 * outer_low[near, :axes]  # halves, so that nothing overflows
    sizes = (0.5 * outer_high[near, :axes] - outer_starts).max(axis=1)
    corner = np.minimum(starts.min(axis=0), outer_starts.min(axis=0))
    extent = np.maximum(starts.max(axis=0), outer_starts.max(axis=0)) - corner
    smallest = max(float(extent.max()) * 2.0**-20, float(np.finfo(np.float64).tiny))  # cells fit into 21 bits
    group = np.ceil(np.log2(np.maximum(sizes / smallest, 1.0)))
    weights = np.array([1 << 42, 1 << 21, 1])[:axes]
    for number in np.unique(group):
        cell = smallest * 2.0**number * (1.0 + 1e-6)  # cells are numbered with rounding
        (members,) = np.nonzero(group == number)
        keys = (np.floor((outer_starts[members] - corner) / cell).astype(np.int64) + 1) @ weights
        order = np.argsort(keys, kind="stable")
        keys, members = keys[order], near[members[order]]
        of_inner = (np.floor((starts - corner) / cell).astype(np.int64) + 1) @ weights
        for step in itertools.product((0, 1), repeat=axes):
            wanted = of_inner - np.array(step) @ weights
            first, last = np.searchsorted(keys, wanted), np.searchsorted(keys, wanted, side="right")
            for rows, places in _expand_in_chunks(first, last):
                inner, outer = rows, members[places]
                for axis in range(3):
                    kept = outer_low[outer, axis] <= low[inner, axis]
                    kept &= high[inner, axis] <= outer_high[outer, axis]
                    inner, outer = inner[kept], outer[kept]
                found.append(np.stack([inner, outer], axis=1))
    pairs = np.concatenate(found)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def _distances_along_x(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Returns how far points are from the planes of faces along x, in floating point, infinite where it overflows."""
    sides = faces - points[:, None]
    normal = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
    with np.errstate(all="ignore"):
        return np.nan_to_num((sides[:, 0] * normal).sum(axis=1) / normal[:, 0], nan=np.inf)


def _expand(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the range that each place of some ranges is in, and all these places."""
    counts = last - first
    rows = np.repeat(np.arange(len(counts)), counts)
    return rows, np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts - first, counts)


def _expand_in_chunks(first: np.ndarray, last: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields what :func:`_expand` returns, about a chunk at a time, without empty ranges."""
    (ranges,) = np.nonzero(last > first)
    totals = np.cumsum((last - first)[ranges])
    at = 0
    while at < len(ranges):
        before = totals[at - 1] if at else 0
        stop = max(at + 1, int(np.searchsorted(totals, before + _CHUNK, side="right")))
        rows, places = _expand(first[ranges[at:stop]], last[ranges[at:stop]])
        yield ranges[at + rows], places
        at = stop


def _keys(pairs: np.ndarray, count: int) -> np.ndarray:
    """Returns a number for each pair of numbers below ``count``, shape [n]."""
    return pairs[:, 0] * count + pairs[:, 1]
