"""Repairs positions that cross: the nearest positions that do not, certified, and what could not be freed."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from .._arguments import check_finite, checked_distance, checked_number, checked_shape
from ..detection.mesh import CollisionMesh
from .approach import approach
from .arguments import checked_layers, checked_mask, host
from .contours import connected_components, trace_contours
from .elastic import Springs
from .layers import separate_layers
from .motion import near_contacts, push_apart
from .results import RepairResult, UnresolvedContour
from .surface import Surface, weld_borders
from .untangle import untangle

__all__ = ["repair"]

_FIXED = "both of its sides are fixed"
_BORDER = "it runs from border to border, so that both sides may be the right one: order or x_previous would tell"
_NOT_FOUND = "no positions without it were found"


def repair(
    mesh: CollisionMesh | np.ndarray | wp.array,
    x: np.ndarray | wp.array,
    *,
    fixed: np.ndarray | wp.array | Sequence[int] | None = None,
    order: np.ndarray | wp.array | Sequence | None = None,
    x_previous: np.ndarray | wp.array | None = None,
    min_distance: float = 0.0,
    max_strain: float = 0.1,
    device: wp.DeviceLike = None,
) -> RepairResult:
    """Returns positions near the given ones at which no edge meets a face, or names what still does.

    The contours along which the surface crosses itself are shortened until none is left, while springs keep its shape.
    From there the surface returns towards the given positions along a path without collisions, as near as contact
    allows. The result is decided exactly in its own type. It never crosses more than the input. Where nothing crosses,
    nothing moves::

        import warp_bsc as bsc

        result = bsc.repair(faces, x, fixed=body_vertices)
        if not result.certified:
            for contour in result.unresolved:
                print(contour.kind, contour.reason, contour.elements)

    Vertices of borders that have the same position are one vertex: the two sides of a seam do not part.

    Args:
        mesh: The mesh, or its faces: vertex indices, integers, shape [face_count, 3]. Its radii are not counted.
        x: Positions, any unit of length, shape [vertex_count, 3], float32 or float64, NumPy or Warp array.
        fixed: Vertices that stay, such as the body under a garment: a mask, bool, shape [vertex_count], or indices,
            integers, shape [n].
        order: Which layers are inside which, for layers that have changed places: groups of vertices (masks or indices
            as of ``fixed``) from inside to outside, or an array with the layer of each vertex, integers, shape
            [vertex_count], -1 for those that have none. The faces of a layer must point to the layers outside it.
        x_previous: A configuration that does not cross, such as the frame before, of the shape and type of ``x``. It
            tells which side is which: the result is reached from it without a collision.
        min_distance: Distance that elements keep, in the unit of the positions: 0 or at least 2^-1021. Pairs that were
            nearer in the input need not.
        max_strain: Largest change of the length of an edge that is sought, as a share of its length in ``x``, more than
            0. The result may exceed it where nothing else is free; ``RepairResult.max_strain`` tells.
        device: Warp device for given faces; default: Warp's default. A mesh has its own.

    Raises:
        TypeError: If an argument has another type.
        ValueError: If an array has another shape or type, is not finite or out of range, ``x_previous`` crosses, a
            number is out of range, or a device is given with a mesh.

    References:
        Pascal Volino and Nadia Magnenat-Thalmann. "Resolving Surface Collisions through Intersection Contour
        Minimization." ACM Transactions on Graphics 25, 3 (2006). https://doi.org/10.1145/1141911.1142007.
    """
    given = checked_shape(host(x), (3,), "x")
    if not isinstance(mesh, CollisionMesh):
        mesh = CollisionMesh(mesh, len(given), device=device)
    elif device is not None:
        raise ValueError("device must be omitted with a mesh, which has its own")
    if len(given) != mesh.vertex_count:
        raise ValueError(f"x must have {mesh.vertex_count} rows, one a vertex, got {len(given)}")
    check_finite(given, "x", mesh.vertices)
    fixed_mask = checked_mask(() if fixed is None else fixed, "fixed", len(given))
    layer = np.full(len(given), -1) if order is None else checked_layers(order, len(given))
    previous = given if x_previous is None else _checked_previous(x_previous, given, mesh)
    distance = checked_distance(min_distance, "min_distance")
    strain = checked_number(max_strain, "max_strain", 0.0, above=True)
    weld = weld_borders(mesh, np.hstack([given, previous]), _labels(mesh, layer))
    welded_mesh = _welded(mesh, weld)
    is_fixed = np.bincount(weld, fixed_mask, len(given)) > 0
    surface = Surface(welded_mesh, given, is_fixed, distance)
    before = surface.crossings(surface.home)
    final = surface.home
    if x_previous is not None:
        reached = _reached(surface, surface.in_units(previous), strain)
        # fixed vertices that contact keeps from their places cannot stay elsewhere
        if len(before) and not (reached != surface.home).any(axis=1)[is_fixed].any():
            final = reached
    elif len(before):
        final = _repaired(surface, before, layer if order is not None else None, strain)
    crossings = surface.crossings(final)
    positions = surface.positions(final)[weld]
    has_moved = (final != surface.home).any(axis=1)[weld]
    result = np.where(has_moved[:, None], positions, given)
    keeps = not surface.min_distance or _keeps_distance(surface, final)
    return RepairResult(
        x=_as_given(result, x),
        certified=not len(crossings) and keeps,
        crossings_before=len(before),
        crossings=len(crossings),
        moved=surface.moves(final)[weld] * surface.unit,
        max_strain=surface.strain(final),
        unresolved=_unresolved(surface, mesh, weld, crossings),
    )


def _checked_previous(x_previous: np.ndarray | wp.array, x: np.ndarray, mesh: CollisionMesh) -> np.ndarray:
    """Returns the configuration before as NumPy."""
    previous = checked_shape(host(x_previous), (3,), "x_previous")
    if previous.dtype != x.dtype or len(previous) != len(x):
        raise ValueError(
            f"x_previous must have the type and the rows of x, {x.dtype} {x.shape}, not {previous.dtype} "
            f"{previous.shape}"
        )
    check_finite(previous, "x_previous", mesh.vertices)
    return previous


def _labels(mesh: CollisionMesh, layer: np.ndarray) -> np.ndarray:
    """Returns what the vertices that are welded have in common beside their position, int, shape [n, 2]."""
    return np.column_stack([layer, np.zeros_like(layer) if mesh.world is None else mesh.world])


def _welded(mesh: CollisionMesh, weld: np.ndarray) -> CollisionMesh:
    """Returns the mesh whose faces and edges use no vertex that is welded to another one, with the same numbers."""
    if mesh.radius is None and not mesh.only_free and (weld == np.arange(len(weld))).all():
        return mesh
    edges = weld[mesh.edges[mesh.free_edges]]
    return CollisionMesh(
        weld[mesh.faces],
        mesh.vertex_count,
        edges=edges[edges[:, 0] != edges[:, 1]],
        world=mesh.world,
        device=mesh.device,
    )


def _repaired(surface: Surface, before: np.ndarray, layer: np.ndarray | None, max_strain: float) -> np.ndarray:
    """Returns the best positions for an input that crosses, in units of the surface."""
    if layer is None:
        start, crossings = surface.home, before
    else:
        start = separate_layers(surface, layer)
        crossings = surface.crossings(start)
    untangled = untangle(surface, start, crossings)
    x = untangled.x
    springs = Springs(surface, untangled.movable if layer is None else ~surface.fixed)
    if surface.min_distance:
        x = push_apart(surface, x)
    x = approach(surface, x, springs, max_strain)
    left = surface.crossings(x)
    if len(left):
        x = _restored(surface, x, before, left)
        left = surface.crossings(x)
    return x if len(left) < len(before) else surface.home


def _reached(surface: Surface, previous: np.ndarray, max_strain: float) -> np.ndarray:
    """Returns the positions nearest to the input that are reached from a configuration that does not cross."""
    if count := len(surface.crossings(previous)):
        raise ValueError(f"x_previous must not cross, but {count} edges meet faces in it")
    return approach(surface, previous, Springs(surface, ~surface.fixed), max_strain)


def _restored(surface: Surface, x: np.ndarray, before: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Returns positions in which parts that still have most of their crossings are as in the input.

    A part is connected by vertices that have moved and by crossings.
    """
    mesh = surface.mesh
    moved = (x != surface.home).any(axis=1)
    links = [mesh.edges[moved[mesh.edges].all(axis=1)]]
    for crossings in (before, left):
        ends, corners = mesh.edges[crossings[:, 0]], mesh.faces[crossings[:, 1]]
        links += [np.stack([ends[:, i], other], axis=1) for i in (0, 1) for other in corners.T]
    part = connected_components(len(x), np.concatenate(links))
    counts = [np.bincount(part[mesh.edges[crossings[:, 0], 0]], minlength=len(x)) for crossings in (before, left)]
    restored = np.where((2 * counts[1] > counts[0])[part][:, None], surface.home, x)
    return restored if len(surface.crossings(restored)) <= len(before) else x


def _as_given(result: np.ndarray, x: np.ndarray | wp.array) -> np.ndarray | wp.array:
    """Returns positions as a Warp array where the input was one, of its type and on its device."""
    return wp.array(result, dtype=x.dtype, device=x.device) if isinstance(x, wp.array) else result


def _unresolved(
    surface: Surface, mesh: CollisionMesh, weld: np.ndarray, crossings: np.ndarray
) -> tuple[UnresolvedContour, ...]:
    """Returns the contours of crossings, with the edges of the given mesh."""
    if not len(crossings):
        return ()
    contours = trace_contours(surface.mesh, crossings)
    fixed = surface.fixed[surface.mesh.edges[crossings[:, 0]]].all(axis=1)
    fixed &= surface.fixed[surface.mesh.faces[crossings[:, 1]]].all(axis=1)
    # an edge of the given mesh for each one of the welded mesh
    n = len(weld)
    keys = np.sort(weld[mesh.edges], axis=1).astype(np.int64) @ np.array([n, 1])
    unique, first = np.unique(keys, return_index=True)
    welded_keys = surface.mesh.edges[crossings[:, 0]].astype(np.int64) @ np.array([n, 1])
    elements = np.column_stack([first[np.searchsorted(unique, welded_keys)], crossings[:, 1]]).astype(np.int32)
    found = []
    for number, kind in enumerate(contours.kinds):
        rows = contours.number == number
        reason = _FIXED if fixed[rows].all() else _BORDER if kind == "border" else _NOT_FOUND
        found.append(UnresolvedContour(elements[rows][np.lexsort(elements[rows].T[::-1])], kind, reason))
    return tuple(found)


def _keeps_distance(surface: Surface, x: np.ndarray) -> bool:
    """Returns whether no pair is nearer than the minimum distance that was not so in the input."""
    return not len(np.setdiff1d(near_contacts(surface, x).keys, near_contacts(surface, surface.home).keys))
