"""Distances of point clouds from surfaces, with gradients with respect to the vertices of the surfaces.

The closest point of a triangle moves with its corners, but moving it within the triangle changes the distance in the
second order only. With its barycentric coordinates b_i held fixed (the envelope theorem), the squared distance
|p - sum b_i x_i|^2 has the derivative -2 b_i (p - sum b_i x_i) with respect to corner x_i.
"""

import warp as wp

from ..._arguments import check_instance
from ..._private_names.of_warp import paused_tape
from ...kernels.closest import between, closest_coordinates
from ...kernels.polynomials import VERTEX_FACE
from ..run.launch import launch
from ..run.settings import NO_GRADIENTS

__all__ = ["chamfer_distance"]

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))


@wp.kernel(**NO_GRADIENTS)
def _find_closest(
    # in
    points: wp.array2d[wp.vec3],
    weights: wp.array2d[float],
    x: wp.array2d[wp.vec3],
    faces: wp.array2d[int],
    # out
    closest_face: wp.array2d[int],
    coordinates: wp.array2d[wp.vec3d],
    offset: wp.array2d[wp.vec3d],
    value: wp.array2d[wp.float64],
):
    """Finds the closest point of a surface, its weighted offset from a point, and the weighted squared distance."""
    surface, i = wp.tid()
    cloud = wp.min(surface, points.shape[0] - 1)
    weight = wp.float64(weights[cloud, i])
    closest_face[surface, i] = -1
    value[surface, i] = _ZERO
    if weight == _ZERO:
        return
    p = wp.vec3d(points[cloud, i])
    nearest = wp.float64(wp.inf)
    is_known = wp.isfinite(weight)
    for face in range(faces.shape[0]):
        corners = wp.vec3i(faces[face, 0], faces[face, 1], faces[face, 2])
        if wp.min(corners) < 0 or wp.max(corners) >= x.shape[1]:
            is_known = False
            continue
        a = wp.vec3d(x[surface, corners[0]])
        u = wp.vec3d(x[surface, corners[1]]) - a
        v = wp.vec3d(x[surface, corners[2]]) - a
        at = closest_coordinates(VERTEX_FACE, u, v, p - a)
        from_face = between(VERTEX_FACE, at, u, v, p - a)
        squared = wp.length_sq(from_face)
        is_known = is_known and wp.isfinite(squared)
        if squared < nearest:
            nearest = squared
            closest_face[surface, i] = face
            coordinates[surface, i] = wp.vec3d(_ONE - at[0] - at[1], at[0], at[1])
            offset[surface, i] = weight * from_face
    value[surface, i] = wp.where(is_known, weight * nearest, wp.float64(wp.nan))


@wp.kernel(**NO_GRADIENTS)
def _add_values(value: wp.array2d[wp.float64], out: wp.array[float]):
    """Adds the values of all points of a surface in their order, so that the sum is the same in each run."""
    surface = wp.tid()
    total = wp.float64(0.0)
    for i in range(value.shape[1]):
        total += value[surface, i]
    out[surface] = out[surface] + float(total)


@wp.kernel(**NO_GRADIENTS)
def _add_gradients(
    # in
    faces: wp.array2d[int],
    closest_face: wp.array2d[int],
    coordinates: wp.array2d[wp.vec3d],
    offset: wp.array2d[wp.vec3d],
    value: wp.array2d[wp.float64],
    out_grad: wp.array[float],
    # in and out
    x_grad: wp.array2d[wp.vec3],
):
    """Adds the gradient of a vertex by all points in their order; NaN if a value of its surface is not finite."""
    surface, vertex = wp.tid()
    gradient = wp.vec3d()
    for i in range(value.shape[1]):
        if not wp.isfinite(value[surface, i]):
            gradient += wp.vec3d(wp.float64(wp.nan))
        face = closest_face[surface, i]
        if face >= 0:
            for corner in range(3):
                if faces[face, corner] == vertex:
                    gradient -= wp.float64(2.0) * coordinates[surface, i][corner] * offset[surface, i]
    x_grad[surface, vertex] += wp.vec3(wp.float64(out_grad[surface]) * gradient)


def chamfer_distance(
    points: wp.array2d[wp.vec3],
    x: wp.array2d[wp.vec3],
    faces: wp.array2d[wp.int32],
    *,
    weights: wp.array2d[wp.float32] | None = None,
    out: wp.array[wp.float32] | None = None,
) -> wp.array[wp.float32]:
    """Computes the one-sided chamfer distance of point clouds from surfaces: the mean of squared distances.

    Each point counts with its exact distance from the closest point of the triangles of its surface. Nothing is needed
    of correspondence, and parts of a surface that no point has seen do not count, so that clouds may be partial. On a
    :class:`warp.Tape`, gradients go from the result to ``x``. Noise that lifts points over a border of the surface
    pulls that border outwards, by up to twice its standard deviation where nothing else holds it.

    All is computed on the device, in double precision and always in the same order, also in graphs. No tree is built:
    a call takes clouds times points times triangles, and as many times vertices on the way back.

    Args:
        points: Clouds, shape [clouds, n]: one for each surface, or one for all.
        x: Vertices of the surfaces, shape [surfaces, vertex_count]: of worlds,
            ``state.particle_q.reshape((worlds, -1))``.
        faces: Vertices of each triangle, the same for all surfaces, in [0, vertex_count), shape [face_count, 3].
        weights: Weight of each point in the sum, in place of 1 / n, shape [clouds, n]. Points of weight 0 may have any
            coordinates, so that clouds may have different numbers of points.
        out: Where to add the distances, shape [surfaces]: of several frames, for example.

    Returns:
        The distances, in squared units of the coordinates, or ``out``, shape [surfaces]. Where a point, a weight or a
        corner is not finite, or a face has no such vertex, the distance of the surface and its gradients are NaN.

    Raises:
        TypeError: If an argument is no Warp array of its type.
        ValueError: If a shape or a device is wrong, if there are no points or no faces, if points or weights require
            gradients, which they would not get, or if ``x`` does and ``out`` does not.
    """
    for name, array, dtype, ndim in (("points", points, wp.vec3, 2), ("x", x, wp.vec3, 2), ("faces", faces, wp.int32, 2)):
        _check_array(array, name, dtype, ndim)
    device, (surfaces, vertices), (clouds, n) = x.device, x.shape, points.shape
    if weights is None:
        weights = wp.full(points.shape, 1.0 / max(n, 1), dtype=float, device=device)
    if out is None:
        out = wp.zeros(surfaces, dtype=float, device=device, requires_grad=x.requires_grad)
    _check_array(weights, "weights", wp.float32, 2)
    _check_array(out, "out", wp.float32, 1)
    shapes = {"x": (x, x.shape), "points": (points, (clouds if clouds == 1 else surfaces, n)), "out": (out, (surfaces,))}
    shapes |= {"faces": (faces, (len(faces), 3)), "weights": (weights, points.shape)}
    for name, (array, shape) in shapes.items():
        if array.shape != shape or 0 in shape:
            raise ValueError(f"{name} must have shape {shape}, none of them 0, not {array.shape}")
        if array.device != device:
            raise ValueError(f"{name} must be on {device}, as x, not on {array.device}")
    with paused_tape() as tape:
        closest_face = wp.empty((surfaces, n), dtype=int, device=device)
        coordinates, offset = (wp.empty((surfaces, n), dtype=wp.vec3d, device=device) for _ in range(2))
        value = wp.empty((surfaces, n), dtype=wp.float64, device=device)
        found = [closest_face, coordinates, offset, value]
        launch(_find_closest, (surfaces, n), inputs=[points, weights, x, faces], outputs=found, device=device)
        launch(_add_values, surfaces, inputs=[value], outputs=[out], device=device)
    if tape is None or not x.requires_grad:
        return out
    if points.requires_grad or weights.requires_grad:
        raise ValueError("points and weights must not require gradients, which they would not get")
    if not out.requires_grad:
        raise ValueError("out must require gradients, as x does")

    def backward():
        inputs = [faces, *found, out.grad]
        launch(_add_gradients, (surfaces, vertices), inputs=inputs, outputs=[x.grad], device=device, record_tape=False)

    tape.record_func(backward, [x, out])
    return out


def _check_array(array, name, dtype, ndim):
    """Raises an error unless this is a Warp array of a type with a number of dimensions."""
    check_instance(array, name, wp.array, f"a Warp array of {dtype.__name__}")
    if array.dtype is not dtype:
        raise TypeError(f"{name} must be a Warp array of {dtype.__name__}, not of {array.dtype.__name__}")
    if array.ndim != ndim:
        raise ValueError(f"{name} must have {ndim} dimensions, not {array.ndim}")
