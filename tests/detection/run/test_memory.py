"""Memory that does not suffice: an error that says what for, and objects that work once there is some."""

import re

import numpy as np
import pytest
import warp as wp
from collision_results import FIELDS
from failing_memory import fail_each, failing_memory

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
    queue = r"out of memory on \S+: CollisionDetector.detect needs \S+ MB for self.queue in NarrowPhase.grow \(.*\), "
    assert [message for message in messages if re.match(queue + r"[\d,]+ of vec2i.* Less is needed by fewer", message)]
    assert any("self.contacts, self._keys, self._order in NarrowPhase.allocate_contacts" in m for m in messages)


def test_an_array_of_a_program_itself_fails_as_warp_says(device):
    with failing_memory(device, 0), pytest.raises(RuntimeError, match=r"^Failed to allocate 8 bytes") as raised:
        wp.zeros(2, dtype=int, device=device)
    assert not isinstance(raised.value, MemoryError)


@pytest.mark.parametrize("find", ["find_intersections", "find_proximities", "candidates", "collision_free_step"])
def test_other_calls_of_a_detector_do_too(device, find):
    faces, x0, x1 = flying()
    arguments = {"find_proximities": (x0, 0.2), "find_intersections": (x0,)}.get(find, (x0, x1))

    def make():
        return bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0), device=device))

    def call(detector):
        found = getattr(detector, find)(*arguments)
        arrays = [found] if isinstance(found, np.ndarray) else [v for v in vars(found).values() if hasattr(v, "shape")]
        return [np.asarray(array).tobytes() for array in arrays]

    assert all(f"CollisionDetector.{find} needs" in message for message in fail_each(device, make, call))
