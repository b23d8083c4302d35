"""Repairs positions that cross: the nearest positions that do not, certified, and what could not be freed."""

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from .._arguments import check_finite, checked_distance, checked_number, checked_shape
from ..detection.mesh import CollisionMesh
from .approach import approach, score_of
from .arguments import checked_mask, checked_mesh, checked_sheets
from .elastic import Springs
from .free import free, free_by_order, free_by_smoothing, free_in_order, offset, restore_parts
from .motion import near_pairs
from .results import RepairResult
from .surface import Surface, differ, weld_borders, welded
from .unresolved import unresolved_contours

if TYPE_CHECKING:
    from trimesh import Trimesh


def repair(
    mesh: "CollisionMesh | np.ndarray | wp.array | Trimesh",
    x: np.ndarray | wp.array | None = None,
    *,
    fixed: np.ndarray | wp.array | Sequence[int] | None = None,
    order: np.ndarray | wp.array | Sequence | None = None,
    x_previous: np.ndarray | wp.array | None = None,
    min_distance: float = 0.0,
    max_strain: float = 0.1,
    time_limit: float | None = None,
    device: wp.DeviceLike = None,
) -> RepairResult:
    """Returns positions near the given ones at which no edge meets a face, or names what still does.

    The contours along which the surface crosses itself are shortened until none remains, while springs keep its shape.
    From there the surface returns towards the given positions along a path without collisions, as near as contact
    allows. What that does not free is smoothed until it does not cross, and begins from there; of two pieces that cross
    from border to border, one leaves the other to the side where they move less, which ``RepairResult.order`` tells.
    The result is decided exactly in its own type. It never crosses more than the input. Where nothing crosses, nothing
    moves::

        import warp_bsc as bsc

        result = bsc.repair(faces, x, fixed=body_vertices)
        if not result.certified:
            for contour in result.unresolved:
                print(contour.kind, contour.reason, contour.elements)

    Vertices of borders that have the same position, sheet, world, groups and mask are one vertex: the two sides of
    a seam do not part. Pairs of elements that share such a vertex are excluded, as all pairs that share a vertex: they
    touch, and do not count. Faces that lie on each other with all of their corners at borders are among them.

    Args:
        mesh: The mesh, or its faces: vertex indices, integers, shape [face_count, 3]; or a ``trimesh.Trimesh``,
            without x. Its radii are not counted; pairs that its groups and masks leave out do not cross.
        x: Positions, any unit of length, shape [vertex_count, 3], float32 or float64, NumPy or Warp array.
        fixed: Vertices that stay, such as the body under a garment: a mask, bool, shape [vertex_count], or indices,
            integers, shape [n].
        order: Which sheets are inside which, for sheets that have changed places: sets of vertices (masks or indices
            as of ``fixed``) from inside to outside, or an array with the sheet of each vertex, integers, shape
            [vertex_count], -1 for those that have none. The faces of a sheet must point to the sheets outside it.
        x_previous: A configuration that does not cross, such as the frame before, of the shape and type of ``x``. It
            tells which side is which: the result is reached from it without a collision.
        min_distance: Distance that elements keep, in the unit of the positions: 0 or at least 2^-1021. What is nearer
            is moved apart as far as that is possible; ``RepairResult.near`` tells.
        max_strain: Largest change of the length of an edge that is sought, as a share of its length in ``x``, more than
            0. The result may exceed it where nothing else is free; ``RepairResult.max_strain`` tells.
        time_limit: Time after which the search ends with the best that it has found [s], more than 0: it still ends the
            detection that it is in, and names what is left. None for none.
        device: Warp device for given faces; default: Warp's default. A mesh has its own.

    Raises:
        TypeError: If an argument has another type.
        ValueError: If an array has another shape or type, is not finite or out of range, ``x_previous`` crosses, a
            number is out of range, or a device is given with a mesh.

    References:
        Pascal Volino and Nadia Magnenat-Thalmann. "Resolving Surface Collisions through Intersection Contour
        Minimization." ACM Transactions on Graphics 25, 3 (2006). https://doi.org/10.1145/1141911.1142007.
    """
    mesh, given = checked_mesh(mesh, x, device)
    fixed_mask = checked_mask(() if fixed is None else fixed, "fixed", len(given))
    sheet = np.full(len(given), -1) if order is None else checked_sheets(order, len(given))
    previous = given if x_previous is None else _checked_previous(x_previous, given, mesh)
    distance = checked_distance(min_distance, "min_distance")
    strain = checked_number(max_strain, "max_strain", 0.0, above=True)
    limit = np.inf if time_limit is None else checked_number(time_limit, "time_limit", 0.0, above=True)
    weld = weld_borders(mesh, np.hstack([given, previous]), sheet)
    welded_mesh = welded(mesh, weld)
    is_fixed = np.bincount(weld, fixed_mask, len(given)) > 0
    surface = Surface(welded_mesh, given, is_fixed, distance)
    surface.end = time.monotonic() + limit
    before = surface.crossings(surface.home)
    history = None if x_previous is None else surface.in_units(previous)
    if history is not None and (count := len(surface.crossings(history))):
        raise ValueError(f"x_previous must not cross, but {count} edges meet faces in it")
    near_before, chosen = near_pairs(surface, surface.home), np.full(len(given), -1)
    final, crossings, near = surface.home, before, near_before
    if len(before) or len(near_before):
        final, crossings = _repaired(surface, before, history, None if order is None else sheet, strain, chosen)
        near = near_pairs(surface, final)
    if (len(crossings), len(near)) >= (len(before), len(near_before)) or surface.is_wrecked(final):
        final, crossings, near = surface.home, before, near_before
    positions = surface.positions(final)[weld]
    has_moved = differ(final, surface.home)[weld]
    result = np.where(has_moved[:, None], positions, given)
    return RepairResult(
        x=_as_given(result, x),
        certified=not len(crossings) and bool(np.isin(near, near_before).all()),
        crossings_before=len(before),
        crossings=len(crossings),
        near_before=len(near_before),
        near=len(near),
        moved=surface.moves(final)[weld] * surface.unit,
        max_strain=surface.strain(final),
        unresolved=unresolved_contours(surface, mesh, weld, crossings),
        order=chosen[weld] if final is not surface.home and (chosen >= 0).any() else None,
    )


def _checked_previous(x_previous: np.ndarray | wp.array, x: np.ndarray, mesh: CollisionMesh) -> np.ndarray:
    """Returns the configuration before as NumPy."""
    previous = checked_shape(x_previous, (3,), "x_previous")
    if previous.dtype != x.dtype or len(previous) != len(x):
        raise ValueError(
            f"x_previous must have the type and the rows of x, {x.dtype} {x.shape}, not {previous.dtype} "
            f"{previous.shape}"
        )
    check_finite(previous, "x_previous", mesh.vertices)
    return previous


def _repaired(
    surface: Surface,
    before: np.ndarray,
    history: np.ndarray | None,
    sheet: np.ndarray | None,
    max_strain: float,
    chosen: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the best positions that are found, in units of the surface, and what crosses there; they may be worse.

    Writes the sheets whose order it had to choose to ``chosen``.
    """
    if history is not None:
        reached = approach(surface, history, Springs(surface, ~surface.fixed), max_strain)
        # fixed vertices that contact keeps from their places cannot stay elsewhere
        if (reached == surface.home)[surface.fixed].all():
            return reached, surface.crossings(reached)

    def rank(x):
        return surface.is_wrecked(x), len(surface.crossings(x)), *score_of(surface, x, max_strain)

    if sheet is None:
        x, start = surface.home, offset(surface, before)
        if start is not surface.home:
            x = free(surface, start, surface.crossings(start), max_strain, movable=differ(start, surface.home))
        if start is surface.home or score_of(surface, x, max_strain)[0]:
            x = min(x, free(surface, surface.home, before, max_strain), key=rank)
    else:
        x = free_in_order(surface, sheet, surface.home, max_strain)
    left = surface.crossings(x)
    if sheet is None and not surface.are_fixed(left).all():
        x = free_by_order(surface, x, max_strain, rank, chosen)
        x = min(x, free_by_smoothing(surface, x, max_strain), key=rank)
        left = surface.crossings(x)
    if not len(left):
        return x, left
    restored = restore_parts(surface, x, (before, left))
    crossings = surface.crossings(restored)
    return (restored, crossings) if len(crossings) <= len(before) else (x, left)


def _as_given(result: np.ndarray, x: np.ndarray | wp.array | None) -> np.ndarray | wp.array:
    """Returns positions as a Warp array where the input was one, of its type and on its device."""
    return wp.array(result, dtype=x.dtype, device=x.device) if isinstance(x, wp.array) else result
