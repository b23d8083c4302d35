"""Frees a surface: untangles it from a start and returns towards the input; restores the parts that got no better."""

import numpy as np

from .approach import approach
from .contours import connected_components
from .elastic import Springs, near
from .motion import push_apart
from .surface import Surface, differ
from .untangle import untangle

_RINGS = 10
"""Edges around vertices that are pushed apart within which others may follow."""


def free(
    surface: Surface,
    start: np.ndarray,
    crossings: np.ndarray,
    max_strain: float,
    *,
    movable: np.ndarray | None = None,
) -> np.ndarray:
    """Returns positions near the input at which less crosses, or is near, in units of the surface; or worse ones.

    Args:
        surface: The surface.
        start: Where the search begins, in units, shape [n, 3].
        crossings: What crosses there, (edge, face), shape [m, 2].
        max_strain: Largest strain that is sought.
        movable: Vertices that may move, bool, shape [n], beside those near contours and near pairs.
    """
    untangled = untangle(surface, start, crossings)
    x = push_apart(surface, untangled.x) if surface.min_distance else untangled.x
    (pushed,) = np.nonzero(differ(x, untangled.x))
    may_move = untangled.springs.movable | near(surface, pushed, _RINGS)
    if movable is not None:
        may_move |= movable
    is_known = (may_move == untangled.springs.movable).all()
    return approach(surface, x, untangled.springs if is_known else Springs(surface, may_move), max_strain)


def restore_parts(
    surface: Surface,
    x: np.ndarray,
    crossings: tuple[np.ndarray, np.ndarray],
    inside: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Returns positions in which parts that still have most of their faults are as in the input.

    A part is connected by vertices that have moved and by crossings. What is fixed on both sides is no fault of a part.

    Args:
        surface: The surface.
        x: Positions, in units, shape [n, 3].
        crossings: What crosses in the input and at ``x``, (edge, face), shape [m, 2].
        inside: Vertices inside solids in the input and at ``x``, int; default: none.
    """
    mesh = surface.mesh
    moved = differ(x, surface.home)
    links, counts = [surface.edges[moved[surface.edges].all(axis=1)]], []
    crossings = crossings[0][~surface.are_fixed(crossings[0])], crossings[1][~surface.are_fixed(crossings[1])]
    for pairs in crossings:
        ends, corners = mesh.edges[pairs[:, 0]], mesh.faces[pairs[:, 1]]
        links += [np.stack([ends[:, i], other], axis=1) for i in (0, 1) for other in corners.T]
    part = connected_components(len(x), np.concatenate(links))
    for pairs, vertices in zip(crossings, inside or [np.zeros(0, int)] * 2, strict=True):
        faults = np.append(mesh.edges[pairs[:, 0], 0], vertices)
        counts.append(np.bincount(part[faults], minlength=len(x)))
    return np.where((2 * counts[1] > counts[0])[part][:, None], surface.home, x)
