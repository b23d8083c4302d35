"""Small meshes with the right answer to the question whether they intersect themselves.

An edge and a face that share no vertex intersect if the closed segment has a point in common with the closed triangle.
``python examples/intersections.py`` asks this package and other tools about these meshes.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import warp_bsc as bsc
from warp_bsc import checker

Mesh = tuple[np.ndarray, np.ndarray]
"""Positions, float64, shape [n, 3], and faces, shape [m, 3]."""


@dataclass(frozen=True, eq=False)
class Case:
    """A small mesh and the right answer.

    Attributes:
        name: What it is, in a few words.
        x: Positions, shape [n, 3], float64; for the answer in single precision they are rounded.
        faces: Faces, shape [m, 3].
        pairs: Number of pairs of an edge and a face that intersect; of float64 and float32 if these differ.
    """

    name: str
    x: np.ndarray
    faces: np.ndarray
    pairs: int | tuple[int, int]

    def pairs_of(self, dtype: type) -> int:
        """Returns the number of pairs that intersect, with positions of a type."""
        if isinstance(self.pairs, int):
            return self.pairs
        return self.pairs[0] if dtype == np.float64 else self.pairs[1]


FACE = (0, 0, 0), (4, 0, 0), (0, 4, 0)
ULP = 2.0**-22
"""Distance of numbers from 2 to 4 in single precision."""


def soup(*triangles: np.ndarray) -> Mesh:
    """Returns triangles of vertices of their own: positions and faces."""
    x = np.array(triangles, dtype=np.float64).reshape(-1, 3)
    return x, np.arange(len(x)).reshape(-1, 3)


def subdivided(x: np.ndarray, faces: np.ndarray, dtype: type = np.float64) -> Mesh:
    """Returns a mesh with four triangles for each one: its corners and the midpoints of its edges, rounded."""
    edges, number = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    middles = ((x[edges[:, 0]] + x[edges[:, 1]]) / 2).astype(dtype).astype(np.float64)
    ab, bc, ca = number.reshape(-1, 3).T + len(x)
    a, b, c = faces.T
    corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([x, middles]), np.concatenate([np.stack(each, axis=1) for each in corners])


def sphere(levels: int) -> Mesh:
    """Returns an icosahedron that is subdivided to a sphere of radius 1, positions rounded to single precision."""
    golden = (1 + 5**0.5) / 2
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=2)))
    plane = np.stack([np.zeros(4), signs[:, 0], golden * signs[:, 1]], axis=1)
    x = np.concatenate([np.roll(plane, turn, axis=1) for turn in range(3)])
    near = np.linalg.norm(x[:, None] - x, axis=2) < 2.1
    faces = [
        f for f in itertools.combinations(range(12), 3) if all(near[pair] for pair in itertools.combinations(f, 2))
    ]
    faces = np.array([f if np.linalg.det(x[list(f)]) > 0 else f[::-1] for f in faces])
    for _ in range(levels):
        x, faces = subdivided(x, faces)
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32).astype(np.float64), faces


def box(low: tuple[float, ...], high: tuple[float, ...]) -> Mesh:
    """Returns a box of eight vertices and twelve triangles."""
    x = np.array(list(itertools.product(*zip(low, high, strict=True))), dtype=np.float64)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return x, np.array([triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))])


def together(*meshes: Mesh) -> Mesh:
    """Returns meshes as one, with vertices of their own."""
    counts = np.cumsum([0, *(len(x) for x, _ in meshes)])
    faces = [faces + first for (_, faces), first in zip(meshes, counts, strict=False)]
    return np.concatenate([x for x, _ in meshes]), np.concatenate(faces)


def pulled_sphere() -> Mesh:
    """Returns a sphere with a vertex that is pulled through the other side."""
    x, faces = sphere(2)
    x[0] *= -1.25
    return x, faces


def thrice_divided(dtype: type) -> Mesh:
    """Returns a triangle that is subdivided three times, positions rounded to a type."""
    x = np.array([(0.28, 0.8276, 0.4638), (0.3389, 0.788, 0.4881), (0.2895, 0.8128, 0.4711)], dtype=dtype)
    x, faces = x.astype(np.float64), np.array([[0, 1, 2]])
    for _ in range(3):
        x, faces = subdivided(x, faces, dtype)
    return x, faces


def stack(count: int) -> Mesh:
    """Returns parallel triangles, each one ulp of single precision above the one before."""
    triangle = np.array([(0.0, 0, 2.25), (1, 0, 2.5), (0, 1, 2.625)])
    return soup(*(triangle + np.array([0, 0, i * ULP]) for i in range(count)))


def scattered(count: int) -> Mesh:
    """Returns small triangles in cells of a lattice, none in the cell of another."""
    rng = np.random.default_rng(0)
    cells = np.stack(np.unravel_index(rng.permutation(8**3)[:count], (8, 8, 8)), axis=1)
    return soup(*(cells[:, None] + rng.integers(1, 2**10, (count, 3, 3)) / 2**10))


def on_lattice(count: int) -> Mesh:
    """Returns triangles whose corners are random points of a lattice, so that many touch or lie in one plane."""
    return soup(*np.random.default_rng(1).integers(0, 12, (count, 3, 3)))


def upright(x: float, y: float) -> Mesh:
    """Returns the triangle of the origin and two units, and one with a vertical edge that passes its plane at x, y."""
    return soup(((0, 0, 0), (1, 0, 0), (0, 1, 0)), ((x, y, -1), (x, y, 1), (2, 2, 0)))


def sharing_a_vertex(*ends: tuple[float, ...]) -> Mesh:
    """Returns two triangles that share their first vertices, the first one flat, given the others of the second."""
    return np.array([*FACE, *ends], dtype=np.float64), np.array([[0, 1, 2], [0, 3, 4]])


IN_ONE_PLANE = {
    "overlap": (((1, 1), (6, 1), (1, 6)), 3),
    "one within the other": (((1, 1), (2, 1), (1, 2)), 3),
    "side by side": (((5, 0), (5, 4), (8, 2)), 0),
}
"""Triangles beside or over FACE in its plane, and how many pairs intersect."""
TOUCHING_IN_LINE = ((3, 5, 7), (3, 5, 4), (1, 5, 5.5)), ((3, 5, 5), (4, 5, 6), (4, 5, 4))
HUGE = (67108859, -33554467, -33554392), (-33554393, 67108879, -33554486), (-33554466, -33554412, 67108878)
"""A triangle in the plane x + y + z = 0."""


def at_huge(side: int) -> Mesh:
    """Returns the huge triangle, and a small one whose lowest corner is on a side of it, by an ulp of a double."""
    corner = 16777259 + side * 2.0**-28, 5592405, -22369664
    return soup(HUGE, (corner, (16777359, 5592435, -22369594), (16777259, 5592805, -22368964)))


def definite_cases() -> Iterator[Case]:
    """Yields meshes that intersect themselves by every definition, or do not by any."""
    yield Case("a sphere", *sphere(3), 0)
    yield Case("a sphere, one vertex pulled through the far side", *pulled_sphere(), 10)
    yield Case("a triangle cut in four, three times, in floats", *thrice_divided(np.float32), 0)
    yield Case("the same in doubles", *thrice_divided(np.float64), 0)
    yield Case("two triangles share a vertex and cross", *sharing_a_vertex((2, 1, -1), (1, 2, 1)), 1)
    strip = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4]])
    yield Case("a strip of three, first and last cross", sharing_a_vertex((2, 1, -1), (1, 2, 1))[0], strip, 1)
    yield Case("two share a vertex, 2^-25 into a side", *sharing_a_vertex((2, 1, -1), (2, -1 + 2.0**-24, 1)), 1)
    yield Case("two share a vertex, 2^-24 beside a side", *sharing_a_vertex((2, 1, -1), (2, -1 - 2.0**-23, 1)), 0)
    yield Case("an edge at (0.3, 0.7): in x + y <= 1", *upright(0.3, 0.7), 2)
    yield Case("an edge at (0.1, 0.9): not, by 2^-55", *upright(0.1, 0.9), (0, 2))  # as floats, it is
    wide, above = ((2048, 0, 0), (2148, 0, 0), (2048, 100, 0)), ((2060, 10, 2**-12), (2090, 10, 2**-12))
    yield Case("2^-13 above a triangle, at x = 2048", *soup(wide, (*above, (2060, 40, 2**-13))), 0)
    yield Case("the same, a corner 2^-13 below", *soup(wide, (*above, (2060, 40, -(2**-13)))), 2)
    yield Case("2^-28 above a triangle of size 2^26", *at_huge(1), 0)
    yield Case("the same, a corner 2^-28 below", *at_huge(-1), 2)
    yield Case("64 parallel triangles, an ulp apart", *stack(64), 0)
    large = [[2.0**18 * x for x in corner] for corner in FACE]
    small = ((1 + 2.0**-21, 1, -(2.0**-20)), (1, 1, 2.0**-20), (1 + 2.0**-20, 1, 2.0**-20))
    yield Case("one of size 2^-20 through one of size 2^20", *soup(large, small), 2)
    blade = soup(((2, 2, -1), (2, 2, 1), (2, 9, 0)))
    sheet = np.array([(0.0, 0, 0), (4, 0, 0), (4, 4, 0), (0, 4, 0), (2, 2, 0)])
    fan = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    yield Case(
        "an edge through the diagonal of a quad", *together((sheet[:4], np.array([[0, 1, 2], [0, 2, 3]])), blade), 4
    )
    yield Case("an edge through the vertex of a fan", *together((sheet, fan), blade), 9)
    face = [(u, v, u + 2 * v) for u, v, _ in FACE]
    for name, (other, pairs) in IN_ONE_PLANE.items():
        yield Case(f"two in one plane, {name}", *soup(face, [(u, v, u + 2 * v) for u, v in other]), pairs)
    first, second = TOUCHING_IN_LINE
    yield Case("two in one plane, an ulp apart", *soup(first, [(max(x, 3 + ULP), y, z) for x, y, z in second]), 0)
    yield Case("a soup of 200, each in a cell of its own", *scattered(200), 0)
    yield Case("a soup of 100 with corners on a lattice", *on_lattice(100), 3328)


def cases_by_definition() -> Iterator[Case]:
    """Yields meshes whose faces touch only, share vertices and overlap, or have no area: definitions differ on them."""
    yield Case("two in one plane touch in a line", *soup(*TOUCHING_IN_LINE), 3)
    yield Case("a corner touches a face", *soup(FACE, ((1, 1, 0), (1, 1, 2), (2, 1, 2))), 2)
    yield Case("two boxes, one on the other", *together(box((0, 0, 0), (2, 2, 2)), box((0, 0, 2), (2, 2, 3))), 140)
    quad = np.array([(0.0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 1, 3], [1, 2, 3]])
    yield Case("a quad of two triangles, vertices not merged", *soup(quad[faces[0]], quad[faces[1]]), 6)
    yield Case("a quad divided both ways, on four vertices", quad, faces, 0)
    yield Case("the same, on twice four vertices", *together((quad, faces[:2]), (quad, faces[2:])), 20)
    yield Case("a triangle twice, on three vertices", soup(FACE)[0], np.array([[0, 1, 2], [0, 1, 2]]), 0)
    yield Case("a triangle twice, on twice three vertices", *soup(FACE, FACE), 6)
    flap = soup(FACE, FACE)[0][:4] + [[0], [0], [0], [1]] * np.array([1, 1, 0])
    yield Case("a triangle folded flat onto its neighbour", flap, np.array([[0, 1, 2], [1, 0, 3]]), 0)
    yield Case("a triangle without area through a face", *soup(FACE, ((1, 1, -1), (1, 1, 1), (1, 1, 3))), 2)


def true_pairs(x: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Returns the pairs of an edge and a face that intersect, decided in rational arithmetic if their boxes overlap."""
    edges = bsc.CollisionMesh(faces, len(x)).edges
    ends, corners = x[edges], x[faces]
    overlap = (ends.min(axis=1)[:, None] <= corners.max(axis=1)) & (corners.min(axis=1) <= ends.max(axis=1)[:, None])
    pairs = np.argwhere(overlap.all(axis=2))
    pairs = pairs[(edges[pairs[:, 0]][:, :, None] != faces[pairs[:, 1]][:, None, :]).all(axis=(1, 2))]
    return pairs[checker.edge_face_crossings(ends[pairs[:, 0]], corners[pairs[:, 1]])]


def variants(x: np.ndarray, faces: np.ndarray) -> Iterator[Mesh]:
    """Yields a mesh as it is, and five times with its axes, vertices and faces in another order."""
    yield x, faces
    rng = np.random.default_rng(0)
    for axes in list(itertools.permutations(range(3)))[1:]:
        order = rng.permutation(len(x))
        turned = np.stack(
            [np.roll(face, turn) for face, turn in zip(faces, rng.integers(0, 3, len(faces)), strict=True)]
        )
        yield x[order][:, axes].copy(), np.argsort(order)[turned[rng.permutation(len(faces))]]


def parts_of(faces: np.ndarray) -> list[np.ndarray]:
    """Returns the faces of each part of a mesh; faces of two parts share no vertex."""
    part = np.arange(faces.max() + 1)
    while (part[faces] != part[faces].min(axis=1, keepdims=True)).any():
        np.minimum.at(part, faces, part[faces].min(axis=1, keepdims=True).repeat(3, axis=1))
    return [faces[part[faces[:, 0]] == number] for number in np.unique(part[faces])]
