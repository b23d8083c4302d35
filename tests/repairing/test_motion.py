"""Motions of a repair: as far towards a goal as contacts allow, without a collision on the way."""

import numpy as np
import pytest
from sheets import grid

import warp_bsc as bsc
from warp_bsc.repairing.motion import move_freely
from warp_bsc.repairing.surface import Surface


def two_sheets(n):
    """Returns the faces and positions of two sheets of n by n vertices, a third of an edge apart."""
    x, faces = grid(n - 1, np.float64)
    x /= x.max()
    return np.concatenate([faces, faces + n * n]), np.concatenate([x, x + np.array([0.0, 0.0, 0.3 / n])])


@pytest.mark.parametrize(("waves", "height"), [(6.75, 0.17), (6.7, 0.175)])
def test_vertices_that_each_stop_for_another_stop_together(device, waves, height):
    """Where each vertex stops before its first contact, those around it meet it: 40 detections later nothing moves."""
    faces, x = two_sheets(26)
    u, v = x[:, 0], x[:, 1]
    mesh = bsc.CollisionMesh(faces, len(x), device=device)
    surface = Surface(mesh, x, np.zeros(len(x), dtype=bool))
    goal = x + height * np.stack([np.sin(waves * v + 1.0), np.sin(waves * u), np.cos(waves * (u + v))], axis=1)
    start, goal = surface.home, surface.rounded(surface.in_units(goal))
    reached, contacts = move_freely(surface, start, goal)
    found = bsc.CollisionDetector(mesh, method="exact").detect(surface.detected(start), surface.detected(reached))
    assert len(contacts.toi) and not len(found.vertex_face) and not len(found.edge_edge)
    ways = np.linalg.norm(reached - start, axis=1) / np.linalg.norm(goal - start, axis=1)
    assert np.median(ways) > 0.1
