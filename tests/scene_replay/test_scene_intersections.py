"""Intersections at rest: which edges pass through faces at the times themselves, since when, and along which curves."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from boxes import add_box, sum_up
from usd_stages import FALLING, FLOOR, add_floor, add_mesh, animate, find, moved, new_stage, save

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.cli.main import main

TWIST = Path(__file__).parents[2] / "assets/cloth_twist.usd"


@pytest.fixture
def stage(tmp_path):
    return new_stage(tmp_path / "scene.usda")


def crossings_of_all_pairs(mesh, x):
    """All pairs of an edge and a face that share no vertex, decided by the exact checker."""
    edges, faces = (numbers.ravel() for numbers in np.indices((len(mesh.edges), len(mesh.faces))))
    apart = (mesh.edges[edges][:, :, None] != mesh.faces[faces][:, None, :]).all(axis=(1, 2))
    pairs = np.stack([edges, faces], axis=1)[apart]
    return pairs[checker.edge_face_crossings(x[mesh.edges[pairs[:, 0]]], x[mesh.faces[pairs[:, 1]]])]


def test_every_time_of_a_cloth_is_checked(capsys, tmp_path):
    out = tmp_path / "hits.json"
    assert main(["replay", str(TWIST), "--device", "cpu", "--json", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "Already crosses at 246: 33 edges through faces." in printed
    assert "from 246 to 260, 33 edges at first, 71 at last: grows" in printed
    found = json.loads(out.read_text())
    scene = bsc.Scene(TWIST)
    detector = None
    for interval, written in zip(scene, found["intervals"], strict=True):
        mesh = bsc.CollisionMesh(interval.segment.faces, interval.segment.vertex_count, device="cpu")
        detector = detector or bsc.CollisionDetector(mesh)
        for x, side in ((interval.x0, "start"), (interval.x1, "end")):
            expected = detector.find_intersections(x)
            numbers = written["intersections"][side]
            assert numbers["crossings"] + numbers["touches"] == len(expected)
        _, points, _ = interval.segment.locate_edges(mesh.edges[detector.find_intersections(interval.x0)[:, 0]])
        assert [row["indices"][0] for row in written["edges_through_faces"]] == points.tolist()
    assert found["intervals"][0]["intersections"]["start"]["crossings"] == 33
    assert len(found["intervals"][-1]["edges_through_faces_at_end"]) == 71
    (span,) = found["intersections"]
    assert (span["since"], span["until"], span["first"], span["last"], span["trend"]) == (246, 260, 33, 71, "grows")


def test_a_box_that_stands_in_a_box(stage, capsys):
    add_box(stage, "/World/Still", (0, 0, 0))
    add_box(stage, "/World/Inside", (0.375, 0.25, 0.625))
    scene = bsc.Scene(save(stage))
    (result,) = bsc.replay(scene, device="cpu")
    start, end = result.intersections
    assert start is end and len(result.contacts) == 0
    mesh = bsc.CollisionMesh(start.segment.faces, start.segment.vertex_count, device="cpu")
    expected = crossings_of_all_pairs(mesh, start.x)
    assert len(start) == start.crossings == len(expected) > 6
    assert sorted(zip(start.vertices[:, 0].tolist(), start.faces[:, 1].tolist(), strict=True)) == sorted(
        zip(mesh.edges[expected[:, 0]].tolist(), expected[:, 1].tolist(), strict=True)
    )
    assert main(["replay", scene.path, "--device", "cpu"]) == 0
    printed = capsys.readouterr().out
    assert "nothing moves: checked at rest, at time 0" in printed
    assert f"Already crosses at 0: {len(expected)} edges through faces." in printed
    assert "No collision" not in printed


def test_boxes_that_never_move_are_checked_beside_motion(stage):
    add_box(stage, "/World/Still", (0, 0, 0))
    add_box(stage, "/World/Inside", (0.375, 0.25, 0.625))
    add_mesh(stage, "/World/Far", {0: moved(FALLING, (9, 9, 9)), 1: moved(FALLING, (9, 9, 8))})
    summary = sum_up(bsc.Scene(save(stage)))
    assert summary.hits == 0
    (span,) = summary.intersection_spans
    assert span.meshes == ("/World/Still", "/World/Inside")
    assert (span.since, span.until, span.trend, span.first) == (0, 1, "stays", span.last)


def test_touching_is_not_crossing(stage, capsys):
    add_floor(stage)
    add_box(stage, "/World/Box", (-0.5, 0.25, 0))
    (result,) = bsc.replay(bsc.Scene(save(stage)), device="cpu")
    start, _ = result.intersections
    mesh = bsc.CollisionMesh(start.segment.faces, start.segment.vertex_count, device="cpu")
    assert start.touches == len(start) == len(crossings_of_all_pairs(mesh, start.x)) > 0
    np.testing.assert_array_equal(start.position[:, 2], 0)
    assert len(start.cuts.points) == 0
    assert main(["replay", save(stage), "--device", "cpu"]) == 0
    printed = capsys.readouterr().out
    assert f"Already touches at 0: {len(start)} edges touching faces." in printed
    assert f"/World/Floor with /World/Box: at 0, {len(start)} edges, touches only" in printed


def add_dive(stage):
    """Falls into the floor from time 1 to 2, is through it at 2 and 3, and comes out until 4."""
    heights = [2, 1, -0.25, -0.125, 1]
    return add_mesh(stage, "/World/Diving", {t: moved(FALLING, (0, 0, z)) for t, z in enumerate(heights)})


def test_since_when_and_until_when(stage, capsys):
    add_floor(stage)
    add_dive(stage)
    scene = bsc.Scene(save(stage))
    summary = sum_up(scene)
    (span,) = summary.intersection_spans
    assert span.meshes == ("/World/Floor", "/World/Diving")
    assert (span.since, span.until, span.is_open, span.trend, span.crossings) == (2, 3, False, "heals", 2)
    assert [sample.crossings for sample in summary.intersections] == [0, 0, 2, 2, 0]
    entering, staying, leaving = summary.intervals[1:]
    assert entering.hits == entering.separate_hits == entering.phases[1] > 0
    assert leaving.hits == leaving.phases[2] > 0 and leaving.separate_hits == 0
    assert staying.separate_hits == staying.phases[1] == 0
    assert main(["replay", scene.path, "--device", "cpu"]) == 0
    printed = capsys.readouterr().out
    assert "/World/Floor with /World/Diving: from 2 to 3, 2 edges at first, 2 at last: heals" in printed


def test_a_collision_that_passes(stage):
    add_floor(stage)
    add_mesh(stage, "/World/Through", {0: moved(FALLING, (0, 0, 1)), 1: moved(FALLING, (0, 0, -1))})
    (interval,) = sum_up(bsc.Scene(save(stage))).intervals
    assert interval.hits == interval.separate_hits == interval.phases[0] > 0


def test_files_list_them(stage, tmp_path):
    add_floor(stage)
    add_dive(stage)
    out = tmp_path / "hits.csv"
    found = find(stage, "--csv", str(out))
    written = [row for interval in found["intervals"] for row in interval["edges_through_faces"]]
    assert [row["time"] for row in written] == [2, 2, 3, 3]
    assert found["intervals"][-1]["edges_through_faces_at_end"] == []
    first = written[0]
    assert (first["prims"], first["elements"]) == (["/World/Diving", "/World/Floor"], ["edge 0-1", "face 0"])
    assert first["position"] == pytest.approx([0.7, -0.5, 0]) and first["phase"] == "crosses"
    with out.open() as file:
        rows = list(csv.DictReader(file))
    at_rest = [row for row in rows if row["kind"] == "edge-face"]
    assert [(row["time"], row["first_element"], row["x"], row["phase"]) for row in at_rest] == [
        (str(row["time"]), row["elements"][0], str(row["position"][0]), row["phase"]) for row in written
    ]
    assert [row["separate"] for row in rows if row["kind"] != "edge-face"] == [
        str(row["separate"]) for interval in found["intervals"] for row in interval["contacts"]
    ]


def test_they_can_be_left_out(stage, capsys):
    add_floor(stage)
    add_dive(stage)
    found = find(stage, "--no-intersections")
    assert found["intersections"] == [] and found["hits"] > 0
    for interval in found["intervals"]:
        assert not {"intersections", "edges_through_faces", "phases"} & interval.keys()
        assert not any("phase" in contact for contact in interval["contacts"])
    assert "rest" not in capsys.readouterr().out


def test_only_selected_pairs_count(stage):
    add_box(stage, "/World/A", (0, 0, 0))
    add_box(stage, "/World/B", (0.375, 0.25, 0.625))
    add_box(stage, "/World/C", (0.25, 0.375, 0.5))
    found = find(stage, "--between", "/World/A", "/World/C")
    assert {tuple(span["meshes"]) for span in found["intersections"]} == {("/World/A", "/World/C")}


def test_a_mesh_that_only_its_transform_moves_is_not_checked_with_itself(stage):
    crossed = [(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1), (0, -1, 0), (2, -1, 0), (2, 1, 0), (0, 1, 0)]
    mesh = add_mesh(stage, "/World/Crossed", crossed, [4, 4], list(range(8)))
    assert sum_up(bsc.Scene(save(stage))).intersections[0].crossings > 0
    animate(mesh, (0, 0, 0), (0.1, 0, 0))
    assert sum_up(bsc.Scene(save(stage))).intersection_spans == []


def test_the_curve_along_which_surfaces_cut(stage):
    add_floor(stage)
    wall = [(-1, 0.25, -1), (1, 0.25, -1), (1, 0.25, 1), (-1, 0.25, 1)]
    add_mesh(stage, "/World/Wall", wall)
    (result,) = bsc.replay(bsc.Scene(save(stage)), device="cpu")
    cuts = result.intersections[0].cuts
    lengths = np.linalg.norm(cuts.points[:, 1] - cuts.points[:, 0], axis=1)
    assert lengths.sum() == pytest.approx(2) and (lengths > 0).all()
    np.testing.assert_allclose(cuts.points[..., 1:], np.broadcast_to([0.25, 0], (len(cuts.points), 2, 2)), atol=1e-12)
    low, high = np.sort(cuts.points[..., 0], axis=1).T
    assert sorted(high)[:-1] == pytest.approx(sorted(low)[1:])  # a chain
    assert (cuts.meshes == [0, 1]).all() and (cuts.faces[:, 0] < cuts.faces[:, 1]).all()


def test_the_curve_ends_at_a_corner_that_both_triangles_have(stage):
    points = [(0, 0, 0), (2, -1, 0), (2, 1, 0), (1, 0, -1), (1, 0, 1)]
    add_mesh(stage, "/World/Fold", points, [3, 3], [0, 1, 2, 0, 3, 4])
    (result,) = bsc.replay(bsc.Scene(save(stage)), device="cpu")
    (ends,) = result.intersections[0].cuts.points
    assert sorted(map(tuple, ends)) == [(0, 0, 0), (1, 0, 0)]


def test_welded_vertices_of_still_meshes_do_not_touch(stage):
    """Two halves of a floor have their common edge in common."""
    add_floor(stage)
    add_mesh(stage, "/World/Next", moved(FLOOR, (4, 0, 0)))
    assert sum_up(bsc.Scene(save(stage))).intersection_spans == []
