"""Measures the detector on a scene: the time of a detection, and its counts."""

import os
import statistics
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from typing import Any

import numpy as np
import warp as wp

from ..._arguments import checked_integer
from ...detection.detector import CollisionDetector
from ...detection.mesh import CollisionMesh
from ...detection.results.collisions import DetectionStats
from ...detection.run.settings import Method
from ..peers.ipc_toolkit import benchmark_ipc_toolkit, ipc_milliseconds
from ..record import name_place, shorten_path
from ..scenes.detector import BenchmarkScene
from ..tables import Column, Table, count
from ..timing import replay_graph

DESCRIPTION = """\
Measure the detector, from positions on the device to results on the device and
on the host. A scene is one interval of a USD file; two mesh files joined by a
comma; or generated: cloth:TRIANGLES, a wrinkled sheet that
folds onto itself, or crash:TRIANGLES, a thin tube that is crushed. Default:
cloth_twist.usd if this is a checkout, cloth:5000 and cloth:50000."""

EXAMPLES = """\
examples:
  warp-bsc bench detector
  warp-bsc bench detector cloth.usd --interval 3
  warp-bsc bench detector first.ply,second.ply crash:1100000 --device cuda:0
  warp-bsc bench detector cloth:50000 --device cpu --threads 1 --compare
  warp-bsc bench detector cloth:1000 --worlds 1024 --device cuda:0
  warp-bsc bench detector --json times.json"""

_COUNTS = [Column(name.capitalize(), name) for name in ("triangles", "candidates", "survivors", "hits", "unsure")]
_TIMES = (
    Column("Detect", "milliseconds.detect", ",.2f"),
    Column("Detect\nand read", "milliseconds.detect_and_read", ",.2f"),
    Column("CUDA\ngraph", "milliseconds.cuda_graph", ",.2f"),
    Column("Million\npairs/s", lambda scene: scene["candidates_per_second"] / 1e6, ",.1f"),
    Column("Memory\n[MiB]", lambda scene: scene["memory_bytes"] and scene["memory_bytes"] / 2**20, ",.1f"),
)
_COMPARED = (
    Column(
        "Candidates",
        lambda scene: sum(scene["ipc_toolkit"][f"{kind}_candidates"] for kind in ("vertex_face", "edge_edge")),
    ),
    Column("Build", "ipc_toolkit.build_milliseconds", ",.1f"),
    Column("Step\nsize", "ipc_toolkit.step_milliseconds", ",.1f"),
    Column("Sum", lambda scene: ipc_milliseconds(scene["ipc_toolkit"]), ",.1f"),
    Column("Detect", "milliseconds.detect", ",.1f"),
    Column("Ratio", lambda scene: ipc_milliseconds(scene["ipc_toolkit"]) / scene["milliseconds"]["detect"], ",.1f"),
)
_GRAPH_REPLAYS = 20


def benchmark_detector(
    scene: BenchmarkScene,
    *,
    method: Method = "conservative",
    device: wp.DeviceLike = None,
    repeat: int = 5,
    compare: bool = False,
) -> dict[str, Any]:
    """Measures a detector on a scene, with positions on the device.

    A first detection, which makes the queues large enough, is not timed.

    Args:
        scene: The scene.
        method: The detector's method.
        device: Warp device; default: Warp's default.
        repeat: Number of repetitions; their medians count.
        compare: Whether to measure the IPC Toolkit as well.

    Returns:
        Plain data for JSON: ``precision``, the bits of a coordinate, 32 or 64; ``candidates``, the number of candidate
        pairs, and ``candidates_per_second``, from positions to results on the device; ``survivors``, those that no cull
        decides; ``hits``, the pairs that the method reports; ``unsure``, those that floating point could not certify;
        ``certified``, whether no collision can be missing; ``scene``, ``triangles`` and ``vertices``; ``vertex_face``
        and ``edge_edge``, the numbers of pairs that entered or left each phase; ``earliest_toi``, None if there is no
        hit; ``milliseconds``; ``memory_bytes``, those of mesh and detector on the device, queues included, None where
        Warp does not count them; ``ipc_toolkit``, what :func:`.benchmark_ipc_toolkit` measures, None without.

        The median times [ms] are: ``detect``, from positions on the device to results on the device, to results on the
        host if the host decides pairs that are too wide for the device; ``detect_and_read``, to results on the host;
        ``cuda_graph``, that of a replay, None on the CPU; ``stages``, by phase.

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
    detect, read, phases = [], [], []
    for _ in range(repeat):
        wp.synchronize_device(device)
        start = time.perf_counter()
        collisions = detector.detect(x0, x1)
        wp.synchronize_device(device)
        detect.append(1e3 * (time.perf_counter() - start))
        stats = collisions.stats  # reads everything else with it
        read.append(1e3 * (time.perf_counter() - start))
        phases.append(stats.milliseconds)
    kinds = stats.vertex_face, stats.edge_edge
    hits, took = len(collisions.vertex_face) + len(collisions.edge_edge), statistics.median(detect)
    candidates = sum(counts.candidates for counts in kinds)
    return {
        "precision": 8 * scene.x0.itemsize,
        "candidates": candidates,
        "survivors": sum(counts.survivors for counts in kinds),
        "hits": hits,
        "unsure": sum(counts.unsure for counts in kinds),
        "certified": collisions.certified,
        "candidates_per_second": 1e3 * candidates / took,
        "scene": shorten_path(scene.name),
        "triangles": len(scene.faces),
        "vertices": len(scene.x0),
        "vertex_face": asdict(stats.vertex_face),
        "edge_edge": asdict(stats.edge_edge),
        "earliest_toi": collisions.earliest_toi if hits else None,
        "milliseconds": {
            "detect": took,
            "detect_and_read": statistics.median(read),
            "cuda_graph": _replay_detection(detector, x0, x1, stats) if device.is_cuda else None,
            "stages": {phase: statistics.median(run[phase] for run in phases) for phase in phases[0]},
        },
        "memory_bytes": memory,
        "ipc_toolkit": benchmark_ipc_toolkit(scene, mesh.edges, repeat=repeat) if compare else None,
    }


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


def phase_columns(phases: Iterable[str], key: str) -> list[Column]:
    """Returns columns of the times of the phases of detections, which a row has at a key."""
    return [Column("\n".join(phase.rsplit(" ", 1)), f"{key}.{phase}", ",.2f", title=phase) for phase in phases]


def to_dict(benchmarks: list[dict[str, Any]], **settings: Any) -> dict[str, Any]:
    """Returns the measurements of scenes as plain data for JSON, with settings."""
    return settings | {"scenes": benchmarks}


def show(found: dict[str, Any]) -> Iterator[Table | str]:
    """Yields the tables of the JSON of a measurement, a row a scene, and the lines around them."""
    place, scenes = name_place(found), found["scenes"]
    yield f"Method {found['method']} on {place}; medians of {count(found['repeat'], 'repetition')}"
    rows = [(",".join(map(os.path.basename, scene["scene"].split(","))), scene) for scene in scenes]
    yield Table("Scene", _COUNTS, rows, caption="Hits: pairs that the method reports.")
    yield ""
    caption = "From positions on the device to results on the device, or read on the host."
    yield Table("Milliseconds", _TIMES, rows, caption=caption)
    yield ""
    phases = dict.fromkeys(phase for scene in scenes for phase in scene["milliseconds"]["stages"])
    took = [(name, scene["milliseconds"]) for name, scene in rows]
    yield Table("Milliseconds by phase", phase_columns(phases, "stages"), took)
    if other := scenes[0]["ipc_toolkit"] if scenes else None:
        yield ""
        caption = f"Milliseconds on {count(other['threads'], 'core')}; it finds only the earliest time of impact."
        yield Table(f"IPC Toolkit {other['version']}", _COMPARED, rows, caption=caption)
    if not all(scene["certified"] for scene in scenes):
        yield "Not certified: collisions may be missing."
