"""The exit status of a replay by its findings."""

import pytest
from usd_stages import FALLING, add_falling, add_floor, add_mesh, moved, new_stage, save

from warp_bsc.cli.main import main


@pytest.fixture
def stage(tmp_path):
    """A triangle falls through a floor from time 0 to 1; another one rests in it, and leaves it from time 2 to 3."""
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    add_falling(stage)
    heights = [-0.25, -0.25, -0.25, 0.25]
    add_mesh(stage, "/World/Resting", {t: moved(FALLING, (-1, 1, z)) for t, z in enumerate(heights)})
    return stage


@pytest.mark.parametrize(
    ("options", "status"),
    [
        ([], 0),
        (["--fail-on", "intersections"], 1),
        (["--fail-on", "collisions,intersections"], 1),
        (["--fail-on", "intersections", "--ignore", "/World/*", "/World/*"], 0),
        (["--fail-on", "collisions", "--prims", "/World/Floor", "/World/Resting", "--frames", "0:2"], 0),
        (["--fail-on", "intersections", "--prims", "/World/Floor", "/World/Falling", "--frames", "0:1"], 1),
        (["--fail-on", "new"], 2),
        (["--fail-on", "anything"], 2),
        (["--fail-on", "intersections", "--no-intersections"], 2),
        (["--ignore-initial", "--no-intersections"], 2),
    ],
)
def test_exit_status(stage, options, status):
    assert main(["replay", save(stage), "--device", "cpu", *options]) == status
