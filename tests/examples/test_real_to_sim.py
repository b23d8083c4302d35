"""The example that finds friction and stiffness: what its camera sees, worlds without gradients, and what it finds."""

import example_diffsim_real_to_sim as program
import numpy as np
import pytest
import trimesh
from newton.viewer import ViewerNull


def start(*options):
    args = program.Example.create_parser().parse_args(["--viewer", "null", *options])
    return program.Example(ViewerNull(), args)


def record(mesh):
    """What the camera records of a mesh."""
    x, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
    return program.record(x, faces, program.EYE, np.random.default_rng(1))


def sheet(centre, side):
    """A level square."""
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    return mesh.apply_scale(side).apply_translation(np.array(centre) - [0.5 * side, 0.5 * side, 0.0])


def test_the_camera_sees_what_neither_the_cloth_nor_the_bar_hides(monkeypatch):
    monkeypatch.setattr(program, "NOISE", 0.0)
    below_another, behind_the_bar, free = (0.4, -0.3, 0.2), (-0.5, 0.0, -0.35), (-0.5, 1.0, 0.1)
    scene = [sheet((0.5, -0.3, 0.4), 0.8), sheet(below_another, 0.05), sheet(behind_the_bar, 0.1), sheet(free, 0.1)]
    mesh = trimesh.util.concatenate(scene)
    points, weights, seen = record(mesh)
    assert set(np.unique(points[:, 2].round(4))) == {0.1, 0.4}
    assert (weights == 1.0 / program.POINTS).all()
    areas = [part.area for part in scene]
    assert seen == pytest.approx((areas[0] + areas[3]) / sum(areas), abs=0.01)


def test_recordings_with_too_few_points_are_filled_up(monkeypatch):
    monkeypatch.setattr(program, "POINTS", 50)
    mesh = trimesh.util.concatenate([sheet((0.3, -0.3, 0.4), 0.03), sheet((-0.5, 0.0, -0.35), 0.3)])
    points, weights, seen = record(mesh)
    assert 0 < (weights > 0.0).sum() < 50
    assert seen == pytest.approx(0.01, abs=0.015)
    assert (points[weights == 0.0] == 0.0).all()


def test_worlds_without_a_gradient_are_counted_and_go_on(monkeypatch, capsys):
    for name, value in {"CELLS": (6, 3), "STEPS": 6, "POINTS": 40}.items():
        monkeypatch.setattr(program, name, value)
    example = start("--worlds", "3")
    example.step()
    gradients = example.logarithms.grad.numpy()
    gradients[1] = np.nan
    example.logarithms.grad.assign(gradients)
    before = example.searches[1].trial
    example.improve()
    assert example.lost.tolist() == [0, 1, 0]
    assert np.isfinite(example.logarithms.numpy()).all()
    best = example.searches[1].x
    assert 0.0 < np.linalg.norm(example.searches[1].trial - best) < np.linalg.norm(before - best)
    example.print_report()
    printed = capsys.readouterr().out
    assert "1 of 3 evaluations without a gradient" in printed
    assert "of the worlds are within 2% of the truth" in printed


@pytest.mark.slow
def test_all_are_found_within_two_percent():
    example = start("--worlds", "2")
    for _ in range(example.num_frames):
        example.step()
    example.test_final()
