"""Untangles a surface: shortens the contours along which it crosses itself, until none remains.

References:
    David Baraff, Andrew Witkin, and Michael Kass. "Untangling Cloth." ACM Transactions on Graphics 22, 3 (2003).
    https://doi.org/10.1145/882262.882357.
    Pascal Volino and Nadia Magnenat-Thalmann. "Resolving Surface Collisions through Intersection Contour
    Minimization." ACM Transactions on Graphics 25, 3 (2006). https://doi.org/10.1145/1141911.1142007.
"""

import numpy as np
import warp as wp

from ..detection.run.launch import launch
from .contours import trace_contours
from .elastic import Springs, near, within
from .kernels import contour_gradients
from .surface import Surface, sums

_STEP = 0.25
"""Distance by which an edge and a face move apart in an iteration, in edges."""
_RINGS = 10
"""Edges around contours within which vertices may move, and how many more when these grow."""
_MORE_RINGS = 4
_SPREAD_SWEEPS = 6
_RELAX_SWEEPS = 10
_STUCK = 10
"""Iterations without fewer crossings after which every other one smooths the surface around them."""
_SMOOTHING_SWEEPS = 3
_LONGEST_END = 8
"""Edges of a strand, such as a rope, that may be drawn through a face."""
_PATIENCE = 40
"""Iterations without fewer crossings after which the search ends."""


def untangle(surface: Surface, x: np.ndarray, crossings: np.ndarray) -> tuple[np.ndarray, Springs]:
    """Returns positions with the fewest crossings that are found from a start, and springs of what could move.

    In turn, each edge leaves its face along its own gradient of the contour's length, and all edges of a contour along
    their mean. The moves spread over the surface, and springs restore its lengths and angles. What remains are mostly
    folds that are smaller than a few elements, whose contours have no side to go to: these are smoothed away.

    The start ``x`` is in units of the surface, shape [n, 3]; ``crossings`` are those there, (edge, face), shape [m, 2].
    """
    inner = np.zeros(len(x), dtype=bool)
    springs = Springs(surface, inner)
    best, fewest, since, iteration = (x, springs), len(crossings), 0, 0
    while not surface.are_fixed(crossings).all() and since < _PATIENCE and not surface.is_late:
        vertices = np.hstack([surface.mesh.edges[crossings[:, 0]], surface.mesh.faces[crossings[:, 1]]]).ravel()
        if not inner[vertices].all():
            inner = inner | within(surface, vertices, _MORE_RINGS)
            springs = Springs(surface, near(surface, inner, _RINGS))
        if since >= _STUCK and since % 2 == 0:
            x = springs.spread(x, ~within(surface, vertices, 1), _SMOOTHING_SWEEPS)
        else:
            moves, given = _contour_moves(surface, x, crossings, whole=iteration % 2 == 1)
            x = springs.relax(x + springs.spread(moves, given, _SPREAD_SWEEPS), _RELAX_SWEEPS)
        x = surface.rounded(x)
        crossings = surface.crossings(x)
        iteration, since = iteration + 1, since + 1
        if len(crossings) < fewest:
            best, fewest, since = (x, springs), len(crossings), 0
    return best


def _contour_moves(
    surface: Surface, x: np.ndarray, crossings: np.ndarray, *, whole: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the moves of vertices that shorten contours, in units, and which vertices they are for.

    All edges of a contour move alike if ``whole``.
    """
    mesh = surface.mesh
    ends, corners = mesh.edges[crossings[:, 0]], mesh.faces[crossings[:, 1]]
    along, coordinates, direction = _gradients(surface, x, crossings)
    strands = np.isin(crossings[:, 0], mesh.free_edges)
    if strands.any():
        direction[strands] = _ways_to_ends(surface, x, ends[strands])
    if whole:
        contours = trace_contours(mesh, crossings)
        sign = np.where(contours.sign < 0, -1.0, 1.0)[:, None]
        mean = sums(contours.number, sign * direction, len(contours.kinds))
        direction = sign * (mean / np.maximum(np.linalg.norm(mean, axis=1), 1e-30)[:, None])[contours.number]
    # small elements take small steps, or their strain would be large
    sides = np.linalg.norm(x[corners] - x[np.roll(corners, 1, axis=1)], axis=2).mean(axis=1)
    size = 0.5 * (np.linalg.norm(x[ends[:, 1]] - x[ends[:, 0]], axis=1) + sides)
    step = _STEP * np.minimum(size, surface.edge)[:, None] * direction
    vertices = np.concatenate([ends, corners], axis=1)
    weights = np.concatenate([1.0 - along[:, None], along[:, None], coordinates], axis=1) * ~surface.fixed[vertices]
    # edge and face share the step, unless one of them is fixed
    shares = np.where(weights[:, :2].any(axis=1) & weights[:, 2:].any(axis=1), 0.5, 1.0)[:, None]
    moves = (np.array([1.0, 1.0, -1.0, -1.0, -1.0]) * weights * shares)[:, :, None] * step[:, None, :]
    rows, count = vertices.ravel(), len(x)
    weight = np.maximum(np.bincount(rows, weights.ravel(), count), 0.5)[:, None]
    moves = sums(rows, moves.reshape(-1, 3), count) / weight
    given = (np.bincount(rows, minlength=count) > 0) & ~surface.fixed
    bound = surface.rigid.vertices
    moves[bound] = (surface.rigid.carried(x + moves, surface.home, given) - x)[bound]
    given[bound] = moves[bound].any(axis=1)
    return moves, given


def _ways_to_ends(surface: Surface, x: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Returns the directions in which edges without faces leave a face: away from the end of their strand, or 0."""
    mesh = surface.mesh
    strands = mesh.edges[mesh.free_edges]
    rings = np.where(np.bincount(strands.ravel(), minlength=len(x)) == 1, 0, _LONGEST_END)
    rings[mesh.faces] = _LONGEST_END
    for _ in range(_LONGEST_END):
        nearer = rings[strands].min(axis=1) + 1
        np.minimum.at(rings, strands, np.repeat(nearer[:, None], 2, axis=1))
    first, second = rings[ends].T
    way = (x[ends[:, 1]] - x[ends[:, 0]]) * np.sign(second - first)[:, None]
    return way / np.maximum(np.linalg.norm(way, axis=1), 1e-30)[:, None]


def _gradients(surface: Surface, x: np.ndarray, crossings: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the results of :func:`.kernels.contour_gradients` for positions in units."""
    mesh, n = surface.mesh, len(crossings)
    rows, faces = mesh.edge_faces.find(crossings[:, 0])
    opposite = mesh.faces[faces].sum(axis=1) - mesh.edges[crossings[rows, 0]].sum(axis=1)
    along = wp.empty(n, dtype=wp.float64, device=surface.device)
    coordinates, gradient = (wp.empty(n, dtype=wp.vec3d, device=surface.device) for _ in range(2))
    starts = np.searchsorted(rows, np.arange(n + 1))
    inputs = [surface.array(x), mesh.device_edges, mesh.device_faces, surface.array(crossings, wp.vec2i)]
    inputs += [surface.array(values, int) for values in (starts, opposite)]
    outputs = [along, coordinates, gradient]
    launch(contour_gradients, n, inputs=inputs, outputs=outputs, device=surface.device)
    return along.numpy(), coordinates.numpy(), gradient.numpy()
