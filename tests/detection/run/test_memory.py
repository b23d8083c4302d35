"""Memory that does not suffice: an error that says what for, and objects that work once there is some."""

import numpy as np
import pytest
from collision_results import FIELDS
from failing_memory import fail_each

import warp_bsc as bsc

COUNT = 60
"""Triangles that fly through each other, of which each has more pairs than the buffers first hold."""


def flying():
    rng = np.random.default_rng(0)
    x0 = rng.random((3 * COUNT, 3))
    return np.arange(3 * COUNT).reshape(COUNT, 3), x0, x0 + 0.3 * rng.normal(size=x0.shape)


@pytest.mark.parametrize("options", [{}, {"min_distance": 0.01, "rings": 0}])
def test_a_detection_says_what_has_no_room(device, options):
    faces, x0, x1 = flying()

    def make():
        return bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0), device=device), **options)

    def detect(detector):
        found = detector.detect(x0, x1)
        return [getattr(found, field).tobytes() for field in FIELDS]

    messages = fail_each(device, make, detect)
    print("\n".join(messages[::2]), len(messages))
    assert 0
