"""The choice of the triangles that the page shows."""

import numpy as np

from warp_bsc.replay.page_view import choose_faces


def test_faces_around_places_are_chosen():
    rng = np.random.default_rng(1)
    corners = rng.uniform(0, 1, (20_000, 3))
    places = np.array([(0.1, 0.1, 0.1), (0.9, 0.2, 0.5)])
    wanted = np.array([5, 17, 19_000])
    chosen = choose_faces(corners, places, wanted, 2_000)
    assert np.array_equal(chosen, np.unique(chosen)) and set(wanted) <= set(chosen.tolist())
    assert 100 < len(chosen) <= 2_000
    distance = np.abs(corners[:, None] - places).max(axis=2).min(axis=1)
    near, far = distance[np.setdiff1d(chosen, wanted)].max(), np.delete(distance, chosen).min()
    assert near < 3 * far  # cells, not spheres
    assert len(choose_faces(corners, places, wanted, 20_000)) == 20_000
    assert np.array_equal(choose_faces(corners, corners, wanted, 2), wanted[[0, 2]])  # nothing fits but some of these
