"""Repairs positions that cross: the nearest positions that do not, certified, and what could not be freed."""

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from .._arguments import check_finite, checked_distance, checked_number, checked_shape
from ..detection.mesh import CollisionMesh
from .arguments import checked_mask, checked_mesh, checked_seams, checked_sets
from .free import search
from .results import RepairResult, describe
from .sheets import joined_sheets
from .surface import Surface, differ, weld_borders

if TYPE_CHECKING:
    from trimesh import Trimesh


def repair(
    mesh: "CollisionMesh | np.ndarray | wp.array | Trimesh",
    x: np.ndarray | wp.array | None = None,
    *,
    fixed: np.ndarray | wp.array | Sequence[int] | None = None,
    rigid: np.ndarray | wp.array | Sequence | None = None,
    order: np.ndarray | wp.array | Sequence | None = None,
    x_previous: np.ndarray | wp.array | None = None,
    min_distance: float = 0.0,
    seam_tolerance: float = 0.0,
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

    Vertices of borders that have the same position, world, groups and mask are one vertex: the two sides of a seam do
    not part, also if ``order`` has them in two sheets. Pairs of elements that share such a vertex are excluded, as all
    pairs that share a vertex: they touch, and do not count. Faces that lie on each other with all of their corners at
    borders are among them.

    Args:
        mesh: The mesh, or its faces: vertex indices, integers, shape [face_count, 3]; or a ``trimesh.Trimesh``,
            without x. Pairs that its groups and masks leave out do not cross. Each pair keeps the sum of its radii
            beside ``min_distance``: with 0 for skin, 0.002 for a shirt and 0.003 for a jacket, the jacket keeps 0.005
            from the shirt, 0.003 from the skin, and 0.006 from itself.
        x: Positions, any unit of length, shape [vertex_count, 3], float32 or float64, NumPy or Warp array.
        fixed: Vertices that stay, such as the body under a garment: a mask, bool, shape [vertex_count], or indices,
            integers, shape [n].
        rigid: Groups of vertices that move as a whole, such as buttons: an array with the group of each vertex,
            integers, shape [vertex_count], -1 for those that are free, or sets of vertices (masks or indices). Each
            keeps its distances, up to rounding. A group with a fixed vertex stays, and those that share a doubled one
            are one. What crosses within a group stays, and pairs within one keep no ``min_distance``.
        order: Which sheets are inside which, for sheets that have changed places: sets of vertices (masks or indices
            as of ``fixed``) from inside to outside, or an array with the sheet of each vertex, integers, shape
            [vertex_count], -1 for those that have none. The faces of a sheet must point to the sheets outside it.
        x_previous: A configuration that does not cross, such as the frame before, of the shape and type of ``x``. It
            tells which side is which: the result is reached from it without a collision. Groups of ``rigid`` are placed
            in it with their shape in ``x``.
        min_distance: Distance that elements keep, beside radii of the mesh, in the unit of the positions: 0 or at least
            2^-1021. What is nearer is moved apart as far as that is possible; ``RepairResult.near`` tells.
        seam_tolerance: Distance up to which vertices of borders count as one, in the unit of the positions: such seams
            are closed, and both sides get the position of one of them, that of a fixed vertex if there is one. What is
            written here of the input holds for the one with these seams closed. 0 for those in one position alone.
        max_strain: Largest change of the length of an edge that is sought, as a share of its length in ``x``, more than
            0. The result may exceed it where nothing else is free; ``RepairResult.max_strain`` tells.
        time_limit: Time after which the search ends with the best that it has found [s], more than 0: it still ends the
            detection that it is in, and names what is left. None for none.
        device: Warp device for given faces; default: Warp's default. A mesh has its own.

    Raises:
        TypeError: If an argument has another type.
        ValueError: If an array has another shape or type, is not finite or out of range, ``x_previous`` crosses, a
            number is out of range, a device is given with a mesh, or ``seam_tolerance`` makes one of two fixed vertices
            that are apart, or of two corners of a face.
        MemoryError: If the memory of the device does not suffice.

    References:
        Pascal Volino and Nadia Magnenat-Thalmann. "Resolving Surface Collisions through Intersection Contour
        Minimization." ACM Transactions on Graphics 25, 3 (2006). https://doi.org/10.1145/1141911.1142007.
    """
    mesh, given = checked_mesh(mesh, x, device)
    is_fixed = checked_mask(() if fixed is None else fixed, "fixed", len(given))
    sheet = None if order is None else checked_sets(order, "order", len(given))
    groups = None if rigid is None else checked_sets(rigid, "rigid", len(given))
    previous = given
    if x_previous is not None:
        previous = checked_shape(x_previous, (3,), "x_previous")
        if previous.dtype != given.dtype or len(previous) != len(given):
            ours, theirs = (f"{at.dtype} {at.shape}" for at in (given, previous))
            raise ValueError(f"x_previous must have the type and the rows of x, {ours}, not {theirs}")
        check_finite(previous, "x_previous", mesh.vertices)
    distance = checked_distance(min_distance, "min_distance")
    tolerance = checked_distance(seam_tolerance, "seam_tolerance")
    strain = checked_number(max_strain, "max_strain", 0.0, above=True)
    limit = np.inf if time_limit is None else checked_number(time_limit, "time_limit", 0.0, above=True)
    weld = weld_borders(mesh, np.hstack([given, previous]), tolerance=tolerance)
    if tolerance:
        weld = checked_seams(mesh, given, weld, is_fixed)
    opened = differ(given, given[weld])  # by no more than the tolerance
    x_closed = np.where(opened[:, None], given[weld], given)
    surface = Surface(mesh, x_closed, is_fixed, distance, weld=weld, rigid=groups)
    surface.end = time.monotonic() + limit
    history = None if x_previous is None else surface.rounded(surface.in_units(previous))
    if history is not None and (count := len(surface.crossings(history))):
        raise ValueError(f"x_previous must not cross, but {count} edges meet faces in it")
    sheet = None if sheet is None else joined_sheets(sheet, weld)
    before, after, chosen = search(surface, strain, history=history, sheet=sheet)
    positions = surface.positions(after.x)
    found = describe(surface, before, after, chosen, len(given))
    found["moved"][opened] = np.linalg.norm(positions[opened].astype(float) - given[opened], axis=1)
    if isinstance(x, wp.array):
        positions = wp.array(positions, dtype=x.dtype, device=x.device)
    return RepairResult(**found, x=positions)
