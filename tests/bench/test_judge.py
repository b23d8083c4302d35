"""The judge of trajectories: what it counts in motions that are known."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from warp_bsc.bench.measure.judge import Judge
from warp_bsc.bench.scenes.contact import SceneBuilder

CELL = 0.1


def sheets(*, boxes=(), gap=0.05, cells=2):
    """Two sheets of square cells, the second above the first, and fixed boxes at heights."""
    builder = SceneBuilder("vbd")
    for height in boxes:
        builder.add_box((0.0, 0.0, height), (0.4, 0.4, 0.02))
    builder.add_cloth((0.0, 0.0, 0.0), (cells, cells), CELL)
    builder.add_cloth((0.013, 0.007, gap), (cells, cells), CELL)
    return builder.finish()


@pytest.fixture(scope="module")
def device():
    with wp.ScopedDevice("cpu"):
        yield


def positions(model):
    return model.particle_q.numpy().astype(np.float64)


def upper(model):
    """The particles of the upper sheet."""
    return slice(model.particle_count // 2, None)


def judge(model, states, steps_per_frame):
    return SimpleNamespace(**Judge(model).judge(states, steps_per_frame))


def test_a_sheet_that_jumps_through_another_meets_it_on_the_way_alone(device):
    model = sheets()
    start = positions(model)
    behind = start.copy()
    behind[upper(model), 2] -= 0.1
    found = judge(model, [start, start, behind, behind], 1)
    assert found.crossings == found.shape_crossings == [0, 0, 0]
    assert found.collisions[0] == found.collisions[2] == 0
    # each particle of a sheet passes a face of the other where there is one, and edges meet edges
    assert found.collisions[1] > 4
    assert found.inverted == [0, 0, 0]
    assert found.stretch == pytest.approx(0.0, abs=1e-4)


def test_a_corner_that_is_pulled_through_crosses_by_its_edges(device):
    model = sheets()
    start = positions(model)
    through = start.copy()
    corner = model.particle_count // 2 + 4  # the middle of the upper sheet, in six faces
    through[corner] = [0.03, 0.01, -0.001]  # within one face of the lower sheet, and little farther
    found = judge(model, [start, through], 1)
    # the six edges at the corner, through that face
    assert found.crossings == [6]
    assert found.shape_crossings == [0]
    assert found.collisions == [1]  # its vertex with one face
    lengths = np.linalg.norm(through[corner] - through[[corner - 1, corner + 1, corner - 3, corner + 3]], axis=1)
    assert found.stretch == pytest.approx(100.0 * (lengths.max() / CELL - 1.0), rel=1e-4)


def test_crossings_with_shapes_count_and_those_of_two_shapes_do_not(device):
    model = sheets(boxes=(-0.1, -0.11, -0.14))  # the first crosses the second and touches the third
    start = positions(model)
    inside = start.copy()
    inside[[0, 1]] += [0.0, 0.0, -0.09]  # an edge of the border within the first box
    found = judge(model, [start, inside], 1)
    at_rest = judge(model, [start, start], 1)
    assert at_rest.crossings == at_rest.collisions == [0]
    assert found.crossings == found.shape_crossings
    assert found.crossings[0] > 0
    lower = slice(model.particle_count // 2)
    start[lower, :2] += [0.013, 0.007]  # no particle above the diagonal of the box
    through = start.copy()
    through[lower, 2] -= 0.09
    (collisions,) = judge(model, [start, through], 1).collisions
    assert collisions > 9  # each particle meets a face of the box, and edges of the sheet meet its diagonal


def test_stretch_is_that_of_edges_that_can_move(device):
    builder = SceneBuilder("vbd")
    builder.add_cloth((0.0, 0.0, 0.0), (2, 2), CELL, is_held=True)  # all but the middle, at which each edge has one end
    model = builder.finish()
    start = positions(model)
    pulled = start.copy()
    pulled[4, 2] += CELL
    stretch = judge(model, [start, pulled], 1).stretch
    assert stretch == pytest.approx(100.0 * (np.sqrt(2.0) - 1.0), rel=1e-4)


def test_frames_are_ends_of_steps(device):
    model = sheets()
    start = positions(model)
    through = start.copy()
    through[upper(model), 2] -= 0.1 * np.linspace(0.0, 1.0, model.particle_count // 2) ** 2
    (worst,) = judge(model, [start, through], 1).crossings
    assert worst > 0
    assert judge(model, [start, through, start, start, through], 2).crossings == [0, worst]
    assert judge(model, [start, through, start, through], 2).crossings == [0, worst]  # the last has one step


def test_inverted_tetrahedra(device):
    builder = SceneBuilder("vbd")
    builder.add_block((0.0, 0.0, 0.0), 1, CELL)
    model = builder.finish()
    start = positions(model)
    mirrored = start * [1.0, 1.0, -1.0]
    assert judge(model, [start, start, mirrored], 1).inverted == [0, model.tet_count]


def test_what_it_cannot_judge(device):
    builder = SceneBuilder("vbd")
    builder.to.add_ground_plane()
    builder.add_cloth((0.0, 0.0, 1.0), (1, 1), CELL)
    with pytest.raises(ValueError, match="neither bodies nor infinite planes"):
        Judge(builder.finish())
    builder = SceneBuilder("vbd")
    builder.to.add_shape_sphere(builder.to.add_body(), radius=0.1)
    builder.add_cloth((0.0, 0.0, 1.0), (1, 1), CELL)
    with pytest.raises(ValueError, match="neither bodies nor infinite planes"):
        Judge(builder.finish())
    model = sheets()
    with pytest.raises(ValueError, match=r"states must have shape \(18, 3\), not \(17, 3\)"):
        judge(model, [positions(model)[1:]] * 2, 1)
    lost = positions(model)
    lost[3] = np.nan
    with pytest.raises(ValueError, match="finite"):
        judge(model, [positions(model), lost], 1)
