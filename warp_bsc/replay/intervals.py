"""Replays a USD scene: finds the collisions between each two consecutive times, in one process or in several."""

import contextlib
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

from .._arguments import check_instance, checked_choice, checked_distance, checked_flag, checked_integer, given
from ..detection.settings import METHODS, Method
from ..usd.scene import Scene
from .checking import Checks, IntervalChecker
from .results import IntervalResult
from .workers import Cluster, LocalWorkers, check_in_workers, selection_without_initial_in_workers

__all__ = ["replay"]


def replay(
    scene: Scene,
    *,
    method: Method = "exact",
    device: Any = None,
    intersections: bool = True,
    ignore_initial: bool = False,
    min_distance: float | None = None,
    validate_most: int | None = 0,
    earlier: Iterable[IntervalResult] = (),
    workers: int = 1,
    scheduler: str | None = None,
) -> Iterator[IntervalResult]:
    """Finds the collisions in every interval between two consecutive times of a scene, one interval at a time.

    Meshes that never move are obstacles: contacts between these are not counted, nor are contacts of a mesh with itself
    if only its transform moves it. Vertices are taken to move straight from the start of an interval to its end. The
    edges that pass through faces at the times themselves, and the meshes that are wholly inside others, are found as
    well, between obstacles too; among the edges are those of curves::

        import warp_bsc as bsc

        selection = bsc.Selection(exclude=("/World/Hair",))
        scene = bsc.Scene("scene.usd", frames=bsc.FrameRange(101.0, 150.0), selection=selection)
        for interval in bsc.replay(scene, ignore_initial=True):
            contacts = interval.contacts
            for rows in contacts.chunks():  # some pairs at a time, as text takes memory
                for meshes, elements in zip(contacts.mesh_names(rows), contacts.element_names(rows)):
                    print(interval.summary.start, meshes, elements)
            print(contacts.toi, contacts.position, contacts.separate)
            start, end = interval.intersections
            print(start.crossings, start.position[start.crosses], start.cuts.points, end.mesh_names(end.inside_rows))

    Args:
        scene: The scene; its selection says which pairs count.
        method: ``"float"``, ``"conservative"`` or ``"exact"``, for collisions; intersections are always exact.
        device: Warp device or its name; default: Warp's default.
        intersections: Whether to find the intersections at each time, and the meshes that are wholly inside others.
        ignore_initial: Whether to ignore all pairs of meshes that cross at the first time, and meshes that cross
            themselves then: their collisions and intersections are only counted. Of a mesh that is inside another then,
            it is ignored that it is inside that one, nothing else.
        min_distance: Distance up to which elements are found to be near each other at each time, in the scene's unit of
            length, at least 2^-1021: a vertex and a face, or two edges, that share no vertex and that no edge joins. No
            such pair is missing, see :meth:`~warp_bsc.detection.proximities.ProximityFinder.find`; but nothing is found
            between the times, and where an edge passes through a face, both may be far from each other's borders: these
            are intersections. None to look for none.
        validate_most: Number of hits, and of other pairs, of each interval that the exact checker decides again; None
            for all.
        earlier: Results of the first intervals, in order, that an earlier replay has found: they are yielded, and the
            replay goes on after them. They are taken after what crosses at first has been found.
        workers: Number of processes on this machine that check intervals; 1 for this process alone. Each uses its share
            of the cores, or where ``device`` is ``"cuda"`` or None, one GPU. A program that uses more than one must
            have ``if __name__ == "__main__":`` around its statements, as all with :mod:`multiprocessing`.
        scheduler: Address of the scheduler of a Dask cluster, such as ``"tcp://head:8786"``, whose workers check the
            intervals instead; they open the scene by the same path. It needs ``pip install 'warp-bsc[cluster]'``.

    Yields:
        IntervalResult: The collisions of one interval, the same whoever finds them, in order. Only what the caller
        keeps stays in memory; from other processes, at most two chunks of at most 16 intervals for each wait. The next
        intervals are read, and on a CPU one is detected, meanwhile.

    Raises:
        TypeError: If an argument has another type, at the call, as for all errors of arguments.
        ValueError: If the positions at some time are broken, there is no such method, initial intersections are to be
            ignored and none are to be found, or a number is out of range.
        OSError: If no scheduler answers, or if workers die again and again while they check the same intervals.
        ModuleNotFoundError: If Dask is needed and not installed.
    """
    check_instance(scene, "scene", Scene, "a Scene")
    if not isinstance(device, str | None) and not hasattr(device, "alias"):
        raise TypeError(f"device must be a Warp device or its name, not {given(device)}")
    if checked_flag(ignore_initial, "ignore_initial") and not checked_flag(intersections, "intersections"):
        raise ValueError("ignore_initial: what crosses at first can be ignored only if intersections are found")
    check_instance(earlier, "earlier", Iterable, "results of a replay")
    if scheduler is not None:
        check_instance(scheduler, "scheduler", str, "the address of a scheduler")
    if checked_integer(workers, "workers", 1) > 1 and scheduler is not None:
        raise ValueError("workers, scheduler: either processes on this machine, or those of a cluster")
    checks = Checks(
        selection=scene.selection,
        method=checked_choice(method, "method", METHODS),
        device=None if device is None else str(device),
        intersections=checked_flag(intersections, "intersections"),
        min_distance=None if min_distance is None else checked_distance(min_distance, "min_distance", zero=False),
        validate_most=None if validate_most is None else checked_integer(validate_most, "validate_most"),
    )
    return _replay(scene, checks, bool(ignore_initial), earlier, workers, scheduler)


def _replay(
    scene: Scene,
    checks: Checks,
    ignore_initial: bool,
    earlier: Iterable[IntervalResult],
    workers: int,
    scheduler: str | None,
) -> Iterator[IntervalResult]:
    """Yields the results of :func:`replay`, whose arguments have been checked."""
    with contextlib.ExitStack() as stack:
        processes = None
        if scheduler is not None or workers > 1:
            processes = LocalWorkers(workers) if scheduler is None else Cluster(scheduler)
            stack.enter_context(contextlib.closing(processes))
        if ignore_initial:
            if processes:
                selection = selection_without_initial_in_workers(scene, checks, processes)
            else:
                selection = IntervalChecker(scene, checks).selection_without_initial()
            checks = replace(checks, selection=selection)
        first = 0
        for result in earlier:
            yield result
            first = result.summary.index + 1
        if processes:
            yield from check_in_workers(scene, checks, processes, first)
        else:
            yield from IntervalChecker(scene, checks).check(first, len(scene))
