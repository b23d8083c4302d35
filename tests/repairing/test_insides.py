"""Repaired tetrahedra: surfaces are free, insides follow, and none inverts that does not in the shot, exactly."""

import itertools
import json

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from replay_files import Page
from soft_bodies import CUBE, as_tuples, block, inner_vertices, inverting, motion_of, pressed_bar
from usd_stages import CORNERS, add_mesh, add_tets, find, new_stage, save

from warp_bsc import Scene
from warp_bsc.cli.main import main
from warp_bsc.repairing.shot.insides import Insides
from warp_bsc.repairing.shot.stretch import ShotFrame

TURNED = np.array([[0.0, 2.0, 0.0, 0.0], [-2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0], [3.0, 1.0, -2.0, 1.0]])
MIRRORED = np.diag([-0.5, 0.5, 0.5, 1.0])


def repair(stage, *options, status=0):
    """Repairs a stage, and returns the path of the layer."""
    path = save(stage)
    output = path.replace(".usda", "_fixed.usdc")
    assert main(["repair", path, "--output", output, "--device", "cpu", *options]) == status
    return output


def repaired_facts(stage, capsys, *options, status=0):
    """The path of the layer, and what is printed as JSON."""
    capsys.readouterr()
    output = repair(stage, "--json", *options, status=status)
    return output, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(
    ("transform", "surface"), [(None, False), (TURNED, True), (MIRRORED, False)], ids=["placed", "turned", "mirrored"]
)
def test_a_pressed_bar_is_freed(tmp_path, capsys, transform, surface):
    stage = pressed_bar(tmp_path / "shot.usda", transform=transform, surface=surface)
    output, facts = repaired_facts(stage, capsys)
    assert facts["before"]["collisions"] and facts["before"]["intersections"]
    assert facts["before"]["inverted tetrahedra"] == facts["remaining"]["inverted tetrahedra"] == 0
    found = find(output, "--validate", "50")
    assert not found["hits"] and not any(at["crossings"] for at in found["intersections"])
    (old, tets), (new, _) = motion_of(save(stage)), motion_of(output)
    assert not inverting(old, tets).any() and not inverting(new, tets).any()
    added, inner = new - old, inner_vertices(tets)
    moves = np.linalg.norm(added, axis=2)
    assert not added[0].any()
    assert moves[:, inner].max() > 0.2 * moves.max() > 0.0
    jumps = np.linalg.norm(np.diff(added, 2, axis=0), axis=2)
    assert jumps[:, inner].max() < 1.2 * jumps.max()
    (stretch,) = facts["stretches"]
    assert not stretch["held"] and not stretch["uncertified"] and stretch["moved"] > len(np.unique(tets)) - len(inner)


def test_bodies_that_do_not_move_are_freed(tmp_path):
    """A cube that is pressed into another one: their points have no time samples, neither have those of the layer."""
    stage = new_stage(tmp_path / "still.usda")
    points, tets = block((4, 4, 4), 0.25)
    add_tets(stage, as_tuples(points), tets.tolist(), path="/World/A")
    add_tets(stage, as_tuples(0.8 * points + [0.11, 0.093, 0.8]), tets.tolist(), path="/World/B")
    assert find(stage)["intersections"][0]["crossings"]
    output = repair(stage, "--include-initial")
    assert not any(at["crossings"] for at in find(output)["intersections"])
    for name in ("/World/A", "/World/B"):
        fixed = Usd.Stage.Open(output)
        mesh = UsdGeom.TetMesh(fixed.GetPrimAtPath(name))
        assert not mesh.GetPointsAttr().GetNumTimeSamples()
        (new,), _ = motion_of(output, name)
        (old,), _ = motion_of(save(stage), name)
        assert (new != old)[inner_vertices(tets)].any()
        assert not inverting(new[None], tets).any()


def closing_plates(path, frames=9):
    """A block in a vice that leaves it no room."""
    stage = new_stage(path)
    points, tets = block((2, 2, 2), 0.2)
    add_tets(stage, dict.fromkeys(range(frames), as_tuples(points)), tets.tolist(), path="/World/Bar")
    for name, side in (("Low", -1.0), ("High", 1.0)):
        square = np.array(CUBE[:4]) * [4, 4, 0] - [1, 1, -0.2]
        lift = add_mesh(stage, f"/World/{name}", as_tuples(square), [4], [0, 1, 2, 3]).AddTranslateOp()
        for frame in range(frames):
            lift.Set((0.013 * side, 0.0, side * (0.03 + 0.07 * abs(frame - frames // 2))), frame)
    return stage


def test_what_would_invert_stays_and_is_named(tmp_path, capsys):
    stage = closing_plates(tmp_path / "shot.usda")
    output, facts = repaired_facts(stage, capsys, status=4)
    (stretch,) = facts["stretches"]
    assert stretch["held"] == ["/World/Bar"]
    assert [reason for reason in stretch["reasons"] if "as its tetrahedra would invert" in reason]
    new, tets = motion_of(output)
    assert not inverting(new, tets).any()
    assert main(["repair", save(stage), "--output", output, "--device", "cpu", "--fail-on", "remaining"]) == 1
    assert "/World/Bar is moved less than contacts need" in capsys.readouterr().out


def test_tetrahedra_that_are_inverted_in_the_shot_hold_nothing(tmp_path, capsys):
    """Their number is in the table, the JSON and the page."""
    stage = pressed_bar(tmp_path / "shot.usda")
    mesh = UsdGeom.TetMesh(stage.GetPrimAtPath("/World/Bar"))
    tets = np.array(mesh.GetTetVertexIndicesAttr().Get())
    tets[7] = tets[7][[1, 0, 2, 3]]
    mesh.GetTetVertexIndicesAttr().Set(tets.tolist())
    mesh.CreateSurfaceFaceVertexIndicesAttr(UsdGeom.TetMesh.ComputeSurfaceFaces(mesh, 0))
    before = int(inverting(motion_of(save(stage))[0], tets)[:-1].sum())
    page = tmp_path / "page.html"
    output, facts = repaired_facts(stage, capsys, "--report", str(page))
    assert facts["before"]["inverted tetrahedra"] == facts["remaining"]["inverted tetrahedra"] == before == 11
    assert not facts["stretches"][0]["held"]
    assert [f"{before}", f"inverted tetrahedra, of {before} before"] in Page(page.read_text()).data["tiles"]
    assert inverting(motion_of(output)[0], tets).sum() == before + 1
    repair(stage)
    assert f"Inverted tetrahedra: {before} before, {before} remain." in capsys.readouterr().out


def insides_of(stage, frames):
    """The insides of a stage with one TetMesh whose surface has all vertices, and a function that follows frames."""
    scene = Scene(save(stage))
    segment = scene.segment(0)
    given = scene.interval(0).tet_positions[0]
    insides = Insides(scene, segment, np.ones(segment.vertex_count, bool), given, np.zeros(3), device="cpu")
    x = segment.start_positions
    frames = [ShotFrame(x, np.float32(frame), np.float32(frame) - x) for frame in frames]
    return insides.follow(frames, [given] * len(frames), [(0.0, False)] * len(frames))


@pytest.mark.parametrize(("cos", "sin", "inverts"), [(1, 0, False), (0.6, 0.8, False), (-1, 0, True)])
def test_motions_between_frames_do_not_invert(tmp_path, cos, sin, inverts):
    """A tetrahedron turns from one frame to the next, and back: by half a turn it is flat on the way."""
    stage = new_stage(tmp_path / "still.usda")
    add_tets(stage, {0: CORNERS, 1: CORNERS})
    turned = np.array(CORNERS) @ [[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]
    x = [np.array(CORNERS, float), turned, np.array(CORNERS, float)]
    assert inverting(np.array(x), np.array([[0, 1, 2, 3]])).any() == inverts
    frames, held = insides_of(stage, x)
    assert bool(held) == inverts
    new = np.array([frame.x for frame in frames])
    assert not inverting(new, np.array([[0, 1, 2, 3]])).any()
    assert all(frame.certified != inverts for frame in frames[1:])
    assert inverts or np.array_equal(new[1], np.float32(turned))


def test_parts_that_can_follow_do(tmp_path):
    """One of two tetrahedra far apart is turned inside out: it stays, and the other one is where it is to be."""
    stage = new_stage(tmp_path / "still.usda")
    far = as_tuples(np.array(CORNERS) + 9.0)
    add_tets(stage, {0: [*CORNERS, *far], 1: [*CORNERS, *far]}, [(0, 1, 2, 3), (4, 5, 6, 7)])
    moved = np.add([*CORNERS, *far], [0.0, 0.0, 0.5])
    moved[3, 2] = -1.0
    frames, held = insides_of(stage, [moved])
    assert held == {"/World/Soft": [0.0]}
    assert np.array_equal(frames[0].x[:4], np.float32(CORNERS))
    assert np.array_equal(frames[0].x[4:], np.float32(moved[4:]))


def test_inner_vertices_make_room(tmp_path):
    """The middle of the top of a block is pushed below its centre, to which a mean of displacements is not enough."""
    stage = new_stage(tmp_path / "still.usda")
    points, tets = block((2, 2, 2), 0.5)
    add_tets(stage, {0: as_tuples(points), 1: as_tuples(points)}, tets.tolist())
    (centre,) = inner_vertices(tets)
    outer = np.delete(points, centre, axis=0)
    pushed = np.where((outer == [0.5, 0.5, 1.0]).all(axis=1)[:, None], [0.5, 0.5, 0.45], outer)
    frames, held = insides_of(stage, [pushed])
    x = np.insert(frames[0].x, centre, frames[0].inner.x[0], axis=0)
    assert not held and x[centre, 2] < 0.4
    assert not inverting(x[None].astype(float), tets).any()


def test_options(tmp_path):
    """Kept bodies stay, hard ones keep their shape inside as well, larger moves are not made."""
    stage = pressed_bar(tmp_path / "shot.usda", cells=(3, 2, 2))
    (old, tets), path = motion_of(save(stage)), save(stage)
    assert np.array_equal(motion_of(repair(stage, "--max-move", "0.01"))[0], old)
    output = repair(stage, "--keep", "/World/Bar")
    assert not Usd.Stage.Open(output).GetRootLayer().GetPrimAtPath("/World/Bar")
    new, _ = motion_of(repair(stage, "--rigid", "/World/Bar"))
    ends = np.array(list(itertools.combinations(range(new.shape[1]), 2))).T
    before, after = (np.linalg.norm(x[:, ends[0]] - x[:, ends[1]], axis=2) for x in (old, new))
    assert (new != old)[:, inner_vertices(tets)].any() and np.allclose(before, after, atol=1e-5)
    new, _ = motion_of(repair(stage, "--min-distance", "0.02"))
    assert not inverting(new, tets).any()
    fixed = path.replace(".usda", "_fixed.usdc")
    assert main(["replay", fixed, "--clearance", "0.02", "--fail-on", "distance", "--device", "cpu"]) == 0


def test_a_stopped_repair_is_resumed(tmp_path, monkeypatch):
    """Two stretches, of which the second one is repaired by a later run: the layer is the same."""
    stage = pressed_bar(tmp_path / "shot.usda", frames=40, cells=(3, 2, 2))
    lift = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Box")).GetOrderedXformOps()[0]
    for frame in range(40):
        lift.Set((0.0, 0.0, 0.15 + 0.1 * min(abs(frame - 8), abs(frame - 31))), frame)
    whole = motion_of(repair(stage))[0]
    run = __import__("warp_bsc.cli.repair_run", fromlist=["repair_shot"])
    every = run.repair_shot

    def stopped(*arguments, **options):
        yield next(every(*arguments, **options))
        raise MemoryError

    monkeypatch.setattr(run, "repair_shot", stopped)
    repair(stage, status=2)
    monkeypatch.setattr(run, "repair_shot", every)
    repair(stage, "--resume")
    assert np.array_equal(motion_of(save(stage).replace(".usda", "_fixed.usdc"))[0], whole)


def test_normals_turn_with_the_surface(tmp_path):
    stage = pressed_bar(tmp_path / "shot.usda", cells=(3, 2, 2))
    mesh = UsdGeom.TetMesh(stage.GetPrimAtPath("/World/Bar"))
    mesh.CreateNormalsAttr([(0.0, 0.0, 1.0)] * len(mesh.GetPointsAttr().Get(0)))
    fixed = Usd.Stage.Open(repair(stage))
    normals = np.array(UsdGeom.TetMesh(fixed.GetPrimAtPath("/World/Bar")).GetNormalsAttr().Get(8))
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
    assert np.abs(normals - [0.0, 0.0, 1.0]).max() > 0.01
