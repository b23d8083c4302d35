"""The part of a scene's time that is checked, and its steps."""

import pytest
from usd_stages import FALLING, add_floor, add_mesh, find, floor_stage, moved, resting_stage


@pytest.fixture
def stage(tmp_path):
    return resting_stage(tmp_path)


def test_frame_ranges(tmp_path, capsys):
    stage = floor_stage(tmp_path)
    heights = [0.25, -0.25, 0.25, 1, 0.25, -0.25]
    add_mesh(stage, "/World/Bouncing", {t: moved(FALLING, (0, 0, z)) for t, z in enumerate(heights)})
    found = find(stage)
    assert [(span["since"], span["until"]) for span in found["collision_spans"]] == [(0, 2), (4, 5)]
    assert sum(span["hits"] for span in found["collision_spans"]) == found["hits"]
    said = f"{found['hits']} collisions from 0 to 2, 4 to 5; "
    assert f"  /World/Bouncing with /World/Floor: 25 cm deep at 1; {said}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("frames", "times"),
    [
        ("1:3", [1, 2, 3]),
        ("1:", [1, 2, 3, 4]),
        (":2", [0, 1, 2]),
        ("0.5:1.5", [0.5, 1, 1.5]),
        ("::2", [0, 2, 4]),
        ("0:4:1.5", [0, 1.5, 3]),
        ("1:3:0.5", [1, 1.5, 2, 2.5, 3]),
    ],
)
def test_frames(stage, frames, times):
    add_floor(stage)
    points = {time: moved(FALLING, (0, 0, 2.25 - time)) for time in range(5)}
    points[3] = moved(FALLING, (0, 0, -0.75 - 1e-3))
    add_mesh(stage, "/World/Falling", points)
    found = find(stage, f"--frames={frames}")
    starts = [interval["start"] for interval in found["intervals"]]
    assert [*starts, found["intervals"][-1]["end"]] == pytest.approx(times)
    assert any("step passes over" in warning for warning in found["warnings"]) == (frames in ("::2", "0:4:1.5"))


def test_steps_do_not_go_over_a_change_of_topology(stage):
    add_floor(stage)
    mesh = add_mesh(stage, "/World/Falling", {time: moved(FALLING, (0, 0, 4 - time)) for time in range(5)})
    for time, corners in ((0, [0, 1, 2]), (3, [0, 2, 1])):
        mesh.GetFaceVertexIndicesAttr().Set(corners, time)
    found = find(stage, "--frames", "::2")
    assert [interval["start"] for interval in found["intervals"]] == [0, 2, 3]
