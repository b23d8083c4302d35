"""Scenes of the benchmarks: files are read as they are, and generated ones are what they say."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from warp_bsc import CollisionDetector, CollisionMesh
from warp_bsc.bench.scenes.detector import GENERATORS, default_scenes, load_scene

FACES = np.array([[0, 1, 2], [3, 4, 5]])
FLOOR = [(0, 0, 0), (4, 0, 0), (0, 4, 0)]
ABOVE = np.array([*FLOOR, (1, 1, 1), (2, 1, 2), (1, 2, 2)], dtype=float)
BELOW = ABOVE - np.repeat([[0, 0, 0], [0, 0, 4]], 3, axis=0)


def write_mesh(path, points=ABOVE, faces=FACES):
    trimesh.Trimesh(points, faces, process=False).export(path)
    return path


def detect(scene):
    detector = CollisionDetector(CollisionMesh(scene.faces, len(scene.x0), device="cpu"))
    return detector, detector.detect(scene.x0, scene.x1)


def count_candidates(collisions):
    return collisions.stats.vertex_face.candidates + collisions.stats.edge_edge.candidates


def count_hits(collisions):
    return len(collisions.vertex_face) + len(collisions.edge_edge)


@pytest.mark.parametrize("suffix", ["ply", "obj"])
def test_pair_of_meshes(tmp_path, suffix):
    first, second = write_mesh(tmp_path / f"a.{suffix}"), write_mesh(tmp_path / f"b.{suffix}", BELOW)
    scene = load_scene(f"{first},{second}")
    for found, written in ((scene.faces, FACES), (scene.x0, ABOVE), (scene.x1, BELOW)):
        assert np.array_equal(found, written)


def test_pair_keeps_its_precision(tmp_path):
    first, second = write_mesh(tmp_path / "a.obj"), write_mesh(tmp_path / "b.obj", BELOW)
    assert load_scene(f"{first},{second}").x0.dtype == np.float32
    second.write_text(second.read_text().replace("v 4.0", "v 4.1", 1))
    scene = load_scene(f"{first},{second}")
    assert scene.x0.dtype == scene.x1.dtype == np.float64
    assert scene.x1[1, 0] == 4.1


def test_pairs_that_do_not_fit(tmp_path):
    first = write_mesh(tmp_path / "a.ply")
    write_mesh(tmp_path / "fewer.ply", ABOVE[:3], FACES[:1])
    write_mesh(tmp_path / "turned.ply", BELOW, FACES[::-1])
    (tmp_path / "broken.ply").write_text("hello")
    trimesh.PointCloud(ABOVE).export(tmp_path / "points.ply")
    for second, message in (
        ("fewer.ply", "the first has 6 vertices, the second 3"),
        ("turned.ply", "different faces"),
        ("broken.ply", "broken.ply: not a readable"),
        ("points.ply", "points.ply: "),
        ("a.ply,a.ply", "got 3"),
    ):
        with pytest.raises(ValueError, match=message):
            load_scene(f"{first},{tmp_path}/{second}")
    with pytest.raises(FileNotFoundError, match=r"gone.ply: no such file"):
        load_scene(f"{first},gone.ply")


@pytest.mark.parametrize("generator", GENERATORS)
@pytest.mark.parametrize("triangles", [1000, 3333, 20000])
def test_generated_scenes(generator, triangles):
    scene = load_scene(f"{generator}:{triangles}")
    assert abs(len(scene.faces) - triangles) <= 0.01 * triangles
    assert scene.faces.dtype == np.int32
    assert scene.x0.dtype == scene.x1.dtype == np.float32
    assert np.array_equal(np.unique(scene.faces), np.arange(len(scene.x0)))
    again = load_scene(scene.name)
    for name in ("faces", "x0", "x1"):
        assert np.array_equal(getattr(scene, name), getattr(again, name))
    detector, collisions = detect(scene)
    assert 0 < count_hits(collisions) < triangles
    assert collisions.earliest_toi > 0
    assert 0.5 < count_candidates(collisions) / triangles < 100.0
    assert len(detector.find_intersections(scene.x0)) == 0


def test_crash_grows_by_nothing_but_triangles():
    few, many = (load_scene(f"crash:{triangles}") for triangles in (5000, 80000))
    growth = len(many.faces) / len(few.faces)
    (_, of_few), (_, of_many) = detect(few), detect(many)
    assert 0.8 * growth < count_candidates(of_many) / count_candidates(of_few) < 1.2 * growth
    assert 0.7 * growth < count_hits(of_many) / count_hits(of_few) < 1.3 * growth


def test_default_scenes():
    of_checkout, *generated = default_scenes()
    assert Path(of_checkout) == Path(__file__).parents[2] / "assets" / "cloth_twist.usd"
    assert generated == ["cloth:5000", "cloth:50000"]
    for name in (of_checkout, *generated):
        scene = load_scene(name)
        assert len(scene.faces) >= 1000 and (scene.x0 != scene.x1).any()
