"""The paper's benchmarks: what each method takes for the candidate pairs of five scenes, and how often it is wrong.

Queries are the candidate pairs of the broad phase, which share no vertex and whose swept boxes overlap, of some of a
scene's intervals; a random part of them where they are very many. All methods get the same arrays.

Answers are compared with the exact checker's for every query that any method calls a collision, which are all that are
UNSURE and all that methods disagree about, and for a random sample of the others.
"""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from .. import checker
from ..detection.launch import one_core, retry_until_fits
from ..detection.mesh import CollisionMesh
from ..detection.pipeline import DetectionPipeline
from ..kernels.signs import UNSURE
from .detector import benchmark_detector, count_threads
from .ipc_toolkit import PEERS, PeerMeasurement, ask_peer, measure_peer
from .methods import METHODS, STAGES, MethodRun, Queries, QuerySet, measure_nanoseconds, trace_stages
from .scenes import BenchmarkScene
from .worst_case import WorstQuery, adversarial_queries, find_worst

__all__ = [
    "KINDS",
    "Effort",
    "Errors",
    "Place",
    "SceneBenchmark",
    "Timing",
    "benchmark_scene",
    "find_adversarial_worst",
    "find_places",
]

KINDS = ("vertex_face", "edge_edge")
SEED = 0
_TURNS = 8  # in which methods are timed
_GPU_QUERIES = 2**22  # so many at least, by repeating them, are launched at once on a GPU


@dataclass(frozen=True)
class Effort:
    """How much is measured.

    Attributes:
        intervals: Of a scene, evenly spaced.
        queries: Of a scene at most.
        sample: How many queries that no method calls a collision are checked, of a scene.
        peer_queries: How many queries peers are timed on, of a scene.
        adversaries: How many queries of each kind aim at trouble.
        repeat: How many repetitions there are.
    """

    intervals: int
    queries: int
    sample: int
    peer_queries: int
    adversaries: int
    repeat: int

    @classmethod
    def full(cls) -> "Effort":
        """That of the whole benchmark."""
        return cls(intervals=8, queries=2**19, sample=20_000, peer_queries=4000, adversaries=100_000, repeat=24)

    @classmethod
    def quick(cls) -> "Effort":
        """That of a first look."""
        return cls(intervals=2, queries=2**15, sample=1000, peer_queries=500, adversaries=5000, repeat=3)


@dataclass(frozen=True)
class Place:
    """Where methods are timed.

    Attributes:
        device: Warp device.
        cores: CPU cores, None on a GPU.
        name: For people.
    """

    device: wp.Device
    cores: int | None
    name: str


@dataclass(frozen=True)
class Timing:
    """What the methods take at one place.

    Attributes:
        place: Where.
        nanoseconds: Mean time of a query by method [ns].
        worst: The slowest query of each method; empty where it was not looked for.
    """

    place: Place
    nanoseconds: dict[str, float]
    worst: dict[str, WorstQuery]


@dataclass(frozen=True)
class Errors:
    """How the answers of a method compare with the truth.

    Attributes:
        hits: Queries that it calls collisions.
        false_positives: Those of them that are none, all of which were checked.
        false_negatives: Collisions among the checked queries that it does not find.
    """

    hits: int
    false_positives: int
    false_negatives: int


@dataclass(frozen=True)
class SceneBenchmark:
    """The measurements of a scene.

    Attributes:
        name: Of the scene.
        triangles: Of its mesh, the largest of its intervals.
        precision: Bits of a coordinate, 32 or 64.
        intervals: The numbers of the intervals that were measured.
        candidates: How many candidate pairs these have.
        queries: How many of them were asked, by kind.
        collisions: How many of the checked ones collide.
        unsure: How many floating point could not certify.
        checked: How many answers were compared with the truth: all that any method calls a collision and ``sample``.
        sample: How many of them are a random part of the others.
        errors: By method.
        disagreeing: How many answers of a method differ between places; none should.
        stages: How many queries each of :data:`STAGES` decides.
        timings: By place.
        stage_milliseconds: Mean time of a detection by stage, on the last place's device [ms].
        frame_milliseconds: Mean time of a detection with method "exact", likewise [ms].
        peers: Measurements of the IPC Toolkit by method; empty if it was not asked for.
    """

    name: str
    triangles: int
    precision: int
    intervals: list[int]
    candidates: int
    queries: dict[str, int]
    collisions: int
    unsure: int
    checked: int
    sample: int
    errors: dict[str, Errors]
    disagreeing: int
    stages: dict[str, int]
    timings: list[Timing]
    stage_milliseconds: dict[str, float]
    frame_milliseconds: float
    peers: dict[str, PeerMeasurement]


def find_places(devices) -> list[Place]:
    """Where to time methods on some devices: one core of the CPU, all that may be used, and GPUs."""
    places = []
    for device in devices:
        if device.is_cuda:
            places.append(Place(device, None, device.name))
            continue
        threads = count_threads()
        places.append(Place(device, 1, "CPU, 1 core"))
        if threads > 1:
            places.append(Place(device, threads, f"CPU, {threads} cores"))
    return places


def benchmark_scene(
    name,
    intervals: list[tuple[int, BenchmarkScene]],
    places: list[Place],
    effort: Effort,
    *,
    peers=False,
    progress: Callable[[str], None] = lambda doing: None,
) -> SceneBenchmark:
    """Measures all methods on a scene.

    Args:
        name: What to call it.
        intervals: Its intervals, with their numbers.
        places: Where to time the methods.
        effort: How much to measure.
        peers: Whether to measure the IPC Toolkit, too.
        progress: Called with what comes next.

    Returns:
        SceneBenchmark: The measurements.

    Raises:
        ValueError: If there are no candidate pairs.
    """
    progress("candidate pairs")
    queries, candidates = _gather(intervals, places[-1].device, effort.queries)
    if not candidates:
        raise ValueError(f"{name}: no candidate pairs, nothing comes near anything in the intervals measured")

    answers, unsure, disagreeing = _find_answers(queries, places, progress)
    progress("the truth")
    errors, collisions, checked, sample, truth = _compare(queries, answers, effort)
    stages = np.zeros(len(STAGES), dtype=int)
    for found in queries.values():
        stages += np.bincount(trace_stages(QuerySet(found, places[-1].device)), minlength=len(STAGES))

    timings = []
    for place in places:
        progress(f"times, {place.name}")
        timings.append(_time_methods(queries, place, effort))
    progress("detections")
    scenes = [scene for _, scene in intervals]
    frames = [benchmark_detector(s, method="exact", device=places[-1].device, repeat=3) for s in scenes]
    by_stage = [frame.stage_milliseconds for frame in frames]
    found_peers = {}
    if peers:
        for peer in PEERS:
            progress(f"IPC Toolkit, {peer}")
            found_peers[peer] = _measure_peer(peer, queries, truth, effort)
    return SceneBenchmark(
        name=name,
        triangles=max(len(scene.faces) for scene in scenes),
        precision=8 * scenes[0].x0.itemsize,
        intervals=[number for number, _ in intervals],
        candidates=candidates,
        queries={kind: len(found) for kind, found in queries.items()},
        collisions=collisions,
        unsure=unsure,
        checked=checked,
        sample=sample,
        errors=errors,
        disagreeing=disagreeing,
        stages=dict(zip(STAGES, stages.tolist(), strict=True)),
        timings=timings,
        stage_milliseconds={stage: float(np.mean([found[stage] for found in by_stage])) for stage in by_stage[0]},
        frame_milliseconds=float(np.mean([frame.detect_milliseconds for frame in frames])),
        peers=found_peers,
    )


def _gather(intervals, device, most) -> tuple[dict[str, Queries], int]:
    """The candidate pairs of some intervals by kind, or a random part of them; and how many there are."""
    random = np.random.default_rng(SEED)
    x0, x1 = (np.concatenate([getattr(scene, end) for _, scene in intervals]) for end in ("x0", "x1"))
    elements, pairs = ({kind: [] for kind in KINDS} for _ in range(2))
    vertices = candidates = 0
    for _, scene in intervals:
        found = _find_candidates(scene, device)
        number = sum(len(kind_pairs) for _, kind_pairs in found.values())
        candidates += number
        share = min(1.0, most / len(intervals) / max(number, 1))
        for kind, (kind_elements, kind_pairs) in found.items():
            before = [
                vertices if kind == "vertex_face" else sum(map(len, elements[kind])),
                sum(map(len, elements[kind])),
            ]
            count = int(np.ceil(share * len(kind_pairs)))
            chosen = np.sort(random.permutation(len(kind_pairs))[:count])
            pairs[kind].append(kind_pairs[chosen] + np.array(before, dtype=np.int32))
            elements[kind].append(kind_elements + vertices)
        vertices += len(scene.x0)
    queries = {
        kind: Queries(kind, x0, x1, np.concatenate(elements[kind]), np.concatenate(pairs[kind])) for kind in KINDS
    }
    return {kind: found for kind, found in queries.items() if len(found)}, candidates


def _find_candidates(scene, device):
    """Vertices of the elements, and the candidate pairs, by kind."""
    mesh = CollisionMesh(scene.faces, len(scene.x0), device=device)
    pipeline = DetectionPipeline(mesh)
    x0, x1 = (mesh.device_positions(x, name) for x, name in ((scene.x0, "x0"), (scene.x1, "x1")))
    retry_until_fits(lambda: pipeline.find_contacts(x0, x1), pipeline, mesh.device)
    retry_until_fits(pipeline.find_candidates, pipeline, mesh.device)
    queued = pipeline.counts.vertex_face.queued, pipeline.counts.edge_edge.queued
    found = {}
    for narrow_phase, count, elements in zip(pipeline.narrow_phases, queued, (mesh.faces, mesh.edges), strict=True):
        pairs = narrow_phase.queue.numpy()[:count]
        # a GPU finds them in any order
        found[narrow_phase.kind.label] = elements, pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    return found


def _find_answers(queries, places, progress):
    """Which queries collide by each method and kind, how many are unsure, and how many answers depend on the place."""
    answers, unsure, disagreeing = {}, 0, 0
    for place in {str(place.device): place for place in places}.values():
        progress(f"answers, {place.device}")
        for kind, found in queries.items():
            on_device = QuerySet(found, place.device)
            for method in METHODS:
                run = MethodRun(method, on_device)
                run.launch()
                hits = run.find_hits()
                if (kind, method) in answers:
                    disagreeing += int((answers[kind, method] != hits).sum())
                else:
                    answers[kind, method] = hits
                    if method == "conservative":
                        unsure += int((run.status.numpy() == UNSURE).sum())
    return answers, unsure, disagreeing


def _compare(queries, answers, effort):
    """Compares the answers with the truth.

    Returns:
        Errors by method; how many collide, were checked, and are in the random sample; and the checked queries of each
        kind with their truth.
    """
    random = np.random.default_rng(SEED)
    total = sum(map(len, queries.values()))
    wrong = {method: np.zeros(3, dtype=int) for method in METHODS}
    collisions = checked = sample = 0
    truths = {}
    for kind, found in queries.items():
        by_method = {method: answers[kind, method] for method in METHODS}
        suspicious = np.any(list(by_method.values()), axis=0)
        others = np.flatnonzero(~suspicious)
        some = random.permutation(others)[: int(np.ceil(effort.sample * len(found) / total))]
        asked = np.concatenate([np.flatnonzero(suspicious), some])
        truth = getattr(checker, kind)(found.points(asked))
        truths[kind] = asked, truth
        collisions += int(truth.sum())
        checked += len(asked)
        sample += len(some)
        for method, hits in by_method.items():
            hit = hits[asked]
            wrong[method] += [int(hits.sum()), int((hit & ~truth).sum()), int((~hit & truth).sum())]
    errors = {method: Errors(*map(int, counts)) for method, counts in wrong.items()}
    return errors, collisions, checked, sample, truths


def _time_methods(queries, place, effort) -> Timing:
    """Mean times of the methods at a place, and their slowest queries where queries run one beside the other."""
    if place.cores == 1:
        with one_core():
            return _time_methods_here(queries, place, effort, worst=True)
    return _time_methods_here(queries, place, effort, worst=place.device.is_cuda)


def find_adversarial_worst(places, effort) -> list[tuple[Place, dict[str, WorstQuery]]]:
    """The slowest of queries that aim at trouble, by method, on one core and on GPUs.

    Args:
        places: Where methods are timed.
        effort: How much to measure.
    """
    found = []
    for place in places:
        if place.cores in (1, None):
            queries = [adversarial_queries(kind, effort.adversaries) for kind in KINDS]
            with one_core() if place.cores == 1 else contextlib.nullcontext():
                found.append((place, _find_slowest(queries, place, effort)))
    return found


def _find_slowest(queries, place, effort) -> dict[str, WorstQuery]:
    slowest = {}
    for of_kind in queries:
        for method, query in find_worst(of_kind, place.device, repeat=effort.repeat).items():
            known = slowest.get(method)
            if known is None or query.nanoseconds[method] > known.nanoseconds[method]:
                slowest[method] = query
    return slowest


def _time_methods_here(queries, place, effort, *, worst) -> Timing:
    total = sum(map(len, queries.values()))
    nanoseconds = dict.fromkeys(METHODS, 0.0)
    for found in queries.values():
        repeated = -(-_GPU_QUERIES // total) if place.device.is_cuda else 1
        on_device = QuerySet(found, place.device, repeated=repeated)
        runs = {method: MethodRun(method, on_device) for method in METHODS}
        # in turns, of which the fastest counts: what else the machine does at times only slows
        repeat = -(-effort.repeat // _TURNS)
        took = [
            {method: measure_nanoseconds(run, repeat=repeat) for method, run in runs.items()} for _ in range(_TURNS)
        ]
        for method in METHODS:
            nanoseconds[method] += min(turn[method] for turn in took) * len(found) / total
    return Timing(place, nanoseconds, _find_slowest(queries.values(), place, effort) if worst else {})


def _measure_peer(peer, queries, truths, effort) -> PeerMeasurement:
    """Measures a method of the IPC Toolkit, on one core: Python asks one query after the other."""
    random = np.random.default_rng(SEED)
    total = sum(map(len, queries.values()))
    number = nanoseconds = call = 0
    wrong = np.zeros(3, dtype=int)
    for kind, found in queries.items():
        share = len(found) / total
        some = random.permutation(len(found))[: int(np.ceil(effort.peer_queries * share))]
        took, called = measure_peer(peer, kind, found.points(some))
        number += len(some)
        nanoseconds += took * share
        call += called * share
        asked, truth = truths[kind]
        part = random.permutation(len(asked))[: int(np.ceil(effort.peer_queries * share))]
        hit, truth = ask_peer(peer, kind, found.points(asked[part])), truth[part]
        wrong += [len(part), int((hit & ~truth).sum()), int((~hit & truth).sum())]
    return PeerMeasurement(number, nanoseconds, call, *map(int, wrong))
