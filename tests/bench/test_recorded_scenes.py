"""The recorded scenes of the paper: they have the size that is said, and collide."""

from pathlib import Path

import numpy as np
import pytest

from warp_bsc.scene_replay.intervals import replay
from warp_bsc.usd.scene import Scene

ASSETS = Path(__file__).parents[2] / "assets"
SCENES = {"twisting": 5000, "funnel": 5000, "dancer": 5000, "flamenco": 8960, "crashing": 14320}
"""Triangles of what deforms."""

each_scene = pytest.mark.parametrize("name", SCENES)


@each_scene
def test_size_and_motion(name):
    path = ASSETS / f"{name}.usd"
    assert path.stat().st_size < 3e6
    scene = Scene(path, sample_turns=False)
    assert not any("topology" in warning for warning in scene.warnings)
    assert 15 <= len(scene.times) <= 40
    segment, x0 = scene.interval(0).segment, scene.interval(0).x0
    deforming = next(mesh for mesh in segment.meshes if mesh.name == "/root/model/triangles")
    assert deforming.faces.stop - deforming.faces.start == SCENES[name]
    assert len(segment.meshes) > 1
    faces = segment.faces[deforming.faces]
    first = np.linalg.norm(x0[faces[:, 1]] - x0[faces[:, 0]], axis=1)
    for interval in scene:
        x1 = interval.x1
        assert interval.segment is segment
        assert np.abs(x1).max() < 5.0  # m
        # nearly all edges are about as long as at first
        low, high = np.quantile(np.linalg.norm(x1[faces[:, 1]] - x1[faces[:, 0]], axis=1) / first, [0.02, 0.98])
        assert low > 0.6 and high < 1.6


@pytest.mark.slow
@each_scene
def test_collisions(name):
    hits, pairs = 0, set()
    for interval in replay(Scene(ASSETS / f"{name}.usd")):
        assert interval.summary.certified
        hits += interval.summary.hits
        pairs |= set(interval.summary.mesh_pairs)
    assert hits >= 100
    assert ("/root/model/triangles", "/root/model/triangles") in pairs
