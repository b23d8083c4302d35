"""Closest points of a surface, against trimesh's for each face."""

import numpy as np
import trimesh

from warp_bsc.detection.at_rest.closest_points import ClosestPointFinder


def test_closest_points_are_the_nearest_of_all_faces():
    rng = np.random.default_rng(3)
    ball = trimesh.creation.icosphere(subdivisions=1)
    x, faces = ball.vertices.astype(np.float32), ball.faces.astype(np.int32)
    points = rng.uniform(-2, 2, (200, 3)).astype(np.float32)
    found = ClosestPointFinder(x, faces).find(points)
    corners = np.repeat(x[faces][None], len(points), axis=0).reshape(-1, 3, 3)
    of_faces = trimesh.triangles.closest_point(corners, np.repeat(points, len(faces), axis=0))
    expected = np.linalg.norm(of_faces.reshape(len(points), -1, 3) - points[:, None], axis=2).min(axis=1)
    np.testing.assert_allclose(found.distances, expected, atol=1e-6)
    places = np.einsum("ni,nij->nj", found.coordinates, x[faces[found.faces]])
    np.testing.assert_allclose(np.linalg.norm(places - points, axis=1), expected, atol=1e-6)
    within = ClosestPointFinder(x, faces).find(points, 0.5)
    assert 20 < np.isinf(within.distances).sum() < 180
    np.testing.assert_array_equal(np.isinf(within.distances), expected > 0.5)
    assert len(ClosestPointFinder(x, faces).find(points[:0]).faces) == 0
