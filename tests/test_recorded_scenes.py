"""The recorded scenes of the paper: they have the size that is said, and collide."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from warp_bsc.replay import replay
from warp_bsc.scene import Scene

ASSETS = Path(__file__).parents[1] / "assets"
SCENES = {"twisting": 0, "funnel": 0, "dancer": 0, "flamenco": 0, "crashing": 0}  # and triangles of what deforms

each_scene = pytest.mark.parametrize("name", SCENES)


@each_scene
def test_size_and_motion(name):
    path = ASSETS / f"{name}.usd"
    assert path.stat().st_size < 3e6
    scene = Scene(path)
    assert not scene.warnings
    assert 15 <= len(scene.times) <= 40
    segment, x0, _ = scene.interval(0)
    deforming = next(mesh for mesh in segment.meshes if mesh.name == "/root/model/triangles")
    assert deforming.faces.stop - deforming.faces.start == SCENES[name]
    assert len(segment.meshes) > 1
    edges = np.concatenate([segment.faces[:, [0, 1]], segment.faces[:, [1, 2]]])[deforming.faces]
    lengths = [np.linalg.norm(np.diff(x0[edges], axis=1)[:, 0], axis=1)]
    for index in range(len(scene.times) - 1):
        other_segment, x0, x1 = scene.interval(index)
        assert other_segment is segment
        assert np.abs(x0).max() < 10.0  # m
        lengths.append(np.linalg.norm(np.diff(x1[edges], axis=1)[:, 0], axis=1))
    for before, after in pairwise(lengths):
        assert np.median(np.abs(after / before - 1.0)) < 0.1


@each_scene
def test_collisions(name):
    hits, pairs = 0, set()
    for interval, _ in replay(Scene(ASSETS / f"{name}.usd")):
        assert interval.certified
        hits += interval.hits
        pairs |= set(interval.mesh_pairs)
    assert hits >= 100
    assert ("/root/model/triangles", "/root/model/triangles") in pairs
