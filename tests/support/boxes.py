"""Boxes of quads, and the summary of a replay from Python."""

from usd_stages import add_mesh, moved

import warp_bsc as bsc
from warp_bsc.scene_replay.summary import Summary

CORNERS = [(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
SIDES = [0, 2, 3, 1, 4, 5, 7, 6, 0, 1, 5, 4, 2, 6, 7, 3, 0, 4, 6, 2, 1, 3, 7, 5]


def add_box(stage, path, by):
    return add_mesh(stage, path, moved(CORNERS, by), [4] * 6, SIDES)


def sum_up(scene, **options):
    return Summary(scene, "exact", "cpu", [result.summary for result in bsc.replay(scene, device="cpu", **options)])
