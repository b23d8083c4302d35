"""Replays a USD scene: finds the collisions between each two consecutive times, in one process or in several."""

import contextlib
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, Literal

from .._arguments import check_instance, checked_choice, checked_distance, checked_flag, checked_integer, given
from ..detection.run.settings import METHODS, Method
from ..usd.scene import Scene
from .checking import Checks, IntervalChecker
from .results import IntervalResult
from .workers import Cluster, LocalWorkers, check_in_workers, checked_workers, selection_without_initial_in_workers


def replay(
    scene: Scene,
    *,
    method: Method = "exact",
    device: Any = None,
    intersections: bool = True,
    ignore_initial: bool = False,
    clearance: float | None = None,
    validate: int | Literal["all"] = 0,
    earlier: Iterable[IntervalResult] = (),
    workers: int | str | None = None,
) -> Iterator[IntervalResult]:
    """Finds the collisions in every interval between two consecutive times of a scene, one interval at a time.

    Meshes that never move are obstacles: contacts between these are not counted, nor are contacts of a mesh with itself
    if only its transform moves it. Vertices move straight from the start of an interval to its end. At the times
    themselves, replay also finds the edges (of meshes and of curves) that pass through faces, and the meshes that are
    wholly inside others, obstacles included::

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
        scene: The scene; its selection defines the pairs that are checked.
        method: ``"float"``, ``"conservative"`` or ``"exact"``, for collisions; intersections are always exact.
        device: Warp device or its name; default: Warp's default. Several names with commas between them, such as
            ``"cuda:0,cuda:1"``, are each for a process of its own, also one named twice; results are the same.
        intersections: Whether to find the intersections at each time, and the meshes that are wholly inside others.
        ignore_initial: Whether to ignore all pairs of meshes that cross at the first time, and meshes that cross
            themselves then: their collisions and intersections are only counted. For a mesh that is inside another
            then, only its being inside that mesh is ignored.
        clearance: Distance up to which proximities are found at each time, in the scene's unit of length, at least
            2^-1021; None finds none. A proximity is a vertex and a face, or two edges, that share no vertex and that no
            edge joins. All of them are found, see :meth:`~warp_bsc.detection.at_rest.proximities.ProximityFinder.find`,
            but only at the times, not between them. An edge that passes through a face, far from the borders of both,
            is an intersection and no proximity.
        validate: Number of hits, and of other pairs, of each interval that the exact checker decides again, chosen at
            random; ``"all"`` decides all of them.
        earlier: Results of the first intervals, in order, that an earlier replay has found. They are yielded first,
            after the initial intersections have been found, and the replay resumes after them.
        workers: Number of processes on this machine that check intervals, 1 for this process alone; or the address of
            the scheduler of a Dask cluster, such as ``"tcp://head:8786"``, whose workers check them. Each process uses
            its share of the cores and, in turns, one of the named devices or, if ``device`` is ``"cuda"`` or None, one
            GPU; default: one process for each named device. With more than one process, a program must have ``if
            __name__ == "__main__":`` around its statements, as :mod:`multiprocessing` requires. The workers of a
            cluster open the scene by the same path, need ``pip install 'warp-bsc[usd,cluster]'``, and each use
            ``device``, one alone, as they see it: dask-cuda gives each a GPU, ``CUDA_VISIBLE_DEVICES`` as well.

    Yields:
        IntervalResult: The collisions of one interval, in order, the same for any number of workers. Only the results
        that the caller keeps stay in memory, five that are ready early, and from other processes at most two chunks of
        16 intervals for each. Meanwhile the next intervals are read and detected; of small meshes, some at once.

    Raises:
        TypeError: If an argument has another type; all errors in arguments are raised at the call.
        ValueError: If the positions at some time are broken, a choice, a device or an address is unknown, a number is
            out of range, or initial intersections are ignored but intersections are not found.
        MemoryError: If the memory of a device does not suffice, after the results of all intervals before.
        OSError: If the scheduler cannot be reached, or if worker after worker dies while it checks the same intervals.
        ModuleNotFoundError: If Dask is needed and not installed.
    """
    check_instance(scene, "scene", Scene, "a Scene")
    if not isinstance(device, str | None) and not hasattr(device, "alias"):
        raise TypeError(f"device must be a Warp device or its name, not {given(device)}")
    if checked_flag(ignore_initial, "ignore_initial") and not checked_flag(intersections, "intersections"):
        raise ValueError("ignore_initial: needs intersections=True, as initial intersections are ignored if found")
    check_instance(earlier, "earlier", Iterable, "results of a replay")
    checked_choice(method, "method", METHODS)
    checks = Checks(
        selection=scene.selection,
        method=method,
        device=None if device is None else str(device),
        intersections=checked_flag(intersections, "intersections"),
        clearance=None if clearance is None else checked_distance(clearance, "clearance", zero=False),
        validate=_checked_validate(validate),
    )
    return _replay(scene, checks, bool(ignore_initial), earlier, checked_workers(workers, checks.device))


def _checked_validate(validate: Any) -> int | Literal["all"]:
    """Returns a number of pairs, or "all"; raises a TypeError or a ValueError for other values."""
    if isinstance(validate, str):
        if validate != "all":
            raise ValueError(f'validate must be "all" or an integer, not {given(validate)}')
        return "all"
    return checked_integer(validate, "validate")


def _replay(
    scene: Scene, checks: Checks, ignore_initial: bool, earlier: Iterable[IntervalResult], workers: Any
) -> Iterator[IntervalResult]:
    """Yields the results of :func:`replay`, whose arguments have been checked."""
    with contextlib.ExitStack() as stack:
        processes = None
        if workers != 1:
            processes = LocalWorkers(workers) if isinstance(workers, int) else workers
            processes = Cluster(processes) if isinstance(processes, str) else processes
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
