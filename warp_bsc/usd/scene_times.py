"""Finds the times of a scene: those of all its meshes, with times that differ by rounding alone made one."""

import math
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from .frames import FrameRange
from .interval import times_in_words

if TYPE_CHECKING:
    from .read.meshes import UsdMesh  # which imports pxr

_SAME_TIME = 1e-6
"""Times less apart are one, in time codes, or as a share of the whole time if that is shorter: rounding makes them, and
OpenUSD separates the end of a value clip from the start of the next by them."""


class SceneTimes(NamedTuple):
    """The times of a scene.

    Attributes:
        times: Time codes between which motion is straight, ascending, at least two. The last one is there twice if it
            is the only one, or if meshes change at it: that interval is without motion.
        changes: Those at which meshes change their topology, appear or vanish.
        warnings: Sentences on the changes to the motion.
    """

    times: list[float]
    changes: set[float]
    warnings: list[str]


def find_times(
    meshes: "list[UsdMesh]", frames: FrameRange, subdivide: int, sample_turns: bool, start: float
) -> SceneTimes:
    """Finds the times of a scene, and replaces the times of its meshes by these.

    Args:
        meshes: The meshes.
        frames: The part of the time.
        subdivide: Number of intervals into which each step between two times is divided.
        sample_turns: Whether turning meshes are sampled at every whole time code too, if ``frames`` has no step.
        start: Start of the stage, the time at which a stage is checked in which nothing moves.

    Raises:
        ValueError: If ``frames`` contains no time, or a turn takes too many.
    """
    own = set().union(*(mesh.times | mesh.states.keys() for mesh in meshes)) - {-math.inf}
    if not any(mesh.times for mesh in meshes):
        own.add(start)  # what appears and vanishes does so between moments at rest
    if len(own) == 1:
        (time,) = own
        return SceneTimes([time, time], set(), [f"nothing moves: checked at rest, at time {time:g}"])
    turning = set()
    if sample_turns and frames.step is None:
        low, high = frames.bounds(sorted(own))
        turning = turning.union(*(mesh.turning_times(low, high) for mesh in meshes))
    scene_times = _merge(own | turning)
    for mesh in meshes:
        mesh.take_times(scene_times)
    changes = {time for mesh in meshes for time in mesh.states if time != -math.inf}
    samples = sorted(set(scene_times.values()))
    times = frames.times(samples, changes)
    if len(times) == 1:
        return SceneTimes(times * 2, set(), [f"frames: one time alone: checked at rest, at time {times[0]:g}"])
    warnings = []
    if skipped := sum(times[0] < time < times[-1] for time in set(samples) - set(times)):
        warnings.append(f"frames: the step passes over {skipped} time samples: motion is straight from step to step")
    if subdivide > 1:
        times = [
            start + (end - start) * part / subdivide for start, end in pairwise(times) for part in range(subdivide)
        ] + times[-1:]
    warnings += _change_warnings(meshes, times[0], times[-1])
    if times[-1] in changes:
        times.append(times[-1])
    return SceneTimes(times, changes, warnings)


def _change_warnings(meshes: "list[UsdMesh]", first: float, last: float) -> list[str]:
    """Returns sentences on the meshes that appear, vanish or change their topology between two times.

    There is one for each way in which a mesh changes, and in which the instances of a point instancer do.
    """
    found: dict[tuple[str, str], tuple[set[str], set[float]]] = {}  # names and times by instancer or mesh, and change
    for mesh in meshes:
        owner = mesh.instance.instancer.name if mesh.instance else mesh.name
        for time, change in mesh.changes():
            if first < time <= last:
                names, times = found.setdefault((owner, change), (set(), set()))
                names.add(mesh.name)
                times.add(time)
    warnings = []
    for (owner, change), (names, times) in found.items():
        who = names.pop() if len(names) == 1 else f"each of {len(names):,} meshes of {owner}"
        when = times_in_words(sorted(times))
        warnings.append(f"{who} {change} {when}: its motion is split there, a jump is not checked")
    return warnings


def _merge(times: set[float]) -> dict[float, float]:
    """Returns for each time the one that stands for all that are the same: the one nearest to a whole time code."""
    ordered = sorted(times)
    largest_gap = _SAME_TIME * min(1.0, ordered[-1] - ordered[0])
    merged = []
    for time in ordered:
        if merged and time - merged[-1][0] <= largest_gap:
            merged[-1].append(time)
        else:
            merged.append([time])
    return {time: min(same, key=lambda time: abs(time - round(time))) for same in merged for time in same}
