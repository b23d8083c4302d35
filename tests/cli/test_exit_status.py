"""The exit status of a replay by its findings."""

import pytest
from usd_stages import resting_stage, save

from warp_bsc.cli.main import main


@pytest.fixture
def stage(tmp_path):
    return resting_stage(tmp_path)


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
