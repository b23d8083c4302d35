"""Tells what a repair has done, and names the contours that it could not free: their elements, kind, and why."""

from typing import Any

import numpy as np

from .contours import trace_contours
from .motion import Faults
from .results import UnresolvedContour
from .surface import Surface

_FIXED = "both of its sides are fixed"
_BORDER = "it runs from border to border, so that both sides may be the right one: order or x_previous would tell"
_LATE = "the time limit ended the search for positions without it"
_NOT_FOUND = "no positions without it were found: order or x_previous may tell where its sides belong"


def describe(surface: Surface, before: Faults, after: Faults, chosen: np.ndarray, count: int) -> dict[str, Any]:
    """Returns what every result of a repair tells, by the names of :class:`.RepairResult`, but for the positions.

    Args:
        surface: The surface.
        before: What is wrong with its input.
        after: What is wrong with the result.
        chosen: Sheet of each vertex whose order was chosen, -1 for none, int, shape [n].
        count: Number of the first vertices that the result is about.
    """
    chosen = chosen[surface.weld][:count]
    is_chosen = len(np.unique(chosen[chosen >= 0])) > 1
    return {
        "certified": not after.count and bool(np.isin(after.near, before.near).all()),
        "crossings_before": len(before.crossings),
        "crossings": len(after.crossings),
        "near_before": len(before.near),
        "near": len(after.near),
        "moved": (surface.moves(after.x)[surface.weld] * surface.unit)[:count],
        "max_strain": surface.strain(after.x),
        "doubled": int((surface.weld != np.arange(len(surface.weld))).sum()),
        "unresolved": _unresolved_contours(surface, after.crossings),
        "order": chosen if is_chosen else None,
    }


def _unresolved_contours(surface: Surface, crossings: np.ndarray) -> tuple[UnresolvedContour, ...]:
    """Returns the contours of crossings, with the edges of the mesh as it was given.

    Args:
        surface: The surface.
        crossings: What crosses, (edge, face) of the surface, shape [m, 2].
    """
    mesh, weld = surface.given, surface.weld
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
