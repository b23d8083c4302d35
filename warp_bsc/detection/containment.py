"""The parts of bodies that are wholly inside other bodies in one configuration, exactly."""

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from .. import checker
from .intersections import Intersections

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

    A part of a body is what its faces, edges and points connect. A part is closed if an even number of its faces meet
    at each edge. Closed parts enclose what they wind around; where the faces of a part are not oriented alike, what a
    ray from it passes an odd number of times. All closed parts of a body count together, with their signs: what is in
    the cavity of a hollow body, whose inner surface is turned inwards, is not inside. Open parts enclose nothing.

    A part is wholly inside a body if it is inside at one of its vertices and its edges and faces pass through none of
    the body's. A part that touches the body is inside if none of its vertices is outside, and not all are on the body.

    No floating-point error can change the answer: signs that are not certain are computed in rational arithmetic.
    """

    def __init__(self, cells: np.ndarray, bodies: np.ndarray, face_count: int):
        """Takes the elements; finds the parts when they are needed first.

        Args:
            cells: Vertices of the faces, counterclockwise seen from outside, then of edges as a b b and points as
                a a a, integers, shape [n, 3]. A body's vertices may be another's too.
            bodies: Body of each cell, integers from 0, shape [n].
            face_count: Number of faces.
        """
        self._cells, self._bodies, self._face_count = cells.astype(np.int64), bodies.astype(np.int64), face_count
        self._vertex_count = int(cells.max(initial=-1)) + 1

    def find(
        self,
        x: np.ndarray,
        edges: np.ndarray,
        found: Intersections,
        are_wanted: Callable[[np.ndarray], np.ndarray],
    ) -> Containment:
        """Returns what is inside what in one configuration.

        Args:
            x: Positions, finite, any unit of length, shape [vertex_count, 3].
            edges: Vertices of the edges that ``found`` refers to, shape [edge_count, 2].
            found: The intersections in this configuration, of all cells.
            are_wanted: Returns which pairs of an inner and an outer body are looked for, given shape [m, 2].
        """
        none = Containment(np.zeros((0, 2), np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))
        if not len(self._bodies) or self._bodies.min() == self._bodies.max() or not self._parts.closed.any():
            return none
        parts = self._parts
        x = x.astype(np.float64)
        low, high = parts.boxes(x)
        (outer,) = np.nonzero(parts.closed)
        pairs = np.concatenate([np.zeros((0, 2), np.int64), *_enclosing(low, high, low[outer], high[outer])])
        pairs[:, 1] = outer[pairs[:, 1]]
        pairs = pairs[parts.body[pairs[:, 0]] != parts.body[pairs[:, 1]]]
        pairs = pairs[are_wanted(parts.body[pairs])]
        if not len(pairs):
            return none
        meeting, passing = parts.meeting(edges, found)
        touching = _keys(pairs, len(low)), _keys(pairs[:, ::-1], len(low))
        is_touching = np.isin(touching[0], meeting) | np.isin(touching[1], meeting)
        # a part that passes through any part of a body is not inside it
        of_bodies = np.stack([passing // len(low), passing % len(low)], axis=1)
        of_bodies = np.concatenate([of_bodies, of_bodies[:, ::-1]])
        passing = of_bodies[:, 0] * len(low) + parts.body[of_bodies[:, 1]]
        kept = ~np.isin(pairs[:, 0] * len(low) + parts.body[pairs[:, 1]], passing)
        return self._decide(x, edges, found, pairs[kept], is_touching[kept])

    @functools.cached_property
    def _parts(self) -> "_Parts":
        return _Parts(self._cells, self._bodies, self._face_count, self._vertex_count)

    def _decide(
        self, x: np.ndarray, edges: np.ndarray, found: Intersections, pairs: np.ndarray, is_touching: np.ndarray
    ) -> Containment:
        """Returns which parts are inside, given pairs of an inner and a closed part that pass through each other nowhere.

        Args:
            x: As of :meth:`find`, as the next two.
            edges: As above.
            found: As above.
            pairs: Pairs of parts of which one's box is in the other's, shape [m, 2].
            is_touching: Whether they touch each other, shape [m].
        """
        parts = self._parts
        of_body = np.stack([pairs[:, 0], parts.body[pairs[:, 1]]], axis=1)
        cases, case_of_pair = np.unique(of_body, axis=0, return_inverse=True)
        case_of_pair = case_of_pair.reshape(-1)  # NumPy 2.0 shapes it otherwise
        touches = np.bincount(case_of_pair, is_touching, len(cases)) > 0
        queries = [np.array([parts.first_vertex[part]]) for part in cases[:, 0]]
        for case in np.flatnonzero(touches):
            ends = parts.ends_of_touching(*cases[case], edges, found)
            queries[case] = ends if len(ends) else queries[case]
        case_of_query = np.repeat(np.arange(len(cases)), list(map(len, queries)))
        vertices = np.concatenate([np.zeros(0, np.int64), *queries])

        # the closed parts that each query is compared with, and their faces
        order = np.argsort(case_of_pair, kind="stable")
        counts = np.bincount(case_of_pair, minlength=len(cases))
        firsts = np.cumsum(counts) - counts
        rows, places = _expand(firsts[case_of_query], (firsts + counts)[case_of_query])
        compared = _keys(np.stack([rows, pairs[order[places], 1]], axis=1), len(parts.body))
        (faces,) = np.nonzero(np.isin(parts.of_cell[: self._face_count], pairs[:, 1]))
        corners = x[self._cells[faces]]
        low, high, points = corners.min(axis=1), corners.max(axis=1), x[vertices]

        def pair_up(box_low: np.ndarray) -> np.ndarray:
            """Returns queries and faces of which the point, seen along the axes y, z and x, is in the box."""
            axes = [1, 2, 0]
            boxes = _enclosing(points[:, axes], points[:, axes], box_low[:, axes], high[:, axes])
            found = np.concatenate([np.zeros((0, 2), np.int64), *boxes])
            keys = found[:, 0] * len(parts.body) + parts.of_cell[faces[found[:, 1]]]
            return found[np.isin(keys, compared)]

        on_surface = np.zeros(len(vertices), dtype=bool)
        if touches.any():
            met = pair_up(low)
            met = met[touches[case_of_query[met[:, 0]]]]
            at = np.repeat(points[met[:, 0], None], 2, axis=1)
            on_surface[met[checker.edge_face_crossings(at, corners[met[:, 1]]), 0]] = True
        # rays along +x
        met = pair_up(np.where([True, False, False], -np.inf, low))
        signs = checker.rays_pass_faces(points[met[:, 0]], corners[met[:, 1]]).astype(np.int64)
        met, signs = met[signs != 0], signs[signs != 0]
        keys, pair_of_ray = np.unique(
            met[:, 0] * len(parts.body) + parts.of_cell[faces[met[:, 1]]], return_inverse=True
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
        first_of = nearest[np.searchsorted(nearest[:, 0], rows), 1]
        order = np.lexsort((vertices[rows], bodies[:, 1], bodies[:, 0]))
        return Containment(bodies[order], vertices[rows][order], faces[first_of][order])


class _Parts:
    """The connected parts of bodies.

    A node is a vertex as one body has it: bodies may share vertices, but no part belongs to two bodies.

    Attributes:
        body: Body of each part, shape [part_count].
        closed: Whether an even number of its faces meet at each edge, and it has faces, shape [part_count].
        oriented: Whether its faces pass each edge as often in one direction as in the other, shape [part_count].
        of_cell: Part of each cell, shape [cell_count].
        first_vertex: The first vertex of each part, shape [part_count].
    """

    def __init__(self, cells: np.ndarray, bodies: np.ndarray, face_count: int, vertex_count: int):
        """Connects the cells of each body."""
        self._vertex_count = vertex_count
        keys, nodes = np.unique(bodies[:, None] * vertex_count + cells, return_inverse=True)
        nodes = nodes.reshape(-1, 3)
        roots = _connect(nodes, len(keys))
        part_roots, self._of_node = np.unique(roots, return_inverse=True)
        part_count = len(part_roots)
        self._node_vertices, node_bodies = keys % vertex_count, keys // vertex_count
        self.body = node_bodies[part_roots]
        self.of_cell = self._of_node[nodes[:, 0]]
        order = np.argsort(self._of_node, kind="stable")
        self._ordered_vertices = self._node_vertices[order]
        self._starts = np.searchsorted(self._of_node[order], np.arange(part_count))
        self.first_vertex = self._ordered_vertices[self._starts]
        self._by_vertex = np.argsort(self._node_vertices, kind="stable")
        self._sorted_vertices = self._node_vertices[self._by_vertex]

        a, b = np.concatenate([nodes[:face_count, side] for side in ([0, 1], [1, 2], [2, 0])]).T
        a, b = a[a != b], b[a != b]
        low, high = np.minimum(a, b), np.maximum(a, b)
        edges, of_side, counts = np.unique(low * len(keys) + high, return_inverse=True, return_counts=True)
        sums = np.bincount(of_side, np.where(a < b, 1, -1), len(edges))
        of_edge = self._of_node[edges // max(1, len(keys))]
        self.closed = np.bincount(of_edge, counts % 2, part_count) == 0
        self.closed &= np.bincount(of_edge, minlength=part_count) > 0
        self.oriented = np.bincount(of_edge, sums != 0, part_count) == 0

    def boxes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the lowest and the highest corners of the parts' bounding boxes, each of shape [part_count, 3]."""
        columns = [np.ascontiguousarray(column) for column in x[self._ordered_vertices].T]
        return tuple(
            np.stack([bound.reduceat(column, self._starts) for column in columns], axis=1)
            for bound in (np.minimum, np.maximum)
        )

    def meeting(self, edges: np.ndarray, found: Intersections) -> tuple[np.ndarray, np.ndarray]:
        """Returns keys of the pairs of parts that meet, and of those of which an edge passes through a face.

        Arguments are those of :meth:`ContainmentFinder.find`. The part of the edge comes first in each key; parts that
        share vertices are among those that meet, in both orders.
        """
        rows, of_edge = self._parts_at_edges(edges[found.pairs[:, 0]].astype(np.int64))
        keys = _keys(np.stack([of_edge, self.of_cell[found.pairs[rows, 1]]], axis=1), len(self.body))
        (shared,) = np.nonzero(np.bincount(self._node_vertices, minlength=self._vertex_count) > 1)
        at_shared, of_node = self._parts_at(shared)
        counts = np.bincount(at_shared, minlength=len(shared))
        firsts = np.cumsum(counts) - counts
        one, other = _expand(firsts[at_shared], (firsts + counts)[at_shared])
        sharing = _keys(np.stack([of_node[one], of_node[other]], axis=1), len(self.body))
        return np.union1d(keys, sharing), np.unique(keys[found.crosses[rows]])

    def ends_of_touching(self, part: int, body: int, edges: np.ndarray, found: Intersections) -> np.ndarray:
        """Returns the vertices of all edges of a part that meet faces of a body or have a vertex of it, ascending.

        Whatever of the part is left without these edges stays on one side of the body, and has one of these vertices
        unless it is the whole part.
        """
        own = self._ordered_vertices[self._starts[part] : [*self._starts, None][part + 1]]
        others = self._node_vertices[self.body[self._of_node] == body]
        meets = edges[found.pairs[self.body[self.of_cell[found.pairs[:, 1]]] == body, 0]]
        shared = edges[np.isin(edges, np.intersect1d(own, others)).any(axis=1)]
        touching = np.concatenate([meets, shared]).astype(np.int64)
        return np.unique(touching[np.isin(touching, own).all(axis=1)])

    def _parts_at(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns all parts that have each vertex: rows of the argument, and the parts."""
        first = np.searchsorted(self._sorted_vertices, vertices)
        last = np.searchsorted(self._sorted_vertices, vertices, side="right")
        rows, places = _expand(first, last)
        return rows, self._of_node[self._by_vertex[places]]

    def _parts_at_edges(self, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns all parts that have both vertices of each edge: rows of the argument, and the parts."""
        rows, first = self._parts_at(ends[:, 0])
        other_rows, other = self._parts_at(ends[:, 1])
        count = len(self.body)
        both = np.intersect1d(rows * count + first, other_rows * count + other)
        return both // count, both % count


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


def _enclosing(low: np.ndarray, high: np.ndarray, outer_low: np.ndarray, outer_high: np.ndarray) -> Iterator[np.ndarray]:
    """Yields the pairs of an inner box and an outer one that contains it, borders included, a chunk at a time.

    The outer boxes are grouped by their widths along the first axis and sorted there, so that those that may contain a
    box are neighbours.

    Args:
        low: Lowest corners of the inner boxes, shape [n, d].
        high: Highest corners.
        outer_low: Lowest corners of the outer boxes, shape [m, d].
        outer_high: Highest corners.

    Yields:
        Indices of the inner and the outer boxes, shape [k, 2].
    """
    if not len(low):
        return
    (near,) = np.nonzero(((outer_low <= low.max(axis=0)) & (outer_high >= high.min(axis=0))).all(axis=1))
    width = outer_high[near, 0] - outer_low[near, 0]
    _, group = np.frexp(width)
    for number in np.unique(group):
        members = near[group == number]
        members = members[np.argsort(outer_low[members, 0], kind="stable")]
        lows = outer_low[members, 0]
        widest = np.nextafter(width[group == number].max(), np.inf)  # differences are rounded
        first = np.searchsorted(lows, np.nextafter(low[:, 0] - widest, -np.inf))
        last = np.searchsorted(lows, low[:, 0], side="right")
        totals = np.cumsum(last - first)
        at = 0
        while at < len(low):
            before = totals[at - 1] if at else 0
            stop = max(at + 1, int(np.searchsorted(totals, before + _CHUNK, side="right")))
            rows, places = _expand(first[at:stop], last[at:stop])
            inner, outer = at + rows, members[places]
            kept = (outer_low[outer] <= low[inner]).all(axis=1) & (high[inner] <= outer_high[outer]).all(axis=1)
            yield np.stack([inner[kept], outer[kept]], axis=1)
            at = stop


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


def _keys(pairs: np.ndarray, count: int) -> np.ndarray:
    """Returns a number for each pair of numbers below ``count``, shape [n]."""
    return pairs[:, 0] * count + pairs[:, 1]
