"""Runs the public objects under two threads at once, with guarded memory; fails unless every answer is right."""

import functools
import itertools
import sys
import threading

import numpy as np
import warp as wp
from guarded_memory import guard_memory

import warp_bsc as bsc
from warp_bsc.detection.at_rest.intersections import IntersectionFinder
from warp_bsc.detection.at_rest.proximities import ProximityFinder


def in_two_threads(work):
    """Calls a function in two threads at once, twice each; returns the results, raises errors."""
    results, errors, start = [], [], threading.Barrier(2)

    def run():
        start.wait()
        try:
            results.extend([work(), work()])
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    return results


def values(result):
    """Returns the arrays of a result."""
    if isinstance(result, np.ndarray):
        return [result]
    if isinstance(result, bsc.Collisions):
        return [getattr(result, name) for name in ("vertex_face", "edge_edge", "vertex_edge", "edge_edge_toi")]
    return [value for value in vars(result).values() if isinstance(value, np.ndarray)]


def check(name, functions, truth):
    """Calls functions one after another in two threads at once, and compares what they return with the truth.

    The truth comes from other functions, called afterwards: the threads are the first to need kernels and fields.
    """
    results = in_two_threads(lambda: [function() for function in functions])
    truth = [function() for function in truth]
    for result in results:
        for found, right in zip(result, truth, strict=True):
            for value, expected in zip(values(found), values(right), strict=True):
                assert np.array_equal(value, expected, equal_nan=value.dtype.kind == "f"), name
    print(name, flush=True)


def main():
    """Runs all objects; the first argument is a USD file for the scene."""
    wp.config.log_level = wp.LOG_ERROR
    guard_memory()
    rng = np.random.default_rng(5)
    faces = rng.integers(0, 50, (80, 3))
    xs = [rng.uniform(-1, 1, (60, 3)) for _ in range(4)]
    rope = {"edges": np.stack([np.arange(50, 55), np.arange(51, 56)], axis=1), "points": np.arange(57, 60)}

    def mesh():
        return bsc.CollisionMesh(faces, 60, **rope, device="cpu")

    def detections(detector):
        return [lambda a=a, b=b: detector.detect(a, b) for a, b in itertools.pairwise(xs)]

    def detect_anew(mesh, options):
        """Shares a mesh whose fields are made when they are first needed."""
        return bsc.CollisionDetector(mesh, **options).detect(*xs[:2])

    for options in ({"method": "conservative"}, {"method": "exact"}, {"min_distance": 0.01}):
        truth = detections(bsc.CollisionDetector(mesh(), **options))
        check(f"own detectors {options}", [functools.partial(detect_anew, mesh(), options)], truth[:1])
        check(f"shared detector {options}", detections(bsc.CollisionDetector(mesh(), **options)), truth)

    detector = bsc.CollisionDetector(mesh())
    finder = detector.intersection_finder()
    found = [*detections(detector), *(lambda x=x: finder.find(x) for x in xs)]
    other = bsc.CollisionDetector(mesh())
    check(
        "finder of a detector",
        found,
        [*detections(other), *(lambda x=x: IntersectionFinder(mesh()).find(x) for x in xs)],
    )
    check(
        "find_intersections",
        [lambda x=x: detector.find_intersections(x) for x in xs],
        [lambda x=x: other.find_intersections(x) for x in xs],
    )
    near, truth = ProximityFinder(mesh(), 0.05), [lambda x=x: other.find_proximities(x, 0.05) for x in xs]
    check("shared proximity finder", [lambda x=x: near.find(x) for x in xs], truth)
    check("find_proximities", [lambda x=x: detector.find_proximities(x, 0.05) for x in xs], truth)

    for name, points in (("vertex_face", 8), ("edge_edge", 8), ("vertex_edge", 6), ("vertex_vertex", 4)):
        query = getattr(bsc, f"query_{name}")
        rows = rng.uniform(-1, 1, (200, points, 3))
        functions = [lambda d=d, q=query, r=rows: q(r, min_distance=d, device="cpu") for d in (0.0, 0.05)]
        check(f"query_{name}", functions, functions)

    shared, other = bsc.Scene(sys.argv[1]), bsc.Scene(sys.argv[1])
    times = range(0, len(shared), max(1, len(shared) // 6))
    truth = [lambda index=index: other.interval(index).x1 for index in times]
    check("shared scene", [lambda index=index: shared.interval(index).x1 for index in times], truth)


if __name__ == "__main__":
    main()
