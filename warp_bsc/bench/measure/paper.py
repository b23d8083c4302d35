"""The paper's benchmarks: time and errors of each method on the candidate pairs of five scenes.

Queries are the candidate pairs of the broad phase in some of a scene's intervals: pairs that share no vertex and whose
swept boxes overlap. If there are too many, a random part of them is measured. All methods read the same arrays.

The exact checker checks every query that any method calls a collision, which includes all that are UNSURE and all that
the methods disagree about, and a random sample of the others.
"""

import contextlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from ... import checker
from ...detection.run.launch import cores, count_cores
from ...detection.run.settings import SURFACE_KINDS, PairKind
from ...kernels.signs import UNSURE
from ..peers import ipc_toolkit
from ..peers.ipc_toolkit import CCD_CLASSES, decide_queries, time_queries
from ..record import shorten_path
from ..scenes.detector import BenchmarkScene, find_overlapping
from .detector import benchmark_detector
from .methods import METHODS, PHASES, MethodRun, Queries, QuerySet, measure_nanoseconds, time_in_turns, trace
from .worst_case import adversarial_queries, find_worst

SEED = 0
_TURNS = 8  # of timing all methods


@dataclass(frozen=True)
class Effort:
    """The amount of measurements."""

    intervals: int  # number of intervals of a scene, evenly spaced
    queries: int  # largest number of queries of a scene
    sample: int  # number of queries of a scene that are checked although no method calls them a collision
    ipc_queries: int  # number of queries of a scene on which the IPC Toolkit is timed
    adversaries: int  # number of adversarial queries of each kind
    repeat: int  # number of repetitions


FULL = Effort(intervals=8, queries=2**19, sample=20_000, ipc_queries=4000, adversaries=100_000, repeat=24)
QUICK = Effort(intervals=2, queries=2**15, sample=1000, ipc_queries=500, adversaries=5000, repeat=3)
"""The effort of the whole benchmark, and of a first look."""


@dataclass(frozen=True)
class Place:
    """A device, and the number of its cores, on which methods are timed."""

    device: wp.Device  # Warp device
    cores: int | None  # CPU cores, None on a GPU
    name: str  # name in tables

    def limited(self) -> contextlib.AbstractContextManager:
        """Returns a context in which kernels run on one core if the place is that."""
        return cores(1) if self.cores == 1 else contextlib.nullcontext()


def to_dict(benchmarks: list[dict[str, Any]], adversarial: list[dict[str, Any]], *, quick: bool) -> dict[str, Any]:
    """Returns measurements of scenes and of :func:`find_adversarial_worst` as plain data for JSON."""
    return {
        "benchmark": "paper",
        "quick": quick,
        "methods": list(METHODS),
        "ipc_toolkit": ipc_toolkit.version() if any(found["ipc_toolkit"] for found in benchmarks) else None,
        "scenes": benchmarks,
        "adversarial": adversarial,
    }


def find_places(devices: list[wp.Device]) -> list[Place]:
    """Returns the places of some devices: one core of the CPU, all cores that may be used, and GPUs."""
    places = []
    for device in devices:
        if device.is_cuda:
            places.append(Place(device, None, device.name))
            continue
        threads = count_cores()
        places.append(Place(device, 1, "CPU, 1 core"))
        if threads > 1:
            places.append(Place(device, threads, f"CPU, {threads} cores"))
    return places


def benchmark_scene(
    name: str,
    intervals: list[tuple[int, BenchmarkScene]],
    places: list[Place],
    effort: Effort,
    *,
    compare: bool = False,
    progress: Callable[[str], None] = lambda doing: None,
) -> dict[str, Any]:
    """Measures all methods on a scene.

    Args:
        name: Name of the scene.
        intervals: Its intervals, with their numbers.
        places: The places at which to time the methods.
        effort: How much to measure.
        compare: Whether to measure the IPC Toolkit as well.
        progress: Called before each part with its name.

    Returns:
        Plain data for JSON: ``name`` and ``scene``, the name in tables and the path; ``triangles``, the number in the
        largest mesh of its intervals; ``precision``, the bits of a coordinate, 32 or 64; ``intervals``, their numbers;
        ``overlapping``, the number of pairs of elements that share no vertex and whose swept boxes overlap;
        ``queries``, the number of these that are measured, by kind; ``collisions``, the number of checked queries that
        collide; ``unsure``, the number of queries that floating point could not certify; ``checked``, the number of
        queries compared with the truth: all that any method calls a collision, and ``sample`` others; ``errors``, by
        method; ``disagreeing``, the number of results of a method that differ between devices, which should be 0;
        ``decided_by``, the number of queries that each of :data:`PHASES` decides; ``timings``, by place;
        ``stage_milliseconds`` and ``frame_milliseconds``, the mean time of a detection with method "exact", by phase
        and in all, on the last place's device [ms]; ``ipc_toolkit``, measurements by its methods; empty without.

    Raises:
        ValueError: If no swept boxes overlap.
    """
    progress("candidate pairs")
    queries, overlapping = gather_queries(intervals, places[-1].device, effort.queries)
    if not overlapping:
        raise ValueError(f"{name}: no pairs: no swept boxes overlap in the intervals measured")

    found_hits, unsure, disagreeing = _find_hits(queries, places, progress)
    progress("the truth")
    errors, collisions, checked, sample, truth = _compare(queries, found_hits, effort)
    decided_by = np.zeros(len(PHASES), dtype=int)
    for found in queries.values():
        decided_by += np.bincount(trace(QuerySet(found, places[-1].device), "exact")[0], minlength=len(PHASES))

    timings = []
    for place in places:
        progress(f"times, {place.name}")
        timings.append(_time_methods(queries, place, effort))
    progress("detections")
    scenes = [scene for _, scene in intervals]
    frames = [benchmark_detector(s, method="exact", device=places[-1].device, repeat=3) for s in scenes]
    took = [frame["milliseconds"] for frame in frames]
    compared = {}
    if compare:
        for method in CCD_CLASSES:
            progress(f"IPC Toolkit, {method}")
            compared[method] = _time_ipc_toolkit(method, queries, truth, effort)
    return {
        "name": ",".join(Path(path).stem if "/" in path or path.endswith(".usd") else path for path in name.split(",")),
        "triangles": max(len(scene.faces) for scene in scenes),
        "precision": 8 * scenes[0].x0.itemsize,
        "intervals": [number for number, _ in intervals],
        "overlapping": overlapping,
        "queries": {kind.label: len(found) for kind, found in queries.items()},
        "collisions": collisions,
        "unsure": unsure,
        "checked": checked,
        "sample": sample,
        "errors": errors,
        "disagreeing": disagreeing,
        "decided_by": dict(zip(PHASES, decided_by.tolist(), strict=True)),
        "timings": timings,
        "stage_milliseconds": {
            phase: float(np.mean([found["stages"][phase] for found in took])) for phase in took[0]["stages"]
        },
        "frame_milliseconds": float(np.mean([found["detect"] for found in took])),
        "ipc_toolkit": compared,
        "scene": shorten_path(name),
    }


def gather_queries(
    intervals: list[tuple[int, BenchmarkScene]], device: wp.Device, max_queries: int
) -> tuple[dict[PairKind, Queries], int]:
    """Returns the overlapping pairs of some intervals by kind, or a random part of them; and their number."""
    random = np.random.default_rng(SEED)
    x0, x1 = (np.concatenate([getattr(scene, end) for _, scene in intervals]) for end in ("x0", "x1"))
    elements, pairs = ({kind: [] for kind in SURFACE_KINDS} for _ in range(2))
    vertices = overlapping = 0
    for _, scene in intervals:
        found = find_overlapping(scene, device)
        number = sum(len(kind_pairs) for _, kind_pairs in found.values())
        overlapping += number
        share = min(1.0, max_queries / len(intervals) / max(number, 1))
        for kind, (kind_elements, kind_pairs) in found.items():
            of_elements = sum(map(len, elements[kind]))
            before = [vertices if kind == PairKind.VERTEX_FACE else of_elements, of_elements]
            count = int(np.ceil(share * len(kind_pairs)))
            chosen = np.sort(random.permutation(len(kind_pairs))[:count])
            pairs[kind].append(kind_pairs[chosen] + np.array(before, dtype=np.int32))
            elements[kind].append(kind_elements + vertices)
        vertices += len(scene.x0)
    joined = {kind: (np.concatenate(elements[kind]), np.concatenate(pairs[kind])) for kind in elements}
    queries = {kind: Queries(kind, x0, x1, *both) for kind, both in joined.items()}
    return {kind: found for kind, found in queries.items() if len(found)}, overlapping


def _find_hits(
    queries: dict[PairKind, Queries], places: list[Place], progress: Callable[[str], None]
) -> tuple[dict[tuple[PairKind, str], np.ndarray], int, int]:
    """Returns which queries collide by kind and method, and the numbers of UNSURE and of device-dependent results."""
    found_hits, unsure, disagreeing = {}, 0, 0
    for place in {str(place.device): place for place in places}.values():
        progress(f"results, {place.device}")
        for kind, found in queries.items():
            on_device = QuerySet(found, place.device)
            for method in METHODS:
                run = MethodRun(method, on_device)
                run.launch()
                hits = run.find_hits()
                if (kind, method) in found_hits:
                    disagreeing += int((found_hits[kind, method] != hits).sum())
                else:
                    found_hits[kind, method] = hits
                    if method == "conservative":
                        unsure += int((run.read_status() == UNSURE).sum())
    return found_hits, unsure, disagreeing


def _compare(
    queries: dict[PairKind, Queries], found_hits: dict[tuple[PairKind, str], np.ndarray], effort: Effort
) -> tuple[dict[str, dict[str, int]], int, int, int, dict[PairKind, tuple[np.ndarray, np.ndarray]]]:
    """Compares the results with the truth.

    Returns:
        Errors by method: its hits, all of which were checked, those that are free, and the collisions among the checked
        queries that it calls free; numbers of collisions, of checked queries and of those in the random sample; and by
        kind the indices of the checked queries with their truth.
    """
    random = np.random.default_rng(SEED)
    total = sum(map(len, queries.values()))
    wrong = {method: np.zeros(3, dtype=int) for method in METHODS}
    collisions = checked = sample = 0
    truths = {}
    for kind, found in queries.items():
        by_method = {method: found_hits[kind, method] for method in METHODS}
        suspicious = np.any(list(by_method.values()), axis=0)
        others = np.flatnonzero(~suspicious)
        some = random.permutation(others)[: int(np.ceil(effort.sample * len(found) / total))]
        indices = np.concatenate([np.flatnonzero(suspicious), some])
        truth = getattr(checker, kind.label)(found.points(indices))
        truths[kind] = indices, truth
        collisions += int(truth.sum())
        checked += len(indices)
        sample += len(some)
        for method, hits in by_method.items():
            hit = hits[indices]
            wrong[method] += [int(hits.sum()), int((hit & ~truth).sum()), int((~hit & truth).sum())]
    names = "hits", "false_positives", "false_negatives"
    errors: dict[str, dict[str, int]] = {}
    for method, counts in wrong.items():
        errors[method] = dict(zip(names, counts.tolist(), strict=True))
    return errors, collisions, checked, sample, truths


def find_adversarial_worst(places: list[Place], effort: Effort) -> list[dict[str, Any]]:
    """Finds the slowest adversarial query of each method, on one core and on GPUs.

    Args:
        places: The places at which to time the methods; other places are skipped.
        effort: How much to measure.

    Returns:
        Plain data for JSON, of each place: ``place``, its name, and ``worst``, by method.
    """
    found = []
    for place in places:
        if place.cores in (1, None):
            queries = [adversarial_queries(kind, effort.adversaries) for kind in SURFACE_KINDS]
            with place.limited():
                found.append({"place": place.name, "worst": _find_slowest(queries, place, effort)})
    return found


def _find_slowest(queries: Iterable[Queries], place: Place, effort: Effort) -> dict[str, dict[str, Any]]:
    slowest = {}
    for of_kind in queries:
        for method, query in find_worst(of_kind, place.device, repeat=effort.repeat).items():
            known = slowest.get(method)
            if known is None or query["nanoseconds"][method] > known["nanoseconds"][method]:
                slowest[method] = query
    return slowest


def _time_methods(queries: dict[PairKind, Queries], place: Place, effort: Effort) -> dict[str, Any]:
    """Returns the mean times of a query by method at a place [ns], and the slowest queries on one core and on GPUs."""
    total = sum(map(len, queries.values()))
    nanoseconds = dict.fromkeys(METHODS, 0.0)
    with place.limited():
        for found in queries.values():
            repeat = -(-effort.repeat // _TURNS)
            took = time_in_turns(
                METHODS, found, place.device, _TURNS, lambda run, repeat=repeat: measure_nanoseconds(run, repeat=repeat)
            )
            for method in METHODS:
                nanoseconds[method] += took[method] * len(found) / total
        worst = _find_slowest(queries.values(), place, effort) if place.cores in (1, None) else {}
    where = {"place": place.name, "device": str(place.device), "device_name": place.device.name, "cores": place.cores}
    return where | {"nanoseconds": nanoseconds, "worst": worst}


def _time_ipc_toolkit(
    method: str, queries: dict[PairKind, Queries], truths: dict[PairKind, tuple[np.ndarray, np.ndarray]], effort: Effort
) -> dict[str, Any]:
    """Measures a method of the IPC Toolkit, on one core: Python calls it query by query.

    Returns:
        The number of queries that were timed, a random part; the mean times of a query and of a call from Python, which
        is not in it [ns]; the number of queries compared with the truth, and of its errors.
    """
    random = np.random.default_rng(SEED)
    total = sum(map(len, queries.values()))
    number = nanoseconds = call = 0
    wrong = np.zeros(3, dtype=int)
    for kind, found in queries.items():
        share = len(found) / total
        some = random.permutation(len(found))[: int(np.ceil(effort.ipc_queries * share))]
        took, called = time_queries(method, kind, found.points(some))
        number += len(some)
        nanoseconds += took * share
        call += called * share
        indices, truth = truths[kind]
        part = random.permutation(len(indices))[: int(np.ceil(effort.ipc_queries * share))]
        hit, truth = decide_queries(method, kind, found.points(indices[part])), truth[part]
        wrong += [len(part), int((hit & ~truth).sum()), int((~hit & truth).sum())]
    checked = dict(zip(("checked", "false_positives", "false_negatives"), wrong.tolist(), strict=True))
    return {"queries": number, "nanoseconds": nanoseconds, "call_nanoseconds": call} | checked
