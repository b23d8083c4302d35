"""Validation: it finds all pairs by itself, and sees answers that are wrong."""

import numpy as np
import pytest

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.detection.pipeline import DetectionPipeline
from warp_bsc.detection.run.launch import retry_until_fits
from warp_bsc.scene_replay import validation
from warp_bsc.scene_replay.validation import overlapping_boxes, validate


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
@pytest.mark.parametrize("spread", [0.3, 3.0])
def test_overlapping_boxes_are_those_of_brute_force(scale, spread):
    random = np.random.default_rng(0)

    def boxes(count):
        centers = random.normal(size=(count, 3))
        halves = np.exp(random.normal(size=(count, 3)) * spread - 1.5) * random.choice([0, 1], (count, 3), p=[0.1, 0.9])
        return (centers - halves) * scale, (centers + halves) * scale

    first, second = boxes(300), boxes(200)
    found = np.concatenate([np.stack(pair, axis=1) for pair in overlapping_boxes(first, second)])
    overlap = (first[0][:, None] <= second[1]) & (second[0] <= first[1][:, None])
    expected = np.argwhere(overlap.all(axis=2))
    assert len(expected) > 100
    np.testing.assert_array_equal(found[np.lexsort(found.T[::-1])], expected)


def test_boxes_that_touch_at_a_corner():
    first = np.array([[0.0, 0, 0]]), np.array([[1.0, 1, 1]])
    second = np.array([[1.0, 1, 1], [1.0, 1, np.nextafter(1, 2)]]), np.array([[2.0, 2, 2]] * 2)
    assert [pair[1].tolist() for pair in overlapping_boxes(first, second) if len(pair[1])] == [[0]]


class Answers:
    """Collisions of which some things may be changed."""

    def __init__(self, collisions, **changes):
        for name in ("vertex_face", "edge_edge"):
            for suffix in ("", "_toi"):
                setattr(self, name + suffix, getattr(collisions, name + suffix))
        self.stats = collisions.stats
        self.__dict__.update(changes)


@pytest.fixture
def crossing():
    """Two sheets that wave through each other: a detector, positions and the collisions."""
    random = np.random.default_rng(3)
    side = 9
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1)
    quads = np.stack([a, a + 1, a + side, a + 1, a + side + 1, a + side], axis=1).reshape(-1, 3)
    sheet = np.stack([x, y, 0 * x], axis=2).reshape(-1, 3)
    x0 = np.concatenate([sheet, sheet * 0.9 + (0.2, 0.3, 0.5)]) + random.normal(size=(2 * side * side, 3)) * 0.1
    x1 = x0 + random.normal(size=x0.shape) * 0.1
    x1[: side * side, 2] += 0.6
    detector = bsc.CollisionDetector(
        bsc.CollisionMesh(np.concatenate([quads, quads + side * side]), len(x0)), method="exact"
    )
    collisions = detector.detect(x0, x1)
    assert len(collisions.vertex_face) > 20 and len(collisions.edge_edge) > 20
    return detector, x0, x1, collisions


def test_right_answers(crossing):
    detector, x0, x1, collisions = crossing
    found = validate(detector, collisions, x0, x1, most=None, seed=0)
    assert found.disagreements == () and found.false_hits == 0
    assert found.hits == len(collisions.vertex_face) + len(collisions.edge_edge)
    pipeline = DetectionPipeline(detector.mesh)
    positions = [detector.mesh.device_positions(x, name) for x, name in ((x0, "x0"), (x1, "x1"))]
    retry_until_fits(lambda: pipeline.find_overlapping(*positions), pipeline, detector.mesh.device)
    overlapping = pipeline.counts.vertex_face.queued + pipeline.counts.edge_edge.queued
    assert found.hits + found.others == overlapping  # the grid and the detector find the same pairs
    assert 0 < found.certified <= found.decided < overlapping


@pytest.mark.parametrize("fewest", [1, 7, 1 << 30])
def test_answers_do_not_depend_on_how_many_pairs_are_decided_at_a_time(crossing, monkeypatch, fewest):
    detector, x0, x1, collisions = crossing
    missing = Answers(
        collisions, vertex_face=collisions.vertex_face[::2], vertex_face_toi=collisions.vertex_face_toi[::2]
    )
    expected = validate(detector, missing, x0, x1, most=None, seed=0)
    assert len(expected.disagreements) == len(collisions.vertex_face) // 2
    monkeypatch.setattr(validation, "_FEWEST", fewest)
    calls = []
    edge_edge = checker.edge_edge
    monkeypatch.setattr(checker, "edge_edge", lambda points: calls.append(len(points)) or edge_edge(points))
    assert validate(detector, missing, x0, x1, most=None, seed=0) == expected
    assert len(calls) == 1 if fewest == 1 << 30 else min(calls[:-1]) >= fewest


def test_some_answers(crossing):
    detector, x0, x1, collisions = crossing
    found = validate(detector, collisions, x0, x1, most=7, seed=0)
    assert (found.hits, found.others, found.disagreements) == (14, 14, ())


@pytest.mark.parametrize("kind", ["vertex_face", "edge_edge"])
def test_a_missing_collision_is_seen(crossing, kind):
    detector, x0, x1, collisions = crossing
    pairs, toi = getattr(collisions, kind), getattr(collisions, f"{kind}_toi")
    wrong = Answers(collisions, **{kind: pairs[1:], f"{kind}_toi": toi[1:]})
    (line,) = validate(detector, wrong, x0, x1, most=None, seed=0).disagreements
    assert line == f"{kind.replace('_', '-')} {pairs[0].tolist()} collides and was not reported"


def test_a_false_collision_and_wrong_times_are_seen(crossing):
    detector, x0, x1, collisions = crossing
    reported = {tuple(pair) for pair in collisions.vertex_face.tolist()}
    free = next([0, face] for face in range(100, 256) if (0, face) not in reported)
    pairs = np.concatenate([collisions.vertex_face, [free]])
    toi = np.append(collisions.vertex_face_toi, 0.5)
    toi[0] = min(1.0, toi[0] + 1e-3)
    toi[1] -= 1e-3
    wrong = Answers(collisions, vertex_face=pairs, vertex_face_toi=toi)
    late, early, false = validate(detector, wrong, x0, x1, most=None, seed=0).disagreements
    assert "already" in late and "only" in early and "does not collide" in false


def test_conservative_may_report_what_does_not_collide(crossing):
    _, x0, x1, collisions = crossing
    detector = bsc.CollisionDetector(crossing[0].mesh)
    reported = {tuple(pair) for pair in collisions.vertex_face.tolist()}
    free = next([0, face] for face in range(100, 256) if (0, face) not in reported)
    more = Answers(
        collisions,
        vertex_face=np.concatenate([collisions.vertex_face, [free]]),
        vertex_face_toi=np.append(collisions.vertex_face_toi, 0.5),
    )
    found = validate(detector, more, x0, x1, most=None, seed=0)
    assert (found.disagreements, found.false_hits) == ((), 1)
