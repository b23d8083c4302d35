"""Benchmarks of the detector: how long it takes for a scene, and how long the IPC Toolkit does."""

import contextlib
import importlib.metadata
import os
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp

from ..detection.collisions import StageCounts
from ..detection.detector import CollisionDetector
from ..detection.mesh import CollisionMesh
from .scenes import BenchmarkScene

__all__ = [
    "DetectorBenchmark",
    "IpcToolkitBenchmark",
    "benchmark_detector",
    "benchmark_ipc_toolkit",
    "count_threads",
    "limited_threads",
    "median_milliseconds",
    "replay_graph",
]

_GRAPH_REPLAYS = 20


@dataclass(frozen=True)
class IpcToolkitBenchmark:
    """What the IPC Toolkit took for the same step. It finds the earliest time of impact, not each pair's.

    Attributes:
        version: Of the package ``ipctk``.
        threads: How many it could use.
        broad_phase: Which of its broad phases this is with: the one that gave the shortest time in all.
        vertex_face_candidates: Vertex-face pairs that its broad phase found.
        edge_edge_candidates: Edge-edge pairs that its broad phase found.
        build_milliseconds: Median time to find the candidates [ms].
        step_milliseconds: Median time to find the collision-free step size from the candidates [ms].
        step_size: The collision-free share of the step, 1 if nothing collides.
    """

    version: str
    threads: int
    broad_phase: str
    vertex_face_candidates: int
    edge_edge_candidates: int
    build_milliseconds: float
    step_milliseconds: float
    step_size: float

    @property
    def milliseconds(self) -> float:
        """Time from positions to the step size [ms]."""
        return self.build_milliseconds + self.step_milliseconds


@dataclass(frozen=True)
class DetectorBenchmark:
    """What the detector found in a scene, and what it took.

    Attributes:
        scene: The scene.
        precision: Bits of a coordinate, 32 or 64.
        vertex_face: How many vertex-face pairs entered or left each stage.
        edge_edge: How many edge-edge pairs entered or left each stage.
        hits: Pairs that the method reports.
        earliest_toi: The earliest time of impact, 2.0 if there is none.
        certified: Whether no collision can be missing.
        detect_milliseconds: Median time from positions on the device to the results there [ms]; with method "exact"
            to those on the host.
        read_milliseconds: Median time from positions on the device to the results on the host [ms].
        graph_milliseconds: Median time of 20 replays as a CUDA graph [ms], None on the CPU.
        stage_milliseconds: Median time by stage [ms].
        memory: Device memory of mesh and detector, queues included [bytes], None where nobody counts it.
        ipc_toolkit: The IPC Toolkit's measurements, None if they were not asked for.
    """

    scene: BenchmarkScene
    precision: int
    vertex_face: StageCounts
    edge_edge: StageCounts
    hits: int
    earliest_toi: float
    certified: bool
    detect_milliseconds: float
    read_milliseconds: float
    graph_milliseconds: float | None
    stage_milliseconds: dict[str, float]
    memory: int | None
    ipc_toolkit: IpcToolkitBenchmark | None

    @property
    def candidates(self) -> int:
        """Number of candidate pairs."""
        return self.vertex_face.candidates + self.edge_edge.candidates

    @property
    def survivors(self) -> int:
        """Number of candidate pairs that the culls leave."""
        return self.vertex_face.survivors + self.edge_edge.survivors

    @property
    def unsure(self) -> int:
        """Number of pairs that floating point could not certify either way."""
        return self.vertex_face.unsure + self.edge_edge.unsure

    @property
    def candidates_per_second(self) -> float:
        """Candidate pairs per second, from positions to results on the device."""
        return 1e3 * self.candidates / self.detect_milliseconds


def benchmark_detector(scene, *, method="conservative", device=None, repeat=5, compare=False) -> DetectorBenchmark:
    """Measures a detector on a scene, positions being on the device.

    A first detection, which makes the queues large enough, is not timed.

    Args:
        scene: The :class:`BenchmarkScene`.
        method: Of the detector.
        device: Warp device; default: Warp's default.
        repeat: How many repetitions the medians are of.
        compare: Whether to measure the IPC Toolkit too.

    Returns:
        DetectorBenchmark: The measurements.

    Raises:
        RuntimeError: If a CUDA graph found something else than the detection outside it.
    """
    device = wp.get_device(device)
    counts_memory = device.is_cuda and wp.is_mempool_enabled(device)
    dtype = wp.vec3 if scene.x0.dtype == np.float32 else wp.vec3d
    x0, x1 = (wp.array(x, dtype=dtype, device=device) for x in (scene.x0, scene.x1))
    before = wp.get_mempool_used_mem_current(device) if counts_memory else 0
    mesh = CollisionMesh(scene.faces, len(scene.x0), device=device)
    detector = CollisionDetector(mesh, method=method)
    detector.detect(x0, x1)
    memory = wp.get_mempool_used_mem_current(device) - before if counts_memory else None

    detect, read, stages = [], [], []
    for _ in range(repeat):
        wp.synchronize_device(device)
        start = time.perf_counter()
        collisions = detector.detect(x0, x1)
        wp.synchronize_device(device)
        detect.append(1e3 * (time.perf_counter() - start))
        stats = collisions.stats  # reads everything else with it
        read.append(1e3 * (time.perf_counter() - start))
        stages.append(stats.milliseconds)
    return DetectorBenchmark(
        scene=scene,
        precision=8 * scene.x0.itemsize,
        vertex_face=stats.vertex_face,
        edge_edge=stats.edge_edge,
        hits=len(collisions.vertex_face) + len(collisions.edge_edge),
        earliest_toi=collisions.earliest_toi,
        certified=collisions.certified,
        detect_milliseconds=statistics.median(detect),
        read_milliseconds=statistics.median(read),
        graph_milliseconds=_replay_detection(detector, x0, x1, stats) if device.is_cuda else None,
        stage_milliseconds={stage: statistics.median(run[stage] for run in stages) for stage in stages[0]},
        memory=memory,
        ipc_toolkit=benchmark_ipc_toolkit(scene, mesh.edges, repeat=repeat) if compare else None,
    )


def _replay_detection(detector, x0, x1, stats) -> float:
    """The median time of a replay of the detection as a CUDA graph [ms]."""
    device = detector.mesh.device
    with wp.ScopedCapture(device) as capture:
        captured = detector.detect(x0, x1)
    milliseconds = replay_graph(capture.graph, device, replays=_GRAPH_REPLAYS)
    found = captured.read().stats
    if (found.vertex_face, found.edge_edge) != (stats.vertex_face, stats.edge_edge):
        raise RuntimeError("the CUDA graph found other pairs than the detection outside it")
    return milliseconds


def replay_graph(graph, device, *, replays) -> float:
    """Median time of a replay of a CUDA graph [ms], by events; a first one is not timed."""
    stream = wp.get_stream(device)
    wp.capture_launch(graph)
    milliseconds = []
    for _ in range(replays):
        start, end = (wp.Event(device, enable_timing=True) for _ in range(2))
        stream.record_event(start)
        wp.capture_launch(graph)
        stream.record_event(end)
        milliseconds.append(wp.get_event_elapsed_time(start, end))
    return statistics.median(milliseconds)


def median_milliseconds(run, device, repeat) -> float:
    """Median time of a run [ms], a CUDA graph's on a GPU; a first one, which loads the kernels, is not timed."""
    run()
    if device.is_cuda:
        with wp.ScopedCapture(device) as capture:
            run()
        return replay_graph(capture.graph, device, replays=repeat)
    seconds = []
    for _ in range(repeat):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return 1e3 * statistics.median(seconds)


def benchmark_ipc_toolkit(scene, edges, *, repeat=5) -> IpcToolkitBenchmark:
    """Measures how long the IPC Toolkit takes for candidates and collision-free step size.

    It may use as many threads as the process may use cores. Its hierarchy and its grid are both measured, because the
    order of their candidates matters for the second part as well, and what is faster in all is returned. A first run
    of each, in which it allocates its memory, is not timed.

    Args:
        scene: The :class:`BenchmarkScene`.
        edges: Vertex indices of the edges, int32, shape [edge_count, 2].
        repeat: How many repetitions the medians are of.

    Returns:
        IpcToolkitBenchmark: The measurements.
    """
    import ipctk  # noqa: PLC0415 (optional)

    threads = count_threads()
    ipctk.set_num_threads(threads)
    x0, x1 = (np.asfortranarray(x, dtype=np.float64) for x in (scene.x0, scene.x1))
    mesh = ipctk.CollisionMesh(x0, np.asfortranarray(edges), np.asfortranarray(scene.faces))
    measured = []
    for broad_phase in (ipctk.LBVH(), ipctk.HashGrid()):
        candidates = ipctk.Candidates()
        build, step = [], []
        for _ in range(1 + repeat):
            start = time.perf_counter()
            candidates.build(mesh, x0, x1, broad_phase=broad_phase)
            built = time.perf_counter()
            step_size = candidates.compute_collision_free_stepsize(mesh, x0, x1)
            build.append(1e3 * (built - start))
            step.append(1e3 * (time.perf_counter() - built))
        measured.append(
            IpcToolkitBenchmark(
                version=importlib.metadata.version("ipctk"),
                threads=threads,
                broad_phase=type(broad_phase).__name__,
                vertex_face_candidates=len(candidates.fv_candidates),
                edge_edge_candidates=len(candidates.ee_candidates),
                build_milliseconds=statistics.median(build[1:]),
                step_milliseconds=statistics.median(step[1:]),
                step_size=step_size,
            )
        )
    return min(measured, key=lambda benchmark: benchmark.milliseconds)


def count_threads() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


@contextlib.contextmanager
def limited_threads(count: int | None) -> Iterator[None]:
    """Keeps threads that are started within to so many cores; None: no limit.

    Raises:
        ValueError: If there are not so many cores, or the system cannot be asked for it.
    """
    if count is None:
        yield
        return
    if not hasattr(os, "sched_setaffinity"):
        raise ValueError("this system cannot limit the number of threads")
    available = os.sched_getaffinity(0)
    if not 1 <= count <= len(available):
        raise ValueError(f"the number of threads must be in [1, {len(available)}], not {count}")
    os.sched_setaffinity(0, sorted(available)[:count])
    try:
        yield
    finally:
        os.sched_setaffinity(0, available)
