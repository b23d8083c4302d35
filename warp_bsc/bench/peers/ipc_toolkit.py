"""Measures the IPC Toolkit: its results of single queries and meshes, and its candidates and collision-free step size.

Its queries are called one by one from Python, where a call can take longer than the query. The time of a call is
measured on a query of features so far apart that it ends at once, and subtracted. The subtracted time contains that of
a query that ends at once: this favors the IPC Toolkit. Queries are timed on one core, without a search for the slowest.
"""

import importlib.metadata
import importlib.util
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ...detection.run.launch import count_cores
from ...detection.run.settings import PairKind
from ..scenes.detector import BenchmarkScene

CCD_CLASSES = {"tight inclusion": "TightInclusionCCD", "additive": "AdditiveCCD"}
"""Methods of the IPC Toolkit, with the names of their classes, which are used with their default settings."""

_FAR = 1e3


def is_installed() -> bool:
    """Returns whether the IPC Toolkit is installed."""
    return importlib.util.find_spec("ipctk") is not None


def version() -> str | None:
    """Returns the version of the IPC Toolkit, None if it is not installed."""
    return importlib.metadata.version("ipctk") if is_installed() else None


def has_intersections(faces: np.ndarray, x: np.ndarray) -> bool:
    """Returns whether the IPC Toolkit finds an edge that meets a face.

    Args:
        faces: Vertex indices, int, shape [face_count, 3].
        x: Positions, shape [vertex_count, 3].
    """
    import ipctk  # noqa: PLC0415 (optional)

    positions, corners = np.asfortranarray(x, dtype=np.float64), np.asfortranarray(faces, dtype=np.int32)
    return ipctk.has_intersections(ipctk.CollisionMesh(positions, ipctk.edges(corners), corners), positions)


def decide_queries(method: str, kind: PairKind, points: np.ndarray) -> np.ndarray:
    """Returns whether each query, as of :func:`time_queries`, collides by a method, bool, shape [n]."""
    ccd = _ccd(method, kind)
    return np.array([ccd(*query)[0] for query in np.asarray(points, dtype=np.float64)], dtype=bool)


def time_queries(method: str, kind: PairKind, points: np.ndarray, *, repeat: int = 3) -> tuple[float, float]:
    """Times queries that are called one by one.

    Args:
        method: One of :data:`CCD_CLASSES`.
        kind: Kind of pair.
        points: Queries, rows as of :func:`warp_bsc.query_vertex_face`, shape [n, 8, 3].
        repeat: Number of repetitions; their median counts.

    Returns:
        Mean time of a query without the call [ns], and that of a call [ns].
    """
    ccd = _ccd(method, kind)
    queries = [tuple(query) for query in np.asarray(points, dtype=np.float64)]
    far = np.asarray(points[0], dtype=np.float64).copy()
    first = [0, 4] if kind == PairKind.VERTEX_FACE else [0, 1, 4, 5]
    far[first] += _FAR * (1.0 + np.abs(far).max())
    whole = _mean_nanoseconds(ccd, queries, repeat)
    call = _mean_nanoseconds(ccd, [tuple(far)] * len(queries), repeat)
    return max(whole - call, 0.0), call


def _ccd(method: str, kind: PairKind) -> Callable:
    """Returns the function of the IPC Toolkit for one query of this kind."""
    import ipctk  # noqa: PLC0415 (optional)

    ccd = getattr(ipctk, CCD_CLASSES[method])()
    return ccd.point_triangle_ccd if kind == PairKind.VERTEX_FACE else ccd.edge_edge_ccd


def _mean_nanoseconds(ccd: Callable, queries: list[tuple], repeat: int) -> float:
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        for query in queries:
            ccd(*query)
        times.append(time.perf_counter() - start)
    return 1e9 * statistics.median(times) / len(queries)


def benchmark_ipc_toolkit(scene: BenchmarkScene, edges: np.ndarray, *, repeat: int = 5) -> dict[str, Any]:
    """Measures the IPC Toolkit's candidates and collision-free step size.

    It finds the earliest time of impact only, not each pair's, and may use a thread for each core of the process. Both
    its hierarchy and its grid are measured, because the order of their candidates affects the step size as well, and
    the one that is faster in all is returned. A first run of each, in which it allocates its memory, is not timed.

    Args:
        scene: The scene.
        edges: Vertex indices of the edges, int32, shape [edge_count, 2].
        repeat: Number of repetitions; their medians count.

    Returns:
        Plain data for JSON: ``version`` of the package ``ipctk``; ``threads``, the number that it could use;
        ``broad_phase``, the one of its broad phases with which the whole took the shortest time;
        ``vertex_face_candidates`` and ``edge_edge_candidates``, the numbers of pairs that this found;
        ``build_milliseconds`` and ``step_milliseconds``, median times to find the candidates, and the step size from
        them [ms]; ``step_size``, the collision-free share of the step, 1 if nothing collides.
    """
    import ipctk  # noqa: PLC0415 (optional)

    threads = count_cores()
    ipctk.set_num_threads(threads)
    x0, x1 = (np.asfortranarray(x, dtype=np.float64) for x in (scene.x0, scene.x1))
    mesh = ipctk.CollisionMesh(x0, np.asfortranarray(edges), np.asfortranarray(scene.faces))
    measured = []
    for broad_phase in (ipctk.LBVH(), ipctk.HashGrid()):
        candidates = ipctk.Candidates()
        build, step = [], []
        step_size = 1.0
        for _ in range(1 + repeat):
            start = time.perf_counter()
            candidates.build(mesh, x0, x1, broad_phase=broad_phase)
            built = time.perf_counter()
            step_size = candidates.compute_collision_free_stepsize(mesh, x0, x1)
            build.append(1e3 * (built - start))
            step.append(1e3 * (time.perf_counter() - built))
        found = {"version": version(), "threads": threads, "broad_phase": type(broad_phase).__name__}
        found["vertex_face_candidates"] = len(candidates.fv_candidates)
        found["edge_edge_candidates"] = len(candidates.ee_candidates)
        found["build_milliseconds"] = statistics.median(build[1:])
        found["step_milliseconds"] = statistics.median(step[1:])
        measured.append(found | {"step_size": step_size})
    return min(measured, key=ipc_milliseconds)


def ipc_milliseconds(took: dict[str, Any]) -> float:
    """Returns the time of the IPC Toolkit from positions to the step size [ms]."""
    return took["build_milliseconds"] + took["step_milliseconds"]
