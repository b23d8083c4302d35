"""Distances of point clouds from surfaces, with gradients with respect to the vertices of the surfaces.

Moving a closest point within its triangle changes its distance in the second order only. With barycentric coordinates
b_i held fixed (the envelope theorem), |p - sum b_i x_i|^2 has the derivative -2 b_i (p - sum b_j x_j) by corner x_i.
"""

from typing import Any

import warp as wp

from ..._arguments import check_instance
from ...kernels.closest import between, closest_coordinates
from ...kernels.polynomials import VERTEX_FACE
from ..run.launch import launch
from ..run.settings import NO_GRADIENTS

_IGNORED, _UNKNOWN = wp.constant(-1), wp.constant(-2)  # faces of points without weight, and of what is not finite


@wp.kernel(**NO_GRADIENTS)
def _find_closest(
    # in
    points: wp.array2d[wp.vec3],
    weights: wp.array2d[float],
    x: wp.array2d[wp.vec3],
    faces: wp.array2d[int],
    # out
    closest: wp.array2d[int],
    coordinates: wp.array2d[wp.vec3],
):
    """Finds the face that is closest to a point, and barycentric coordinates of the closest point."""
    surface, i = wp.tid()
    cloud = wp.min(surface, points.shape[0] - 1)
    closest[surface, i] = _IGNORED
    if weights[cloud, i] == 0.0:
        return
    p = wp.vec3d(points[cloud, i])
    nearest = wp.float64(wp.inf)
    is_known = wp.isfinite(weights[cloud, i])
    for face in range(faces.shape[0]):
        corners = wp.vec3i(faces[face, 0], faces[face, 1], faces[face, 2])
        if wp.min(corners) < 0 or wp.max(corners) >= x.shape[1]:
            is_known = False
            continue
        a = wp.vec3d(x[surface, corners[0]])
        u = wp.vec3d(x[surface, corners[1]]) - a
        v = wp.vec3d(x[surface, corners[2]]) - a
        at = closest_coordinates(VERTEX_FACE, u, v, p - a)
        squared = wp.length_sq(between(VERTEX_FACE, at, u, v, p - a))
        is_known = is_known and wp.isfinite(squared)
        if squared < nearest:
            nearest = squared
            closest[surface, i] = face
            coordinates[surface, i] = wp.vec3(wp.vec3d(wp.float64(1.0) - at[0] - at[1], at[0], at[1]))
    if not is_known:
        closest[surface, i] = _UNKNOWN


@wp.kernel(module="unique")
def _add_distances(
    # in
    points: wp.array2d[wp.vec3],
    weights: wp.array2d[float],
    x: wp.array2d[wp.vec3],
    faces: wp.array2d[int],
    closest: wp.array2d[int],
    coordinates: wp.array2d[wp.vec3],
    # in and out
    out: wp.array[float],
):
    """Adds the squared distances of all points of a surface in their order, so that the sum is the same in each run."""
    surface = wp.tid()
    cloud = wp.min(surface, points.shape[0] - 1)
    total = float(0.0)
    for i in range(points.shape[1]):
        face = closest[surface, i]
        if face == _UNKNOWN:
            for vertex in range(x.shape[1]):
                total += wp.nan * wp.dot(x[surface, vertex], points[cloud, i])
        if face >= 0:
            gap = points[cloud, i]
            for corner in range(3):
                gap -= coordinates[surface, i][corner] * x[surface, faces[face, corner]]
            total += weights[cloud, i] * wp.length_sq(gap)
    wp.atomic_add(out, surface, total)


def chamfer_distance(
    points: wp.array2d[wp.vec3],
    x: wp.array2d[wp.vec3],
    faces: wp.array2d[wp.int32],
    *,
    weights: wp.array2d[wp.float32] | None = None,
    out: wp.array[wp.float32] | None = None,
) -> wp.array[wp.float32]:
    """Computes the one-sided chamfer distance of point clouds from surfaces: the mean of squared distances.

    Each point counts with its exact distance from its surface. What no point has seen does not count: clouds may be
    partial. Noise that moves points beyond a border pulls it outwards, by some two standard deviations where nothing
    else holds it. On a :class:`warp.Tape`, ``x``, ``points`` and ``weights`` get gradients. No tree is built: a call
    takes surfaces times points times faces, in double precision on the device, also in graphs. Each run has the same
    bits, except in gradients of a cloud that surfaces share.

    Args:
        points: A cloud for each surface, or one for all, shape [clouds, n].
        x: Vertices of surfaces, shape [surfaces, vertex_count]: of worlds, ``state.particle_q.reshape((worlds, -1))``.
        faces: Vertices of the triangles of each surface, shape [face_count, 3].
        weights: Weight of each point, default 1 / n, shape [clouds, n]; 0 for what fills up clouds, of any coordinates.
        out: Array to which the distances are added, such as those of other frames, shape [surfaces].

    Returns:
        The distances, in squared units, or ``out``, shape [surfaces]. Where a point, weight or corner is not finite, or
        a face has no such vertex, the distance of the surface is NaN, and so are all its gradients.

    Raises:
        TypeError: If an argument is no Warp array of its type.
        ValueError: If a shape or device is wrong, or one of them 0.
    """
    _check(x, "x", wp.vec3, (-1, -1), x)
    _check(points, "points", wp.vec3, (-1, -1), x)
    surfaces, shape, device = x.shape[0], points.shape, x.device
    _check(points, "points", wp.vec3, (surfaces if shape[0] != 1 else 1, -1), x)
    if weights is None:
        weights = wp.full(shape, 1.0 / shape[1], dtype=float, device=device)
    total: wp.array = wp.zeros(surfaces, device=device, requires_grad=x.requires_grad) if out is None else out
    _check(faces, "faces", wp.int32, (-1, 3), x)
    _check(weights, "weights", wp.float32, shape, x)
    _check(total, "out", wp.float32, (surfaces,), x)
    dim = surfaces, shape[1]
    found = [wp.empty(dim, dtype=dtype, device=device) for dtype in (int, wp.vec3)]
    inputs = [points, weights, x, faces]
    launch(_find_closest, dim, inputs=inputs, outputs=found, device=device, record_tape=False)
    launch(_add_distances, surfaces, inputs=[*inputs, *found], outputs=[total], device=device)
    return total


def _check(array: Any, name: str, dtype: Any, shape: tuple[int, ...], like: wp.array) -> None:
    """Raises an error unless this is a Warp array of a type and a shape, -1 for any, on the device of another one."""
    check_instance(array, name, wp.array, "a Warp array")
    if array.dtype is not dtype:
        raise TypeError(f"{name} must be an array of {dtype.__name__}, not of {array.dtype.__name__}")
    fits = array.ndim == len(shape) and all(a == b or b < 0 < a for a, b in zip(array.shape, shape, strict=False))
    if not fits or array.device != like.device:
        wanted = f"have shape {shape}, -1 for any but 0, on {like.device}"
        raise ValueError(f"{name} must {wanted}, not {array.shape} on {array.device}")
