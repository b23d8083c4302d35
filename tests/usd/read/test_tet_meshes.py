"""Tetrahedra of USD: their surfaces are checked as meshes, and which of them invert, at the samples and between."""

import json
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, UsdGeom
from replay_files import Page
from usd_stages import CORNERS, add_instancer, add_mesh, add_tets, falling, find, hits, new_stage, save

import warp_bsc as bsc
from warp_bsc.cli.main import main

SURFACE = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)]


def inverted(stage, *options, status=0):
    """The tetrahedra that invert in each interval, and when."""
    meshes = [at.get("inverted", ()) for at in find(stage, *options, status=status)["intervals"]]
    return [
        {tet: time for mesh in at for tet, time in zip(mesh["tetrahedra"], mesh["times"], strict=True)} for at in meshes
    ]


@pytest.fixture
def stage(tmp_path):
    return new_stage(tmp_path / "soft.usda")


@pytest.mark.parametrize("surface", [SURFACE, None])
def test_the_surface_is_checked_as_a_mesh(stage, surface):
    """The one that is in the file, or the one that the tetrahedra have: the falling triangle meets its lowest face."""
    high = [(-2, -2, -4), (4, -2, 0), (-2, 4, 0), (-2, -2, 0)]
    add_tets(stage, [high[number] for number in (0, 1, 2, 3)], [(0, 2, 1, 3)], surface)
    add_mesh(stage, "/World/Falling", falling(0.25, -0.25))
    found = find(stage)
    assert ("/World/Falling", "vertex 0", 0.5, (0.5, -0.5, 0.0)) in [(row[0], row[1], *row[4:]) for row in hits(found)]
    assert {row[2] for row in hits(found)} == {"/World/Soft"}


@pytest.mark.parametrize("is_left_handed", [False, True])
def test_the_surface_that_is_made_is_closed_and_faces_outwards(tmp_path, is_left_handed):
    """Of a grid of cells of five tetrahedra each, with inner vertices, against the volume and Euler's formula."""
    stage = new_stage(tmp_path / "grid.usda")
    n = 3
    points = np.stack(np.meshgrid(*3 * [np.arange(n + 1.0)], indexing="ij"), axis=-1).reshape(-1, 3)
    corner = np.stack(np.meshgrid(*3 * [np.arange(n)], indexing="ij"), axis=-1).reshape(-1, 3)
    cube = np.stack(np.meshgrid(*3 * [np.arange(2)], indexing="ij"), axis=-1).reshape(-1, 3)
    numbers = (corner[:, None] + cube) @ [(n + 1) ** 2, n + 1, 1]
    numbers = np.where(corner.sum(axis=1, keepdims=True) % 2, numbers[:, [1, 0, 3, 2, 5, 4, 7, 6]], numbers)
    tets = numbers[:, [(0, 1, 2, 4), (1, 2, 4, 7), (1, 2, 3, 7), (1, 4, 5, 7), (2, 4, 6, 7)]].reshape(-1, 4)
    volume = np.linalg.det(points[tets[:, 1:]] - points[tets[:, :1]])
    tets[(volume < 0) != is_left_handed] = tets[(volume < 0) != is_left_handed][:, [1, 0, 2, 3]]
    mesh = add_tets(stage, points.tolist(), tets.tolist())
    mesh.CreateOrientationAttr("leftHanded" if is_left_handed else "rightHanded")
    segment = bsc.Scene(stage).segment(0)
    x = segment.start_positions[segment.faces]
    assert np.linalg.det(x).sum() / 6 == pytest.approx(n**3)
    edges = {frozenset((row[i], row[i - 1])) for row in segment.faces.tolist() for i in range(3)}
    assert segment.vertex_count - len(edges) + len(segment.faces) == 2
    assert segment.vertex_count == len(points) - (n - 1) ** 3  # inner vertices collide with nothing
    assert inverted(stage) == [{}]


def test_inversions_are_found_between_samples(stage):
    """One corner goes to its mirror image and back: the volume is 0 halfway, and negative at the sample."""
    down = [*CORNERS[:3], (0, 0, -1)]
    add_tets(stage, {0: CORNERS, 1: down, 2: CORNERS, 3: CORNERS}, surface=SURFACE)
    first, second, third = inverted(stage, "--no-self")
    assert first == {0: pytest.approx(0.5, abs=1e-5)} and second == {0: 1.0} and third == {}


def test_inner_vertices_count(stage):
    """A vertex that no face of the surface has leaves the tetrahedron around it and returns between two samples."""
    corners, low = [(1, 1, 1), (-1, -1, 1), (-1, 1, -1), (1, -1, -1)], (-2, -2, -2)
    add_tets(
        stage,
        {0: [*corners, (0, 0, 0)], 1: [*corners, low], 2: [*corners, (0, 0, 0)]},
        [(4, 1, 2, 3), (0, 4, 2, 3), (0, 1, 4, 3), (0, 1, 2, 4)],
    )
    assert inverted(stage) == [{0: pytest.approx(1 / 6, abs=1e-5)}, {0: 1.0}]
    assert find(stage)["hits"] == 0


@pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
def test_inverted_tetrahedra_are_those_that_openusd_finds(stage, orientation):
    rng = np.random.default_rng(3)
    points = rng.normal(size=(40, 3)).astype(np.float32)
    tets = np.array([rng.choice(40, 4, replace=False) for _ in range(60)])
    mesh = add_tets(stage, points.tolist(), tets.tolist())
    mesh.CreateOrientationAttr(orientation)
    expected = set(UsdGeom.TetMesh.FindInvertedElements(mesh))
    assert 10 < len(expected) < 50
    (found,) = inverted(stage, "--no-intersections")
    assert set(found) == expected


def test_transforms_invert_nothing(stage):
    """Not those that mirror, nor half a turn in one interval, halfway along which straight paths meet."""
    mesh = add_tets(stage, CORNERS, surface=SURFACE)
    UsdGeom.Xformable(mesh).AddScaleOp().Set((1, 1, -1))
    turn = UsdGeom.Xformable(mesh).AddRotateZOp()
    turn.Set(0, 0)
    turn.Set(180, 1)
    assert inverted(stage) == [{}]


def test_indices_that_change(stage):
    """Until they do, points keep their places: the tetrahedron that is inverted then is of the new indices."""
    mesh = add_tets(stage, {0: CORNERS, 1: CORNERS, 2: CORNERS})
    mesh.GetTetVertexIndicesAttr().Clear()
    mesh.GetTetVertexIndicesAttr().Set([(0, 1, 2, 3)], 0)
    mesh.GetTetVertexIndicesAttr().Set([(1, 0, 2, 3)], 1)
    assert inverted(stage) == [{}, {0: 1.0}]


def test_two_bodies_that_share_vertices_and_a_flat_tetrahedron(stage):
    tets = [(0, 1, 2, 3), (2, 1, 4, 3), (0, 0, 1, 2)]
    add_tets(stage, [*CORNERS, (1, 1, 1)], tets)
    assert set(inverted(stage)[0]) == {2}


@pytest.mark.parametrize(
    ("points", "tets", "reason"),
    [
        (CORNERS, [(0, 1, 2, 4)], "tetrahedron 0 has the vertices 0, 1, 2, 4, but the mesh has 4 points"),
        (CORNERS, [(0, 1, 2, 3), (-1, 1, 2, 3)], "tetrahedron 1 has the vertices -1, 1, 2, 3, but"),
        ([*CORNERS[:3], (0, 0, np.nan)], [(0, 1, 2, 3)], "vertex 3 is not finite at time 0"),
        ({0: CORNERS, 1: CORNERS[:3]}, [(0, 1, 2, 3)], "3 points at time 1, but 4 at first"),
    ],
)  # fmt: skip
def test_broken_tetrahedra_are_left_out(stage, points, tets, reason):
    add_tets(stage, points, tets)
    add_mesh(stage, "/World/Falling", falling(3, 2))
    (left_out,) = find(stage, status=4)["left_out"]
    assert left_out.startswith("/World/Soft: ") and reason in left_out


def test_an_inner_vertex_that_is_not_finite_is_named(stage):
    surface = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)]
    tets = [(0, 1, 2, 3), (0, 1, 2, 4)]
    add_tets(stage, {0: [*CORNERS, (0.2, 0.2, 0.2)], 1: [*CORNERS, (0, np.inf, 0)]}, tets, surface)
    (left_out,) = find(stage, status=4)["left_out"]
    assert "vertex 4 is not finite at time 1" in left_out


def test_all_outputs_name_inversions(stage, tmp_path, capsys):
    mesh = add_tets(stage, {0: CORNERS, 1: CORNERS, 2: CORNERS}, surface=SURFACE)
    file = save(stage)
    before, now, page, overlay = (str(tmp_path / name) for name in ("a.json", "b.json", "p.html", "o.usda"))
    assert main(["replay", file, "--device", "cpu", "--json", before, "--fail-on", "inversions"]) == 0
    mesh.GetPointsAttr().Set([*CORNERS[:3], (0, 0, -1)], 1)
    save(stage)
    capsys.readouterr()
    command = ["replay", file, "--device", "cpu", "--no-self", "--json", now, "--report", page, "--overlay", overlay]
    assert main([*command, "--fail-on", "inversions"]) == 1
    said = "1 tetrahedron is inverted in /World/Soft, from 0 to 2; the first is tetrahedron 0, at 0.5"
    assert f"Inverted tetrahedra in 1 mesh:\n  {said}" in capsys.readouterr().out
    whole = Path(now).read_text()
    assert json.loads(whole)["inversion_spans"][0]["until"] == 2
    data = Page(Path(page).read_text()).data
    assert f"{said}." in data["notes"] and not data["nothing"]
    assert ["1", "meshes with inverted tetrahedra"] in data["tiles"]
    assert list(Sdf.Layer.FindOrOpen(overlay).customLayerData["collisions"]["inversions"]) == [said]
    lines = whole.splitlines(keepends=True)
    Path(now).write_text("".join([*lines[:2], *lines[-1:]]).replace('"complete": true', '"complete": false'))
    assert main([*command[:7], "--resume"]) == 0
    assert Path(now).read_text() == whole
    assert main(["replay", file, "--device", "cpu", "--baseline", before, "--fail-on", "new"]) == 1
    assert "tetrahedra of /World/Soft are inverted from 0 to 1" in capsys.readouterr().out


def test_instances_are_named(stage):
    add_instancer(stage, "/World/Many", {0: [(0, 0, 5), (3, 0, 5)]}, ["/World/Many/Soft"])
    add_tets(stage, {0: CORNERS, 1: [*CORNERS[:3], (0, 0, -1)]}, path="/World/Many/Soft")
    spans = find(stage, "--no-self")["inversion_spans"]
    assert [span["meshes"] for span in spans] == [["/World/Many[0]/Soft"], ["/World/Many[1]/Soft"]]
