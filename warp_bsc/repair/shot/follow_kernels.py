"""Kernels that spread the displacement of some vertices over their neighbourhood."""

import warp as wp

wp.set_module_options({"enable_backward": False})

_PEAK = wp.constant(0.5)
"""Weight that stays at a single vertex after one sweep of :func:`smooth`, times the number of sweeps: on a triangle
mesh, the sweeps make a Gaussian whose peak falls with their number."""


@wp.kernel
def smooth(
    # neighbours of each vertex: those of vertex i stand in [first[i], first[i + 1])
    first: wp.array[int],
    neighbours: wp.array[int],
    # in
    values: wp.array[wp.vec4],
    # out
    smoothed: wp.array[wp.vec4],
):
    """Averages the value of each vertex with the mean of its neighbours."""
    i = wp.tid()
    total = wp.vec4()
    for k in range(first[i], first[i + 1]):
        total += values[neighbours[k]]
    count = first[i + 1] - first[i]
    smoothed[i] = values[i]
    if count > 0:
        smoothed[i] = 0.5 * (values[i] + total / float(count))


@wp.kernel
def normalize(
    # in
    values: wp.array[wp.vec4],
    sweeps: int,
    is_movable: wp.array[wp.bool],
    # out
    displacement: wp.array[wp.vec3],
):
    """Divides smoothed displacements by their smoothed weights, at least by the weight of a single vertex.

    Where many vertices are displaced the result is their mean; around a single one it decreases with the distance.
    """
    i = wp.tid()
    displacement[i] = wp.vec3()
    if is_movable[i]:
        value = values[i]
        weight = wp.max(value[3], _PEAK / float(sweeps))
        displacement[i] = wp.vec3(value[0], value[1], value[2]) / weight
