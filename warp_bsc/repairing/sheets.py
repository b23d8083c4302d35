"""Puts sheets of a surface on the sides that their order asks for, where they have changed places."""

import numpy as np

from ..detection.at_rest.body_parts import connect_cells
from .closest import closest_points
from .elastic import Springs, near
from .surface import Surface

_GAP = 0.5
"""Distance from the sheets inside at which a vertex is put, in edges."""
_ALONG_NORMAL = 0.5
"""Least cosine between the way to the closest point of a sheet and its normal; less is beyond the border."""
_RINGS = _SWEEPS = 12


def joined_sheets(sheet: np.ndarray, weld: np.ndarray) -> np.ndarray:
    """Returns the sheet of each vertex, int, shape [n], -1 for those that join two sheets: a seam between them stays.

    ``sheet`` is that of each vertex from inside to outside, -1 for none; ``weld`` is the vertex that it is welded to.
    """
    differs = np.bincount(weld, sheet != sheet[weld], len(sheet)) > 0
    return np.where(differs[weld], -1, sheet)


def separate_sheets(surface: Surface, sheet: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Returns positions in which sheets that cross are on their sides, nearly: contours may remain.

    Parts of a sheet that are behind the sheets inside, bounded by contours, move in front of these: to the side to
    which their faces point. Where the sheet is fixed, the sheets inside move back instead.

    ``sheet`` is that of each vertex from inside to outside, -1 for none, int, shape [n]; they move from positions ``x``
    in units, shape [n, 3].
    """
    for outer in np.unique(sheet[sheet > sheet[sheet >= 0].min(initial=0)]):
        inside, outside = (sheet >= 0) & (sheet < outer), sheet == outer
        if (outside & ~surface.fixed).any():
            x = _put_on_side(surface, x, outside, inside, 1.0)
        else:
            x = _put_on_side(surface, x, inside, outside, -1.0)
    return surface.rounded(x)


def _put_on_side(surface: Surface, x: np.ndarray, moving: np.ndarray, obstacle: np.ndarray, side: float) -> np.ndarray:
    """Returns positions in which moving vertices are on one side of the faces of an obstacle.

    ``moving`` and ``obstacle`` are masks of the vertices; ``side`` is 1 for that to which the faces point, else -1.
    """
    mesh = surface.mesh
    crossings = surface.crossings(surface.rounded(x))
    ends, corners = mesh.edges[crossings[:, 0]], mesh.faces[crossings[:, 1]]
    cuts = moving[ends].all(axis=1) & obstacle[corners].all(axis=1)
    if not cuts.any():
        return x
    (vertices,) = np.nonzero(moving & ~surface.fixed)
    (faces,) = np.nonzero(obstacle[mesh.faces].all(axis=1))
    closest, normals = closest_points(surface, x, faces, x[vertices])
    way = closest - x[vertices]
    behind = np.zeros(len(x), dtype=bool)
    behind[vertices] = side * np.einsum("ij,ij->i", way, normals) > _ALONG_NORMAL * np.linalg.norm(way, axis=1)
    # of these, the parts that contours bound
    part = connect_cells(mesh.edges[behind[mesh.edges].all(axis=1)], len(x))
    a, b, c = (x[corners[cuts, i]] for i in range(3))
    heights = np.einsum("ikj,ij->ik", x[ends[cuts]] - a[:, None], np.cross(b - a, c - a))
    wrong = behind & np.isin(part, part[ends[cuts][side * heights < 0.0]])
    moves = np.zeros_like(x)
    moves[vertices] = way + side * _GAP * surface.edge * normals
    moves[~wrong] = 0.0
    springs = Springs(surface, near(surface, np.flatnonzero(wrong), _RINGS) & moving)
    return x + springs.spread(moves, wrong, _SWEEPS)
