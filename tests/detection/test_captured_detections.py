"""Detections in graphs: what a detection finds, and what a graph says that it could not do."""

import re

import numpy as np
import pytest
import warp as wp
from collision_results import assert_same
from sheets import crumpled

import warp_bsc as bsc
from warp_bsc.detection.pipeline import DetectionPipeline
from warp_bsc.detection.results.collision_finder import CollisionFinder


@pytest.fixture
def captured():
    """A captured detection: detector, its results, positions on the device, and a function that replays it."""
    x0, x1, faces = crumpled(0)
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0), device="cuda:0"))
    start, end = (wp.array(x, dtype=wp.vec3, device="cuda:0") for x in (x0, x1))
    for seed in (2, 1, 0):  # so that the queues hold what each of them has
        detector.detect(*crumpled(seed)[:2])
    with wp.ScopedCapture(device="cuda:0") as capture:
        c = detector.capture(start, end)
    return detector, c, start, end, lambda: wp.capture_launch(capture.graph)


@pytest.mark.gpu
def test_a_graph_finds_what_a_detection_finds(captured):
    detector, c, start, end, replay = captured
    on_cpu = bsc.CollisionDetector(bsc.CollisionMesh(detector.mesh.faces, detector.mesh.vertex_count, device="cpu"))
    for seed in (0, 1, 2):
        x0, x1, _ = crumpled(seed)
        start.assign(x0)
        end.assign(x1)
        expected = on_cpu.detect(x0, x1)
        for _ in range(34):
            replay()
            assert_same(c.read(), expected)
        assert c.read().certified and not c.read().overflowed


@pytest.mark.gpu
def test_looking_for_intersections_leaves_the_results_of_a_graph_alone(captured):
    detector, c, _, end, replay = captured
    replay()
    expected = c.read().edge_edge.tolist()
    assert len(detector.find_intersections(end))
    assert c.read().edge_edge.tolist() == expected


@pytest.mark.gpu
def test_a_graph_says_that_a_queue_was_too_small(captured):
    detector, _, start, end, _ = captured
    pipeline = DetectionPipeline(detector.mesh, only_used_vertices=True)
    finder = CollisionFinder(pipeline, pipeline.broad_phase.lock)
    assert finder.find(start, end).certified
    pipeline.edge_edge.allocate_contacts(1)
    with wp.ScopedCapture(device="cuda:0") as capture:
        c = finder.capture(start, end)
    wp.capture_launch(capture.graph)
    assert c.read().overflowed and not c.read().certified
    (overflow,) = c.read().overflows
    assert re.fullmatch("edge_edge contacts: [0-9]+ do not fit in the capacity 1", overflow)
    assert finder.find(start, end).certified  # grows
    wp.capture_launch(capture.graph)  # writes to the queues that it was captured with
    with pytest.raises(RuntimeError, match="capture again"):
        c.read()
    with wp.ScopedCapture(device="cuda:0") as capture:
        c = finder.capture(start, end)
    wp.capture_launch(capture.graph)
    assert c.read().certified and not c.read().overflowed


@pytest.mark.gpu
def test_a_graph_says_that_a_position_is_not_finite(captured):
    _, c, _, end, replay = captured
    positions = end.numpy()
    positions[7, 1] = np.nan
    end.assign(positions)
    replay()
    assert not c.read().certified


@pytest.mark.gpu
def test_capturing_first_is_refused():
    x0, x1, faces = crumpled(0)
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0), device="cuda:0"))
    start, end = (wp.array(x, dtype=wp.vec3, device="cuda:0") for x in (x0, x1))
    with pytest.raises(RuntimeError, match="detect once"), wp.ScopedCapture(device="cuda:0"):
        detector.capture(start, end)


@pytest.mark.gpu
def test_two_detectors_on_two_streams(captured):
    _, c, start, end, replay = captured
    x0, _, faces = crumpled(3)
    replay()
    expected = c.read().vertex_face.tolist()
    streams = [wp.Stream("cuda:0"), wp.Stream("cuda:0")]
    detectors = [bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0), device="cuda:0")) for _ in streams]
    results = []
    for detector, stream, positions in zip(detectors, streams, ((start, end), (end, start)), strict=True):
        with wp.ScopedStream(stream):
            results.append(detector.detect(*positions))
    assert results[0].vertex_face.tolist() == expected
    alone = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x0), device="cuda:0")).detect(end, start)
    assert_same(results[1], alone)
