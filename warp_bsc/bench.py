"""Benchmarks: the scenes that are measured, and what is measured of them."""

import contextlib
import importlib.metadata
import os
import re
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from .detector import CollisionDetector, StageCounts
from .mesh import CollisionMesh
from .scene import Scene

__all__ = [
    "GENERATORS",
    "BenchmarkScene",
    "DetectorBenchmark",
    "IpcToolkitBenchmark",
    "benchmark_detector",
    "benchmark_ipc_toolkit",
    "count_threads",
    "default_scenes",
    "generate_cloth",
    "generate_crash",
    "limited_threads",
    "load_scene",
]

_GRAPH_REPLAYS = 20
_FEWEST_TRIANGLES, _MOST_TRIANGLES = 1000, 20_000_000


@dataclass(frozen=True)
class BenchmarkScene:
    """A mesh and one step of its motion.

    Attributes:
        name: What the user called it.
        faces: Vertex indices, int32, shape [face_count, 3].
        x0: Positions at the start of the step, float32 or float64, shape [vertex_count, 3].
        x1: Positions at its end, of the same type.
    """

    name: str
    faces: np.ndarray
    x0: np.ndarray
    x1: np.ndarray


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
        graph_milliseconds=_replay_graph(detector, x0, x1, stats) if device.is_cuda else None,
        stage_milliseconds={stage: statistics.median(run[stage] for run in stages) for stage in stages[0]},
        memory=memory,
        ipc_toolkit=benchmark_ipc_toolkit(scene, mesh.edges, repeat=repeat) if compare else None,
    )


def _replay_graph(detector, x0, x1, stats) -> float:
    """The median time of a replay of the detection as a CUDA graph [ms]."""
    device = detector.mesh.device
    stream = wp.get_stream(device)
    with wp.ScopedCapture(device) as capture:
        collisions = detector.detect(x0, x1)
    wp.capture_launch(capture.graph)
    milliseconds = []
    for _ in range(_GRAPH_REPLAYS):
        start, end = (wp.Event(device, enable_timing=True) for _ in range(2))
        stream.record_event(start)
        wp.capture_launch(capture.graph)
        stream.record_event(end)
        milliseconds.append(wp.get_event_elapsed_time(start, end))
    if (collisions.stats.vertex_face, collisions.stats.edge_edge) != (stats.vertex_face, stats.edge_edge):
        raise RuntimeError("the CUDA graph found other pairs than the detection outside it")
    return statistics.median(milliseconds)


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


def default_scenes() -> list[str]:
    """What is measured if nothing is named: the scene of a checkout, if this is one, and generated ones."""
    scene = Path(__file__).parents[1] / "assets" / "cloth_twist.usd"
    return [*([str(scene)] if scene.exists() else []), "cloth:5000", "cloth:50000"]


def load_scene(name: str, *, interval: int = 0) -> BenchmarkScene:
    """Reads or generates a scene.

    Args:
        name: A USD file; two meshes joined by a comma, ``first.ply,second.ply``, of any format that trimesh reads; or
            a generator and a number of triangles, ``cloth:5000``.
        interval: Which interval between time samples of a USD file.

    Returns:
        BenchmarkScene: The scene.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If a file is broken, the two meshes do not fit, or there is no such generator or interval.
    """
    generated = re.fullmatch(r"(\w+):([^/\\]*)", name)
    if generated:
        return BenchmarkScene(name, *_find_generator(name, *generated.groups()))
    if "," in name:
        return _load_pair(name)
    scene = Scene(name)
    if not 0 <= interval < len(scene.times) - 1:
        raise ValueError(f"{name}: there is no interval {interval}, they go from 0 to {len(scene.times) - 2}")
    x0, x1 = (scene.positions(time) for time in scene.times[interval : interval + 2])
    return BenchmarkScene(name, scene.faces, x0, x1)


def _find_generator(name, generator, triangles):
    """The mesh and the motion of a generated scene."""
    if generator not in GENERATORS:
        raise ValueError(f"{name}: there is no generator {generator}, only {', '.join(GENERATORS)}")
    if not re.fullmatch(r"[0-9]{1,9}", triangles) or not _FEWEST_TRIANGLES <= int(triangles) <= _MOST_TRIANGLES:
        raise ValueError(
            f"{name}: the number of triangles must be in [{_FEWEST_TRIANGLES}, {_MOST_TRIANGLES}], not {triangles!r}"
        )
    return GENERATORS[generator](int(triangles))


def _load_pair(name):
    """A step from the vertices of one mesh file to those of another."""
    paths = name.split(",")
    if len(paths) != 2:
        raise ValueError(f"{name}: expected two files joined by a comma, got {len(paths)}")
    first, second = (_read_mesh(path) for path in paths)
    if len(first.vertices) != len(second.vertices):
        raise ValueError(f"{name}: the first has {len(first.vertices)} vertices, the second {len(second.vertices)}")
    if not np.array_equal(first.faces, second.faces):
        raise ValueError(f"{name}: the two have different faces")
    x0, x1 = np.array(first.vertices), np.array(second.vertices)
    # trimesh returns double precision, whatever the file has
    singles = [x.astype(np.float32) for x in (x0, x1)]
    if all(np.array_equal(x, single) for x, single in zip((x0, x1), singles, strict=True)):
        x0, x1 = singles
    return BenchmarkScene(name, np.array(first.faces, dtype=np.int32), x0, x1)


def _read_mesh(path):
    import trimesh  # noqa: PLC0415 (slow)

    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        mesh = trimesh.load_mesh(path, process=False)
        faces = mesh.faces
    except Exception as error:  # of any kind, as its readers meet what they did not expect
        raise ValueError(f"{path}: not a readable triangle mesh: {error}") from error
    if not len(faces):
        raise ValueError(f"{path}: it has no triangles")
    return mesh


def generate_cloth(triangles: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A wrinkled sheet, folded in half, that closes until the wrinkles of its two layers meet.

    Args:
        triangles: About how many.

    Returns:
        Faces, int32, shape [n, 3]; positions at the start and at the end [m], float32, shape [vertex_count, 3].
    """
    rows, columns = _grid_shape(triangles // 2)
    noise = _noise(3, rows + 1, columns + 1)
    i, j = np.mgrid[: rows + 1, : columns + 1] + 0.2 * noise[:2]
    along, across = i / rows, j / columns
    wrinkles = (
        np.sin(9.0 * np.pi * along + 2.0 * across)
        + np.sin(14.0 * np.pi * across + 3.0 * along)
        + np.sin(23.0 * along - 31.0 * across + 1.0)
    )
    wrinkles = 0.01 * wrinkles + 0.1 / rows * noise[2]

    def fold(radius):
        """Two straight layers, joined by half a circle."""
        straight = 0.5 * (1.0 - np.pi * radius)
        turn = np.clip((along - straight) / radius, 0.0, np.pi)
        layer = np.where(turn < 0.5 * np.pi, along - straight, 1.0 - straight - along)
        distance = radius + wrinkles
        x = np.minimum(layer, 0.0) + distance * np.sin(turn)
        return _stack(x, across, -distance * np.cos(turn))

    return _grid_faces(rows + 1, columns + 1), fold(0.028), fold(0.019)


def generate_crash(triangles: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A square tube of thin sheet, crushed along its axis, whose folds, of 24 triangles each, just close.

    Args:
        triangles: About how many.

    Returns:
        Faces, int32, shape [n, 3]; positions at the start and at the end [m], float32, shape [vertex_count, 3].
    """
    rows, columns = _grid_shape(triangles // 2)
    i, j = np.mgrid[: rows + 1, :columns]
    angle = 2.0 * np.pi * j / columns
    cell = 7.2 / columns
    jitter = 0.1 * cell * _noise(3, rows + 1, columns)
    # a curve whose direction is a sine of its length meanders, and touches itself from an amplitude of 2.1 on
    phase = 2.0 * np.pi * i / 24.0
    bumps = 0.05 * np.sin(5.0 * angle) + 0.03 * np.sin(13.0 * angle + 1.0)

    def crush(amplitude):
        direction = (amplitude + bumps) * np.sin(phase)
        height = np.cumsum(cell * np.cos(direction), axis=0)
        offset = np.cumsum(cell * np.sin(direction), axis=0)
        x, y = np.cos(angle), np.sin(angle)
        radius = (1.0 + offset) / (x**6 + y**6) ** (1.0 / 6.0)
        return _stack(*np.add(jitter, [radius * x, radius * y, height - height[rows // 2]]))

    return _grid_faces(rows + 1, columns, closed=True), crush(2.0), crush(2.1)


GENERATORS: dict[str, Callable[[int], tuple[np.ndarray, np.ndarray, np.ndarray]]] = {
    "cloth": generate_cloth,
    "crash": generate_crash,
}
"""Generated scenes by name."""


def _grid_shape(quads):
    """Rows and columns of a nearly square grid of so many quads."""
    side = int(quads**0.5)
    rows = np.arange(int(0.8 * side), side + 1)
    columns = np.round(quads / rows).astype(int)
    best = np.argmin(np.abs(rows * columns - quads))
    return int(rows[best]), int(columns[best])


def _grid_faces(rows, columns, *, closed=False):
    """Two triangles for each four vertices of a grid; a closed one has the first column beside the last."""
    vertex = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    if closed:
        vertex = np.column_stack([vertex, vertex[:, 0]])
    a, b, c, d = vertex[:-1, :-1], vertex[:-1, 1:], vertex[1:, 1:], vertex[1:, :-1]
    return np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)


def _noise(*shape):
    """Numbers in [-1, 1), the same each time, so that nothing lies exactly above anything."""
    return np.random.default_rng(0).uniform(-1.0, 1.0, shape)


def _stack(x, y, z):
    return np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
