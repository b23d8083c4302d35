"""Names the contours that a repair could not free: their elements, their kind, and why."""

import numpy as np

from ..detection.mesh import CollisionMesh
from .contours import trace_contours
from .results import UnresolvedContour
from .surface import Surface

_FIXED = "both of its sides are fixed"
_BORDER = "it runs from border to border, so that both sides may be the right one: order or x_previous would tell"
_LATE = "the time limit ended the search for positions without it"
_NOT_FOUND = "no positions without it were found: order or x_previous may tell where its sides belong"


def unresolved_contours(
    surface: Surface, mesh: CollisionMesh, weld: np.ndarray, crossings: np.ndarray
) -> tuple[UnresolvedContour, ...]:
    """Returns the contours of crossings, with the edges of the mesh as it was given.

    Args:
        surface: The surface.
        mesh: The mesh before vertices were welded.
        weld: The vertex that each vertex is welded to, int, shape [n].
        crossings: What crosses, (edge, face) of the surface, shape [m, 2].
    """
    if not len(crossings):
        return ()
    contours, late = trace_contours(surface.mesh, crossings), surface.is_late
    fixed = surface.are_fixed(crossings)
    n = len(weld)
    keys = np.sort(weld[mesh.edges], axis=1).astype(np.int64) @ np.array([n, 1])
    unique, first = np.unique(keys, return_index=True)  # an edge of the given mesh for each one of the welded mesh
    welded_keys = surface.mesh.edges[crossings[:, 0]].astype(np.int64) @ np.array([n, 1])
    elements = np.column_stack([first[np.searchsorted(unique, welded_keys)], crossings[:, 1]]).astype(np.int32)
    found = []
    for number, kind in enumerate(contours.kinds):
        rows = contours.number == number
        reason = _FIXED if fixed[rows].all() else _LATE if late else _BORDER if kind == "border" else _NOT_FOUND
        found.append(UnresolvedContour(elements[rows][np.lexsort(elements[rows].T[::-1])], kind, reason))
    return tuple(found)
