"""Stages with the broad phase of a GPU, whose queues may be too small."""

import warp as wp
from newton_scenes import SOLVERS

import warp_bsc as bsc
from warp_bsc.detection import pipeline
from warp_bsc.detection.broad.broad_phase_hierarchy import BroadPhaseHierarchy

CAPACITY = 4


def _make_hierarchy(mesh, count, *, capacity=None, not_finite=None, only_used_vertices=False, **options):
    """The broad phase of a GPU, which stages on the CPU get here too."""
    assert not only_used_vertices
    return BroadPhaseHierarchy(mesh, count, capacity=capacity, not_finite=not_finite, **options)


def stage(model, monkeypatch, *, tiny, inner="vbd", make=bsc.SolverCCD, **options):
    """A stage, with queues for four pairs that cannot grow if it is ``tiny``: those of a CUDA graph cannot."""
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "make_broad_phase", _make_hierarchy)
        solver = make(SOLVERS[inner](model) if isinstance(inner, str) else inner, **options)
    if tiny:
        detector = solver.work.detector
        detector.broad_phase.face_pairs = wp.empty(CAPACITY, dtype=wp.vec2i, device=detector.mesh.device)
        detector.update_capacities()
        detector.grow = lambda: False
    return solver
