"""Bounds of the distance of a pair along a direction that is kept in 30 bits."""

import numpy as np
import warp as wp

from warp_bsc.implicit.contact.barrier import closest_weights_and_gap, distance_along
from warp_bsc.implicit.contact.vector_access import direction_in_bits, direction_of_bits
from warp_bsc.kernels.polynomials import EDGE_EDGE, VERTEX_FACE


@wp.kernel(enable_backward=False)
def _bound(
    kind: int,
    points: wp.array2d[wp.vec3d],
    others: wp.array[wp.vec3d],
    directions: wp.array2d[wp.vec3d],
    values: wp.array2d[wp.float64],
):
    i = wp.tid()
    a, b, c, d = points[i, 0], points[i, 1], points[i, 2], points[i, 3]
    weights, distance = closest_weights_and_gap(kind, a, b, c, d)
    n = (weights[0] * a + weights[1] * b + weights[2] * c + weights[3] * d) / distance
    kept = direction_of_bits(direction_in_bits(n))
    directions[i, 0] = n
    directions[i, 1] = kept
    values[i, 0] = distance
    values[i, 1] = distance_along(kind, kept, a, b, c, d)
    values[i, 2] = distance_along(kind, direction_of_bits(direction_in_bits(others[i])), a, b, c, d)


@wp.kernel(enable_backward=False)
def _of_bits(bits: int, direction: wp.array[wp.vec3d]):
    direction[0] = direction_of_bits(bits)


def test_distances_along_directions_are_bounds(device):
    """Along that of the closest points, nearly the distance; along any other, no more than that."""
    random, count = np.random.default_rng(0), 4000
    for kind in (VERTEX_FACE, EDGE_EDGE):
        points = random.normal(size=(count, 4, 3)) * 10.0 ** random.uniform(-3.0, 0.0, (count, 1, 1))
        points[: count // 4, :, 2] *= 1e-3  # nearly flat
        first = 1 if kind == VERTEX_FACE else 2
        points[count // 2 :, :first] += random.normal(size=(count - count // 2, 1, 3)) * random.uniform(0.0, 5.0)
        others = random.normal(size=(count, 3))
        others[::3] = np.eye(3)[random.integers(0, 3, len(others[::3]))]
        others /= np.linalg.norm(others, axis=1, keepdims=True)
        directions = wp.zeros((count, 2), dtype=wp.vec3d, device=device)
        values = wp.zeros((count, 3), dtype=wp.float64, device=device)
        inputs = [int(kind), wp.array(points, dtype=wp.vec3d, ndim=2, device=device)]
        inputs += [wp.array(others, dtype=wp.vec3d, device=device)]
        wp.launch(_bound, count, inputs=inputs, outputs=[directions, values], device=device)
        distance, along, other = values.numpy().T
        exact, kept = directions.numpy().transpose(1, 0, 2)
        extent = np.ptp(points, axis=1).max(axis=1)
        assert (np.linalg.norm(kept, axis=1) <= 1.0).all() and np.abs(kept - exact).max() <= 0.005
        rounding = 1e-14 * extent
        assert (along <= distance + rounding).all() and (other <= distance + rounding).all()
        assert (along >= distance - 0.02 * extent).all()
        assert (other < 0.9 * distance).any()


def test_no_direction(device):
    direction = wp.ones(1, dtype=wp.vec3d, device=device)
    wp.launch(_of_bits, 1, inputs=[0], outputs=[direction], device=device)
    assert not direction.numpy().any()
