"""Measures the detector on a scene: the time of a detection, and its counts."""

import statistics
import time
from dataclasses import dataclass

import numpy as np
import warp as wp

from .._arguments import checked_integer
from ..detection.detector import CollisionDetector
from ..detection.mesh import CollisionMesh
from ..detection.results.collisions import DetectionStats, StageCounts
from ..detection.run.settings import Method
from .ipc_toolkit import IpcToolkitBenchmark, benchmark_ipc_toolkit
from .scenes import BenchmarkScene
from .timing import replay_graph

__all__ = ["DetectorBenchmark", "benchmark_detector"]

_GRAPH_REPLAYS = 20


@dataclass(frozen=True)
class DetectorBenchmark:
    """Counts and times of the detector on a scene.

    Attributes:
        scene: The scene.
        precision: Bits of a coordinate, 32 or 64.
        vertex_face: Number of vertex-face pairs that entered or left each stage.
        edge_edge: Number of edge-edge pairs that entered or left each stage.
        hits: Number of pairs that the method reports.
        earliest_toi: The earliest time of impact, 2.0 if there is none.
        certified: Whether no collision can be missing.
        detect_milliseconds: Median time from positions on the device to results on the device [ms]; to results on the
            host if the host decides pairs that are too wide for the device.
        read_milliseconds: Median time from positions on the device to results on the host [ms].
        graph_milliseconds: Median time of a replay as a CUDA graph [ms], None on the CPU.
        stage_milliseconds: Median time by stage [ms].
        memory: Device memory of mesh and detector, queues included [bytes], None where Warp does not count it.
        ipc_toolkit: The IPC Toolkit's measurements, None if it was not measured.
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
        """Number of candidate pairs that no cull decides."""
        return self.vertex_face.survivors + self.edge_edge.survivors

    @property
    def unsure(self) -> int:
        """Number of pairs that floating point could not certify."""
        return self.vertex_face.unsure + self.edge_edge.unsure

    @property
    def candidates_per_second(self) -> float:
        """Candidate pairs a second, from positions to results on the device."""
        return 1e3 * self.candidates / self.detect_milliseconds


def benchmark_detector(
    scene: BenchmarkScene,
    *,
    method: Method = "conservative",
    device: wp.DeviceLike = None,
    repeat: int = 5,
    compare: bool = False,
) -> DetectorBenchmark:
    """Measures a detector on a scene, with positions on the device.

    A first detection, which makes the queues large enough, is not timed.

    Args:
        scene: The scene.
        method: The detector's method.
        device: Warp device; default: Warp's default.
        repeat: Number of repetitions; their medians count.
        compare: Whether to measure the IPC Toolkit as well.

    Raises:
        TypeError: If ``repeat`` is no integer.
        ValueError: If ``repeat`` is less than 1, or the method is unknown.
        RuntimeError: If a CUDA graph found other pairs than the detection outside it.
    """
    repeat = checked_integer(repeat, "repeat", 1)
    device = wp.get_device(device)
    counts_memory = device.is_cuda and wp.is_mempool_enabled(device)
    dtype = wp.vec3 if scene.x0.dtype == np.float32 else wp.vec3d
    x0, x1 = (wp.array(x, dtype=dtype, device=device) for x in (scene.x0, scene.x1))
    before = wp.get_mempool_used_mem_current(device) if counts_memory else 0
    mesh = CollisionMesh(scene.faces, len(scene.x0), world=scene.world, device=device)
    detector = CollisionDetector(mesh, method=method)
    collisions = detector.detect(x0, x1)
    memory = wp.get_mempool_used_mem_current(device) - before if counts_memory else None

    stats = collisions.stats
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


def _replay_detection(detector: CollisionDetector, x0: wp.array, x1: wp.array, stats: DetectionStats) -> float:
    """Returns the median time of a replay of the detection as a CUDA graph [ms]."""
    device = detector.mesh.device
    with wp.ScopedCapture(device) as capture:
        captured = detector.capture(x0, x1)
    assert capture.graph is not None
    milliseconds = replay_graph(capture.graph, device, replays=_GRAPH_REPLAYS)
    found = captured.read().stats
    if (found.vertex_face, found.edge_edge) != (stats.vertex_face, stats.edge_edge):
        raise RuntimeError("the CUDA graph found other pairs than the detection outside it")
    return milliseconds
