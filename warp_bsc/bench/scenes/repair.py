"""Meshes that cross themselves, for measurements of repair: known ones, files, and random damage of five kinds."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...detection.at_rest.intersections import IntersectionFinder
from ...detection.mesh import CollisionMesh
from .mesh_files import read_mesh


@dataclass(frozen=True, eq=False)
class TangledMesh:
    """A mesh whose positions cross, or may cross."""

    faces: np.ndarray  # vertex indices, int, shape [face_count, 3]
    x: np.ndarray  # positions that cross, float64, shape [vertex_count, 3]
    # positions that do not cross, such as those before the damage, float64, shape [vertex_count, 3]; None if there are
    # none
    free: np.ndarray | None
    fixed: np.ndarray  # vertices that must stay, bool, shape [vertex_count]
    sheet: np.ndarray  # sheet of each vertex from inside to outside, -1 for none, int, shape [vertex_count]


_Surface = tuple[np.ndarray, np.ndarray]
"""Positions and faces."""


def _grid(n: int, m: int, place: Callable[[np.ndarray, np.ndarray], np.ndarray], *, closed: bool = False) -> _Surface:
    """Returns a grid of n by m vertices at the places of (u, v) in [0, 1]; if closed, v is an angle in [0, 1)."""
    u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, m, endpoint=not closed), indexing="ij")
    i = np.arange(n * m).reshape(n, m)
    if closed:
        i = np.concatenate([i, i[:, :1]], axis=1)
    a, b, c, d = i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return place(u.ravel(), v.ravel()), faces


def _joined(*surfaces: _Surface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the positions and faces of all surfaces, and the number of the surface of each vertex."""
    counts = np.cumsum([0] + [len(x) for x, _ in surfaces])
    faces = np.concatenate([faces + first for first, (_, faces) in zip(counts, surfaces, strict=False)])
    sheet = np.repeat(np.arange(len(surfaces)), np.diff(counts))
    return np.concatenate([x for x, _ in surfaces]), faces, sheet


def _tube(centre: Callable[[np.ndarray], np.ndarray], radius: Callable, n: int, m: int) -> _Surface:
    """Returns a closed tube around a plane curve (x, y)(u), with a point at each end, faces outward."""

    def place(u, v):
        ahead = centre(u + 1e-4) - centre(u - 1e-4)
        ahead /= np.linalg.norm(ahead, axis=1)[:, None]
        across = np.stack([-ahead[:, 1], ahead[:, 0], 0 * u], -1)
        angle = 2 * np.pi * v
        r = radius(u)[:, None]
        return centre(u) + r * (np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.array([0.0, 0.0, -1.0]))

    x, faces = _grid(n, m, place, closed=True)
    ends = centre(np.array([0.0, 1.0]))
    first, last, around = len(x), len(x) + 1, np.arange(m)
    caps = [
        np.stack([np.full(m, first), around, np.roll(around, -1)], -1),
        np.stack([np.full(m, last), np.roll(around, -1) + (n - 1) * m, around + (n - 1) * m], -1),
    ]
    return np.concatenate([x, ends]), np.concatenate([faces, *caps])


def _rounded(u: np.ndarray) -> np.ndarray:
    """Returns the radius, as a share of the largest, of a tube with round ends."""
    end = np.minimum(u, 1.0 - u) / 0.04
    return np.where(end < 1.0, np.sqrt(np.maximum(0.02, 1.0 - (1.0 - np.minimum(end, 1.0)) ** 2)), 1.0)


def _body(rng: np.random.Generator) -> _Surface:
    """Returns a limb bent to a U, whose two halves are near each other."""
    gap = rng.uniform(0.26, 0.32)

    def centre(u):
        s = (u - 0.5) * 3.0
        bend = np.clip(s / (0.5 * gap), -np.pi / 2, np.pi / 2)
        straight = np.maximum(np.abs(s) - 0.25 * np.pi * gap, 0.0)
        return np.stack([0.5 * gap * np.cos(bend) - straight, 0.5 * gap * np.sin(bend), 0 * u], -1)

    return _tube(centre, lambda u: 0.1 * _rounded(u) * (1 + 0.1 * np.sin(9 * u)), 90, 24)


def _blob(rng: np.random.Generator, place: np.ndarray) -> _Surface:
    """Returns a closed round surface of radius 0.5."""

    def centre(u):
        return np.stack([u - 0.5, 0 * u, 0 * u], -1)

    wave = rng.uniform(0.0, 0.1)
    # rings lie closer together where the surface turns
    x, faces = _tube(centre, lambda u: 0.5 * np.sqrt(np.maximum(0.003, 1 - (2 * u - 1) ** 2)), 40, 40)
    x = x * (1 + wave * np.sin(5 * x[:, [1]]))
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return x @ (turn * np.sign(np.linalg.det(turn))) + place, faces


def _body_scene(rng: np.random.Generator):
    x, faces = _body(rng)
    return faces, x, np.zeros(len(x), bool), np.full(len(x), -1)


def _garment_scene(rng: np.random.Generator):
    turns = rng.integers(3, 8)

    def centre(u):
        return np.stack([2.0 * u, 0 * u, 0 * u], -1)

    def sleeve(u, v):
        angle = 2 * np.pi * v
        r = 0.3 * (1 + 0.15 * np.sin(7 * (0.1 + 0.8 * u))) + 0.012 + 0.01 * (1 + np.sin(turns * angle))
        return np.stack([2.0 * (0.1 + 0.8 * u), r * np.cos(angle), r * np.sin(angle)], -1)

    body = _tube(centre, lambda u: 0.3 * _rounded(u) * (1 + 0.15 * np.sin(7 * u)), 60, 50)
    x, faces, sheet = _joined(body, _grid(56, 64, sleeve, closed=True))
    return faces, x, sheet == 0, sheet


def _stack_scene(rng: np.random.Generator):
    n = int(rng.integers(3, 6))
    phase = rng.uniform(0, 6, 2)

    def wave(k):
        def place(u, v):
            z = 0.04 * np.sin(5 * u + phase[0]) * np.cos(4 * v + phase[1]) + 0.025 * k
            return np.stack([u + 0.003 * k, v + 0.002 * k, z], -1)

        return _grid(32, 32, place)

    x, faces, sheet = _joined(*(wave(k) for k in range(n)))
    return faces, x, np.zeros(len(x), bool), sheet


def _fold(u: np.ndarray, r: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns x and z along a sheet whose second half lies over the first, around a bend of radius r."""
    turn = np.clip((u - 0.5) / r, 0, np.pi)
    x = np.where(u < 0.5, u, 0.5 + r * np.sin(turn) - np.maximum(0, u - 0.5 - np.pi * r))
    return x, np.where(u < 0.5, 0.0, r * (1 - np.cos(turn)))


def _fold_scene(rng: np.random.Generator):
    r = rng.uniform(0.02, 0.03)

    def place(u, v):
        x, z = _fold(u, r)
        return np.stack([x, v + 0.01 * u, z + 0.01 * np.sin(6 * v)], -1)

    x, faces = _grid(60, 50, place)
    return faces, x, np.zeros(len(x), bool), np.full(len(x), -1)


def _soft_scene(rng: np.random.Generator):
    places = [np.zeros(3), np.array([1.18, 0.1, 0.0]), np.array([0.55, 1.1, 0.1])]
    x, faces, _ = _joined(*(_blob(rng, place) for place in places[: rng.integers(2, 4)]))
    return faces, x, np.zeros(len(x), bool), np.full(len(x), -1)


KINDS = {
    "bodies": _body_scene,
    "garments": _garment_scene,
    "stacks": _stack_scene,
    "folds": _fold_scene,
    "soft bodies": _soft_scene,
}
"""Kinds of random damage: each makes faces, free positions, fixed vertices and sheets."""


def damaged(kind: str, seed: int) -> TangledMesh:
    """Returns a mesh of at least 2,000 faces, pushed into itself by one to four smooth random bumps.

    A bump moves the vertices around one along a direction near its normal, by half an edge to four edges in its middle,
    over two to six edges. It is pushed anew until the mesh crosses itself.

    Args:
        kind: A name of :data:`KINDS`.
        seed: Number that the damage depends on, at least 0.
    """
    rng = np.random.default_rng([list(KINDS).index(kind), seed])
    faces, free, fixed, sheet = KINDS[kind](rng)
    mesh = CollisionMesh(faces, len(free), device="cpu")
    finder = IntersectionFinder(mesh)
    if len(finder.find(free).pairs):
        raise AssertionError(f"{kind} {seed} crosses before it is damaged")
    lengths = np.linalg.norm(free[mesh.edges[:, 0]] - free[mesh.edges[:, 1]], axis=1)
    edge = float(np.median(lengths))
    x = free
    while not len(finder.find(x).pairs):
        x = free.copy()
        for _ in range(rng.integers(1, 5)):
            x += _bump(rng, mesh, x, edge, np.flatnonzero(~fixed))
    return TangledMesh(faces, x, free, fixed, sheet)


def _bump(rng: np.random.Generator, mesh: CollisionMesh, x: np.ndarray, edge: float, movable: np.ndarray) -> np.ndarray:
    """Returns the displacement of a random bump around one of the movable vertices."""
    middle, width = rng.choice(movable), rng.uniform(2.0, 6.0)
    rings = np.full(len(x), np.inf)
    rings[middle] = 0
    for ring in range(1, int(3 * width)):
        reached = np.isfinite(rings[mesh.edges])
        new = mesh.edges[reached.any(axis=1)].ravel()
        rings[new] = np.minimum(rings[new], ring)
    a, b, c = (x[mesh.faces[(mesh.faces == middle).any(axis=1), i]] for i in range(3))
    normal = np.cross(b - a, c - a).sum(axis=0)
    direction = rng.choice([-1.0, 1.0]) * normal / np.linalg.norm(normal) + 0.3 * rng.standard_normal(3)
    depth = rng.uniform(0.5, 4.0) * edge / np.linalg.norm(direction)
    return np.exp(-0.5 * (rings / width) ** 2)[:, None] * depth * direction


def _sheets() -> TangledMesh:
    rng = np.random.default_rng(0)
    flat = _grid(40, 40, lambda u, v: np.stack([u, v, 0.002 * rng.standard_normal(u.shape)], -1))
    waves = _grid(
        40, 40, lambda u, v: np.stack([u + 0.011, v + 0.007, 0.03 * np.sin(7 * u) * np.cos(5 * v) + 0.01], -1)
    )
    return _of_sheets(flat, waves, np.array([0.0, 0.0, 0.1]))


def _corner(n: int = 40) -> TangledMesh:
    flat = _grid(n, n, lambda u, v: np.stack([u, v, 0 * u], -1))
    slope = _grid(n, n, lambda u, v: np.stack([u + 0.013, v + 0.0071, 0.3 * (u - 0.7) + 0.0003], -1))
    return _of_sheets(flat, slope, np.array([0.0, 0.0, 0.3]))


def _of_sheets(lower: _Surface, upper: _Surface, lift: np.ndarray) -> TangledMesh:
    """Returns two sheets, of which the upper one is free after it is lifted."""
    x, faces, sheet = _joined(lower, upper)
    return TangledMesh(faces, x, x + (sheet == 1)[:, None] * lift, np.zeros(len(x), bool), sheet)


def _folded() -> TangledMesh:
    rng = np.random.default_rng(0)

    def place(u, v, depth):
        x, z = _fold(u, 0.03)
        sunk = depth * np.exp(-((x - 0.25) ** 2 + (v - 0.5) ** 2) / 0.01) * (u > 0.6)
        return np.stack([x, v, z - sunk], -1)

    free, faces = _grid(50, 50, lambda u, v: place(u, v, 0.0))
    x, _ = _grid(50, 50, lambda u, v: place(u, v, 0.08))
    x[:, 2] += 1e-4 * rng.standard_normal(len(x))
    return TangledMesh(faces, x, free, np.zeros(len(x), bool), np.full(len(x), -1))


KNOWN: dict[str, Callable[..., TangledMesh]] = {"sheets": _sheets, "folded": _folded, "corner": _corner}
"""Known meshes: two sheets through each other in islands, a sunk fold, one sheet through another from border to border.
"""


def load_tangled(path: str) -> TangledMesh:
    """Returns the mesh of a file. Vertices at the same position are one, and faces that thereby lose an edge are gone.

    Args:
        path: A file of any format that trimesh reads.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a readable triangle mesh, or has no triangles or positions that are not finite.
    """
    mesh = read_mesh(path)
    if not np.isfinite(mesh.vertices).all():
        raise ValueError(f"{path}: it has positions that are not finite")
    _, firsts, numbers = np.unique(mesh.vertices, axis=0, return_index=True, return_inverse=True)
    faces = firsts[numbers.reshape(-1)][mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    if not len(faces):
        raise ValueError(f"{path}: it has no triangles with three different corners")
    used, faces = np.unique(faces, return_inverse=True)
    x, faces = np.array(mesh.vertices[used]), faces.reshape(-1, 3)
    return TangledMesh(faces, x, None, np.zeros(len(x), bool), np.full(len(x), -1))
