"""The parts of bodies that are wholly inside other bodies in one configuration, and the points that are, exactly."""

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ... import checker
from ..._sorted_keys import expand_in_chunks, expand_ranges
from ..mesh import CollisionMesh
from .body_parts import BodyParts, pair_keys
from .intersections import Intersections, points_on_faces

_APART = 0x1E3779B97F4A7C15  # what keys of cells differ by from one world to the next, modulo 2**64


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


class _Sides(NamedTuple):
    """The sides of bodies on which queries are; a query is a point that is compared with parts of one body."""

    on_surface: np.ndarray  # whether the point is on one of the parts, where that is looked for, shape [n]
    inside: np.ndarray  # whether the parts wind around the point, if it is not on one of them, shape [n]
    rows: np.ndarray  # query of each face that a ray along +x from the point passes, shape [m]
    faces: np.ndarray  # these faces, shape [m]


class ContainmentFinder:
    """Finds parts of bodies that are inside others, in one configuration after another of a mesh of several bodies.

    A part of a body consists of vertices that its faces, and its edges without faces, connect. A part is closed if an
    even number of its faces meet at each edge, and it has no other edges. Closed parts enclose the points that they
    wind around; where the faces of a part are not oriented alike, the points from which a ray passes the part an odd
    number of times. All closed parts of a body count together, with their signs: a point in the cavity of a hollow
    body, whose inner surface is turned inwards, is not inside. Open parts enclose nothing.

    A part is wholly inside a body if it is inside at one of its vertices and its edges and faces pass through none of
    the body's. A part that touches the body is inside if none of its vertices is outside, and not all are on the body.
    A point is inside a body if the body's closed parts enclose it, and it is on none of them.

    The result is exact: signs that floating point does not certify are computed exactly.
    """

    def __init__(self, mesh: CollisionMesh, bodies: np.ndarray, worlds: np.ndarray | None = None):
        """Stores a mesh, whose parts are found when they are first needed.

        Args:
            mesh: The mesh. Its faces turn counterclockwise seen from outside. Bodies may have vertices in common.
            bodies: Body of each face, then of each of ``mesh.free_edges``, integers from 0, shape [n]. Those with -1
                are left out; their vertices belong to others as well.
            worlds: World of each body, which contains nothing of another one, integers; None: all are in one.
        """
        self._mesh, self._bodies = mesh, bodies.astype(np.int64)
        self._worlds = np.zeros(bodies.max(initial=0) + 1, np.int64) if worlds is None else worlds.astype(np.int64)

    def find(self, x: np.ndarray, found: Intersections, is_sought: Callable[[np.ndarray], np.ndarray]) -> Containment:
        """Returns the parts of bodies that are inside others in one configuration.

        Args:
            x: Positions, finite, any unit of length, shape [vertex_count, 3].
            found: The intersections of the mesh in this configuration.
            is_sought: Returns which pairs of an inner and an outer body are looked for, given shape [m, 2].
        """
        none = Containment(np.zeros((0, 2), np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))
        if not len(self._bodies) or self._bodies.min() == self._bodies.max() or not self._parts.closed.any():
            return none
        parts = self._parts
        low, high = parts.boxes(x)
        (outer,) = np.nonzero(parts.closed)
        world = self._worlds[parts.body]
        pairs = enclosing_boxes((low, high), (low[outer], high[outer]), 3, world, world[outer])
        pairs[:, 1] = outer[pairs[:, 1]]
        pairs = pairs[parts.body[pairs[:, 0]] != parts.body[pairs[:, 1]]]
        pairs = pairs[is_sought(parts.body[pairs])]
        if not len(pairs):
            return none
        has_part = parts.of_face[found.pairs[:, 1]] >= 0
        found = Intersections(found.pairs[has_part], found.crosses[has_part])
        meeting, passing = parts.meeting(found)
        touching = pair_keys(pairs, len(low)), pair_keys(pairs[:, ::-1], len(low))
        is_touching = np.isin(touching[0], meeting) | np.isin(touching[1], meeting)
        # a part that passes through any part of a body is not inside it
        of_bodies = np.stack([passing // len(low), passing % len(low)], axis=1)
        of_bodies = np.concatenate([of_bodies, of_bodies[:, ::-1]])
        passing = of_bodies[:, 0] * len(low) + parts.body[of_bodies[:, 1]]
        kept = ~np.isin(pairs[:, 0] * len(low) + parts.body[pairs[:, 1]], passing)
        return self._decide(x, found, pairs[kept], is_touching[kept])

    def find_points(
        self, x: np.ndarray, points: np.ndarray, world: np.ndarray, is_sought: Callable[[np.ndarray], np.ndarray]
    ) -> np.ndarray:
        """Returns which points are strictly inside which bodies in one configuration.

        Args:
            x: Positions of the vertices, finite, any unit of length, shape [vertex_count, 3].
            points: The points, finite, of the same type, shape [n, 3].
            world: World of each point, shape [n].
            is_sought: Returns which pairs of a point and a body are looked for, given shape [m, 2].

        Returns:
            Pairs of a point and a body, sorted, int64, shape [k, 2].
        """
        none = np.zeros((0, 2), dtype=np.int64)
        if not len(self._bodies) or not len(points) or not self._parts.closed.any():
            return none
        parts = self._parts
        (closed,) = np.nonzero(parts.closed)
        boxes = [corner[closed] for corner in parts.boxes(x)]
        pairs = enclosing_boxes((points, points), boxes, 3, world.astype(np.int64), self._worlds[parts.body[closed]])
        pairs[:, 1] = closed[pairs[:, 1]]
        of_body = np.stack([pairs[:, 0], parts.body[pairs[:, 1]]], axis=1)
        kept = is_sought(of_body)
        if not kept.any():
            return none
        queries, query_of_pair = np.unique(of_body[kept], axis=0, return_inverse=True)
        compared = np.stack([query_of_pair.reshape(-1), pairs[kept, 1]], axis=1)  # NumPy 2.0 shapes it otherwise
        used, place = np.unique(queries[:, 0], return_inverse=True)
        sides = self._find_sides(x, points[used], place, compared, np.ones(len(queries), dtype=bool))
        return queries[sides.inside & ~sides.on_surface]

    @functools.cached_property
    def _parts(self) -> BodyParts:
        return BodyParts(self._mesh, self._bodies)

    def _decide(self, x: np.ndarray, found: Intersections, pairs: np.ndarray, is_touching: np.ndarray) -> Containment:
        """Returns which parts are inside, given pairs of a part and a closed one that do not pass through each other.

        The box of the first of a pair is in that of the second; ``is_touching`` says whether they touch, shape [m].
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
        rows, places = expand_ranges(firsts[case_of_query], (firsts + counts)[case_of_query])
        compared = np.stack([rows, pairs[order[places], 1]], axis=1)
        used, place = np.unique(vertices, return_inverse=True)
        points = x[vertices]
        sides = self._find_sides(x, x[used], place, compared, touches[case_of_query])
        inside, decided = sides.inside, ~sides.on_surface
        yes = np.bincount(case_of_query, decided & inside, len(cases)) > 0
        no = np.bincount(case_of_query, decided & ~inside, len(cases)) > 0
        (kept,) = np.nonzero(yes & ~no)
        # the first query of each, and the face that its ray meets first
        (rows,) = np.nonzero(decided & inside)
        rows = rows[np.unique(case_of_query[rows], return_index=True)[1]]
        rows = rows[np.isin(case_of_query[rows], kept)]
        bodies = np.stack([parts.body[cases[kept, 0]], cases[kept, 1]], axis=1)
        distance = _distances_along_x(points[sides.rows], x[self._mesh.faces[sides.faces]].astype(np.float64))
        nearest = np.lexsort((sides.faces, distance, sides.rows))
        first_faces = sides.faces[nearest[np.searchsorted(sides.rows[nearest], rows)]]
        order = np.lexsort((vertices[rows], bodies[:, 1], bodies[:, 0]))
        return Containment(bodies[order], vertices[rows[order]], first_faces[order])

    def _find_sides(
        self, x: np.ndarray, points: np.ndarray, place: np.ndarray, compared: np.ndarray, may_touch: np.ndarray
    ) -> _Sides:
        """Returns on which side of its body each query is.

        A point and a face are decided once, however many queries compare them: those of bodies in one place are many.
        Query i is of point ``place[i]``, and may be on a part if ``may_touch[i]``; ``compared`` are pairs of a query
        and a closed part of its body.
        """
        parts = self._parts
        keys_compared = pair_keys(np.stack([place[compared[:, 0]], compared[:, 1]], axis=1), len(parts.body))
        order = np.argsort(keys_compared, kind="stable")
        keys_compared, queries = keys_compared[order], compared[order, 0]
        faces = self._faces_ahead(x, points, compared[:, 1])
        corners = x[self._mesh.faces[faces]].astype(np.float64)
        low, high, part_of_face = corners.min(axis=1), corners.max(axis=1), parts.of_face[faces]
        world = np.zeros(len(points), dtype=np.int64)
        world[place[compared[:, 0]]] = self._worlds[parts.body[compared[:, 1]]]

        def pair_up(box_low: np.ndarray, axes: int, sought: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            """Returns points and faces whose box contains the point along the first axes of y, z and x.

            Only those are returned that a sought query compares: pairs of a point and a face; and rows of a pair and a
            query, in two arrays.
            """
            places, *boxes = (array[:, [1, 2, 0]] for array in (points, box_low, high))
            found = enclosing_boxes((places, places), boxes, axes, world, self._worlds[parts.body[part_of_face]])
            keys = found[:, 0] * len(parts.body) + part_of_face[found[:, 1]]
            bounds = np.searchsorted(keys_compared, keys), np.searchsorted(keys_compared, keys, side="right")
            pairs, at = expand_ranges(*bounds)
            kept = sought[queries[at]]
            is_first = np.diff(pairs[kept], prepend=-1) > 0
            return found[pairs[kept][is_first]], np.cumsum(is_first) - 1, queries[at[kept]]

        on_surface = np.zeros(len(place), dtype=bool)
        if may_touch.any():
            met, pairs, rows = pair_up(low, 3, may_touch)
            on_surface[rows[points_on_faces(self._mesh, x, points[met[:, 0]], faces[met[:, 1]])[pairs]]] = True
        # rays along +x, of the others
        met, pairs, rows = pair_up(np.where([True, False, False], -np.inf, low), 2, ~on_surface)
        signs = checker.rays_pass_faces(points[met[:, 0]].astype(np.float64), corners[met[:, 1]]).astype(np.int64)
        passes = signs[pairs] != 0
        pairs, rows = pairs[passes], rows[passes]
        signs, faces = signs[pairs], faces[met[pairs, 1]]
        keys, pair_of_ray = np.unique(rows * len(parts.body) + parts.of_face[faces], return_inverse=True)
        windings, passes = np.bincount(pair_of_ray, signs, len(keys)), np.bincount(pair_of_ray, minlength=len(keys))
        turns = np.where(parts.oriented[keys % len(parts.body)], windings, passes % 2)
        inside = np.bincount(keys // len(parts.body), turns, len(place)) != 0
        return _Sides(on_surface, inside, rows, faces)

    def _choose_vertices(
        self, cases: np.ndarray, touches: np.ndarray, found: Intersections
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns the vertices that decide whether parts are inside bodies, after the case of each, ascending.

        Cases are sorted pairs of a part and a body. Where one does not touch the other, one vertex decides.
        """
        parts = self._parts
        chosen = [np.array([parts.first_vertex[part]]) for part in cases[:, 0]]
        if touches.any():
            of_edges, ends = parts.touching_edges(found)
            keys = pair_keys(cases, int(parts.body.max()) + 1)
            first, last = np.searchsorted(of_edges, keys), np.searchsorted(of_edges, keys, side="right")
            for case in np.flatnonzero(touches & (last > first)):
                chosen[case] = np.unique(ends[first[case] : last[case]])
        case_of_vertex = np.repeat(np.arange(len(cases)), list(map(len, chosen)))
        return case_of_vertex, np.concatenate([np.zeros(0, np.int64), *chosen])

    def _faces_ahead(self, x: np.ndarray, points: np.ndarray, parts: np.ndarray) -> np.ndarray:
        """Returns the faces of some parts that are not on the same side of all rays from some points, ascending."""
        is_compared = np.zeros(len(self._parts.body), dtype=bool)
        is_compared[parts] = True
        low, high = points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)
        sides = np.zeros(len(x), dtype=np.uint8)
        for bit, is_aside in enumerate((x[:, 0] < low[0], *(x[:, 1:] < low[1:]).T, *(x[:, 1:] > high[1:]).T)):
            sides |= is_aside.astype(np.uint8) << bit
        a, b, c = (sides[corners] for corners in self._mesh.faces.T)
        part = self._parts.of_face[: len(a)]
        return np.flatnonzero((part >= 0) & is_compared[part] & (a & b & c == 0))


def enclosing_boxes(
    inner: Sequence[np.ndarray], outer: Sequence[np.ndarray], axes: int, world: np.ndarray, outer_world: np.ndarray
) -> np.ndarray:
    """Returns the pairs of an inner box and an outer one of the same world that contains it, borders included.

    Outer boxes are in classes by size. For each class, a grid holds the boxes by their lowest corners; its cells are as
    large as the outer boxes, so that an outer box is in the cell of the inner box or in the one before along some axes.

    Args:
        inner: Lowest and highest corners of the inner boxes, each of shape [n, 3].
        outer: Those of the outer boxes, each of shape [m, 3].
        axes: Number of axes, from the first one, along which the boxes are finite, and the grid has cells.
        world: World of each inner box, int64.
        outer_world: That of each outer box.

    Returns:
        Indices of the inner and the outer boxes, sorted, shape [k, 2].
    """
    (low, high), (outer_low, outer_high) = inner, outer
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
    size_class = np.ceil(np.log2(np.maximum(sizes / smallest, 1.0)))
    weights = np.array([1 << 42, 1 << 21, 1])[:axes]
    for number in np.unique(size_class):
        cell = smallest * 2.0**number * (1.0 + 1e-6)  # cells are numbered with rounding
        (members,) = np.nonzero(size_class == number)
        keys = (np.floor((outer_starts[members] - corner) / cell).astype(np.int64) + 1) @ weights
        keys += _APART * outer_world[near[members]]
        order = np.argsort(keys, kind="stable")
        keys, members = keys[order], near[members[order]]
        of_inner = (np.floor((starts - corner) / cell).astype(np.int64) + 1) @ weights + _APART * world
        for step in itertools.product((0, 1), repeat=axes):
            cells = of_inner - np.array(step) @ weights
            first, last = np.searchsorted(keys, cells), np.searchsorted(keys, cells, side="right")
            for rows, places in expand_in_chunks(first, last):
                kept = world[rows] == outer_world[members[places]]
                i, j = rows[kept], members[places[kept]]
                for axis in range(3):
                    kept = (outer_low[j, axis] <= low[i, axis]) & (high[i, axis] <= outer_high[j, axis])
                    i, j = i[kept], j[kept]
                found.append(np.stack([i, j], axis=1))
    pairs = np.concatenate(found)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def _distances_along_x(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Returns how far points are from the planes of faces along x, in floating point, infinite where it overflows."""
    sides = faces - points[:, None]
    normal = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
    with np.errstate(all="ignore"):
        return np.nan_to_num((sides[:, 0] * normal).sum(axis=1) / normal[:, 0], nan=np.inf)
