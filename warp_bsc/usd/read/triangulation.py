"""Cuts polygons into triangles."""

import numpy as np


def triangulate(counts: np.ndarray, indices: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cuts polygons into triangles: convex ones as a fan from their first corner, concave ones by clipping ears.

    Args:
        counts: Number of corners of each polygon, at least 3, shape [polygon_count].
        indices: The points at the corners of all polygons, one polygon after the other, shape [sum(counts)].
        points: Positions, shape [point_count, 3].

    Returns:
        The points at the corners of each triangle, shape [triangle_count, 3], and the polygon that it is a part of,
        shape [triangle_count], ascending.
    """
    starts = np.cumsum(counts) - counts
    triangles, polygons = [], []
    for size in np.unique(counts):
        (members,) = np.nonzero(counts == size)
        corners = indices[starts[members, None] + np.arange(size)]  # (members, size)
        fan = np.stack([np.zeros(size - 2, int), np.arange(1, size - 1), np.arange(2, size)], axis=1)
        cut = corners[:, fan]  # (members, size - 2, 3)
        if size > 3:
            positions = points[corners].astype(np.float64)
            edges = np.roll(positions, -1, axis=1) - positions
            turns = np.cross(np.roll(edges, 1, axis=1), edges)
            normals = np.cross(positions - positions[:, :1], edges).sum(axis=1)
            (concave,) = np.nonzero((turns @ normals[:, :, None] < 0).any(axis=(1, 2)))
            for member in concave:
                cut[member] = corners[member][_clip_ears(positions[member], normals[member])]
        triangles.append(cut.reshape(-1, 3))
        polygons.append(np.repeat(members, size - 2))
    polygons = np.concatenate(polygons)
    order = np.argsort(polygons, kind="stable")
    return np.concatenate(triangles)[order], polygons[order]


def _clip_ears(corners, normal) -> list[tuple[int, int, int]]:
    """Cuts one concave polygon, corners of shape [size, 3] around the normal, into triangles of corner indices."""
    axis = int(np.argmax(np.abs(normal)))
    plane = np.roll(corners, -axis - 1, axis=1)[:, :2]  # seen along the axis
    if normal[axis] < 0:
        plane = plane[:, ::-1]

    def is_left(a, b, points):
        (ux, uy), (vx, vy) = plane[b] - plane[a], (points - plane[a]).T
        return ux * vy - uy * vx > 0

    def is_ear(i):
        a, b, c = left[i - 1], left[i], left[(i + 1) % len(left)]
        if not is_left(a, b, plane[[c]])[0]:
            return False
        others = plane[left]
        return not (is_left(a, b, others) & is_left(b, c, others) & is_left(c, a, others)).any()

    triangles, left = [], list(range(len(corners)))
    at = 0
    while len(left) > 2:
        # The search continues from the last ear, so that the triangles of a large polygon do not all share a corner.
        turns = (number % len(left) for number in range(at, at + len(left)))
        ear = next(filter(is_ear, turns), 1)  # a polygon that crosses itself may have no ear
        triangles.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
        at = ear
    return triangles
