"""Bounds of the distance of a pair, in single precision: of boxes, and along a direction that is kept in 30 bits."""

import numpy as np
import warp as wp

from warp_bsc.implicit.contact import barrier, distance_bounds
from warp_bsc.implicit.contact.distance_bounds import direction_in_bits, direction_of_bits
from warp_bsc.kernels.polynomials import EDGE_EDGE, VERTEX_FACE


@wp.kernel(enable_backward=False)
def _bound(
    kind: int,
    points: wp.array[wp.vec3d],
    ways: wp.array[wp.vec3d],
    others: wp.array[wp.vec3d],
    directions: wp.array2d[wp.vec3d],
    values: wp.array2d[wp.float64],
):
    i = wp.tid()
    corners = wp.vec4i(4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 3)
    a, b, c, d = points[corners[0]], points[corners[1]], points[corners[2]], points[corners[3]]
    weights, distance = barrier.closest_weights_and_gap(kind, a, b, c, d)
    n = (weights[0] * a + weights[1] * b + weights[2] * c + weights[3] * d) / distance
    kept = direction_of_bits(direction_in_bits(n))
    other = direction_of_bits(direction_in_bits(others[i]))
    directions[i, 0] = n
    directions[i, 1] = wp.vec3d(kept)
    u, v, w = distance_bounds.seen_from_last(points, corners)
    p, q, r = distance_bounds.seen_from_last(ways, corners)
    rounding = distance_bounds.rounding_of(u, v, w)
    values[i, 0] = distance
    values[i, 1] = wp.float64(distance_bounds.distance_along(kind, kept, u, v, w) - rounding)
    values[i, 2] = wp.float64(distance_bounds.distance_along(kind, other, u, v, w) - rounding)
    values[i, 3] = wp.float64(distance_bounds.distance_of_boxes(kind, u, v, w) - rounding)
    # the least of the distances on the ways of the points, and where each takes a part of its own
    least, apart = distance, distance
    for k in range(1, 17):
        t = wp.float64(k) / wp.float64(16.0)
        e, f = a + t * ways[corners[0]], b + t * ways[corners[1]]
        g, h = c + t * ways[corners[2]], d + t * ways[corners[3]]
        _weights, then = barrier.closest_weights_and_gap(kind, e, f, g, h)
        least = wp.min(least, then)
        bits = int(k)
        e, f = a + wp.float64(bits & 1) * ways[corners[0]], b + wp.float64((bits >> 1) & 1) * ways[corners[1]]
        g, h = c + wp.float64((bits >> 2) & 1) * ways[corners[2]], d + wp.float64((bits >> 3) & 1) * ways[corners[3]]
        _weights_apart, then_apart = barrier.closest_weights_and_gap(kind, e, f, g, h)
        apart = wp.min(apart, then_apart)
    values[i, 4] = least
    rounding += distance_bounds.rounding_of(p, q, r)
    values[i, 5] = wp.float64(distance_bounds.distance_of_ways(kind, u, v, w, p, q, r, wp.vec3()) - rounding)
    values[i, 6] = distance - wp.float64(distance_bounds.way_together(kind, p, q, r))
    s = wp.vec3(ways[corners[3]])
    rounding += distance_bounds.rounding_of(s, s, s)
    values[i, 7] = apart
    values[i, 8] = wp.float64(distance_bounds.distance_of_ways(kind, u, v, w, p + s, q + s, r + s, s) - rounding)


@wp.kernel(enable_backward=False)
def _of_bits(bits: int, direction: wp.array[wp.vec3]):
    direction[0] = direction_of_bits(bits)


def _found(device, kind, points, ways, others):
    """Returns the directions and values of pairs, shapes [n, 2, 3] and [n, 9]."""
    count = len(points)
    directions = wp.zeros((count, 2), dtype=wp.vec3d, device=device)
    values = wp.zeros((count, 9), dtype=wp.float64, device=device)
    inputs = [wp.array(v.reshape(-1, 3), dtype=wp.vec3d, device=device) for v in (points, ways, others)]
    wp.launch(_bound, count, inputs=[int(kind), *inputs], outputs=[directions, values], device=device)
    return directions.numpy(), values.numpy()


def test_bounds_of_distances(device):
    """No bound is more than the distance, at any scale; that along the closest points is nearly as much."""
    random, count = np.random.default_rng(0), 8000
    for kind in (VERTEX_FACE, EDGE_EDGE):
        points = random.normal(size=(count, 4, 3))
        points[: count // 4, :, 2] *= 1e-3  # nearly flat
        points[: count // 8, 3] = points[: count // 8, 2]  # collapsed
        first = 1 if kind == VERTEX_FACE else 2
        points[count // 2 :, :first] += random.normal(size=(count - count // 2, 1, 3)) * random.uniform(0.0, 5.0)
        near = slice(count // 4, count // 2)  # nearly touching
        points[near, 0] = points[near, 1:].mean(axis=1) + 1e-6 * random.normal(size=points[near, 0].shape)
        ways = random.normal(size=(count, 4, 3)) * 10.0 ** random.uniform(-3.0, 0.5, (count, 1, 1))
        ways[::2] += 10.0 * random.normal(size=(len(ways[::2]), 1, 3))  # nearly together
        scale = 10.0 ** random.uniform(-3.0, 0.0, (count, 1, 1))
        scale[::5] = 10.0 ** random.uniform(-40.0, 15.0, (len(scale[::5]), 1, 1))
        points, ways = scale * points, scale * ways
        points[::7] += 100.0 * scale[::7]  # far from the origin
        others = random.normal(size=(count, 3))
        others[::3] = np.eye(3)[random.integers(0, 3, len(others[::3]))]
        others /= np.linalg.norm(others, axis=1, keepdims=True)
        directions, values = _found(device, kind, points, ways, others)
        distance, along, other, of_boxes, least, of_ways, left, apart, of_any_parts = values.T
        exact, kept = directions.transpose(1, 0, 2)
        extent = np.ptp(points, axis=1).max(axis=1)
        is_direction = distance > 1e-12 * extent
        assert (np.linalg.norm(kept, axis=1) <= 1.0).all()
        assert np.abs(kept - exact)[is_direction].max() <= 0.005
        assert (along <= distance).all() and (other <= distance).all() and (of_boxes <= distance).all()
        assert (of_ways <= least).all() and (left <= least).all() and (of_any_parts <= apart).all()
        usual = extent > 1e-15
        assert (along >= distance - 0.02 * extent)[is_direction & usual].all()
        assert (other < 0.9 * distance).any() and (of_boxes > 0.5 * distance)[usual].any()
        assert (of_ways > 0.5 * least)[usual].any() and (left > 0.5 * least)[usual].any()
        assert (of_any_parts > 0.5 * apart)[usual].any()


def test_no_direction(device):
    direction = wp.ones(1, dtype=wp.vec3, device=device)
    wp.launch(_of_bits, 1, inputs=[0], outputs=[direction], device=device)
    assert not direction.numpy().any()
