"""A repaired shot: free of collisions, as it was where it was free, and back where it was after each collision."""

import itertools
import json
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from dipping import FRAMES, HIT, SIZE, dipping_sheet, points_of, quads, repaired, sheet
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel
from replay_files import Page
from usd_stages import add_mesh, find, new_stage, save

from warp_bsc import CollisionDetector, CollisionMesh, Scene, replay
from warp_bsc.cli.main import main
from warp_bsc.repairing.shot.blend import BLEND, blend
from warp_bsc.repairing.shot.findings import find_collisions
from warp_bsc.repairing.shot.follow import Follower
from warp_bsc.repairing.shot.mesh_groups import groups_of
from warp_bsc.repairing.shot.repair_shot import repair_shot
from warp_bsc.repairing.shot.stretch import ShotFrame, StretchRecorder
from warp_bsc.usd.write.points_layer import MovedFrame


@pytest.fixture(scope="module")
def dipped(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shot")
    stage = dipping_sheet(folder)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Sheet"))
    mesh.CreateExtentAttr([(-0.5, -0.5, 0), (0.5, 0.5, 1)])
    mesh.CreateNormalsAttr([(0, 0, 1)] * (SIZE + 1) ** 2)
    mesh.SetNormalsInterpolation("vertex")
    mesh.CreateVelocitiesAttr([(0, 0, 0)] * (SIZE + 1) ** 2)
    found = find(stage)
    assert sum(len(interval["contacts"]) for interval in found["intervals"])
    return stage, repaired(stage)


def test_repaired_shot_is_free(dipped):
    found = find(dipped[1])
    assert found["complete"] and not found["hits"]
    assert not any(at["crossings"] for at in found["intersections"])


def test_free_frames_keep_every_bit(dipped):
    stage, output = dipped
    margin = BLEND + 2
    moved = []
    for time in range(FRAMES):
        old = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/World/Sheet")).GetPointsAttr().Get(time))
        if not np.array_equal(old, points_of(output, time)):
            moved.append(time)
    assert HIT in moved
    assert moved[0] >= HIT - margin
    assert moved[-1] < FRAMES - 1
    assert np.array_equal(points_of(output, 0, "/World/Plate"), sheet(0.0) * np.float32(3.0))


def test_displacements_grow_and_fade(dipped):
    stage, output = dipped
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Sheet"))
    added = np.array([points_of(output, time) - np.array(mesh.GetPointsAttr().Get(time)) for time in range(FRAMES)])
    jump = np.linalg.norm(np.diff(added, axis=0), axis=2).max()
    assert jump < 0.5 * np.linalg.norm(added, axis=2).max()


def test_extents_normals_and_velocities_are_made_again(dipped):
    stage = Usd.Stage.Open(dipped[1])
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Sheet"))
    points = np.array(mesh.GetPointsAttr().Get(HIT))
    assert np.array_equal(np.array(mesh.GetExtentAttr().Get(HIT)), [points.min(axis=0), points.max(axis=0)])
    assert np.array_equal(np.array(mesh.GetExtentAttr().Get(0)), [(-0.5, -0.5, 0), (0.5, 0.5, 1)])
    assert np.allclose(np.linalg.norm(mesh.GetNormalsAttr().Get(HIT), axis=1), 1.0, atol=1e-5)
    assert np.array_equal(np.array(mesh.GetNormalsAttr().Get(0)), [(0, 0, 1)] * len(points))
    assert np.abs(mesh.GetVelocitiesAttr().Get(HIT - 1)).max() > 0
    assert not np.any(mesh.GetVelocitiesAttr().Get(0))


def test_layer_of_a_free_shot_shows_it_as_it_is(tmp_path, capsys):
    """So that the next command of a job finds a file; an earlier one is replaced."""
    stage = new_stage(tmp_path / "shot.usda")
    add_mesh(stage, "/World/Sheet", {0: sheet(0.0).tolist(), 1: sheet(0.5).tolist()}, [4] * SIZE**2, quads())
    (tmp_path / "fixed.usdc").write_text("earlier")
    output = repaired(stage, "--fail-on", "distorted")
    assert "Nothing was moved: what is written shows the scene as it is.\nWrote " in capsys.readouterr().out
    assert np.array_equal(points_of(output, 1), sheet(0.5))
    assert not Sdf.Layer.FindOrOpen(output).rootPrims


def test_frames_with_wrecked_edges_are_not_good(tmp_path, capsys):
    """Free and certified is not enough: a status and a line tell, and the page begins with the worst one.

    The dip cannot be repaired by a move of the whole sheet, as there is a lid above it.
    """
    stage, page = dipping_sheet(tmp_path, dip=-6.0), tmp_path / "moves.html"
    lid = sheet(0.2) * np.float32((9.0, 9.0, 1.0))
    add_mesh(stage, "/World/Lid", [tuple(map(float, point)) for point in lid], [4] * SIZE**2, quads())
    output = repaired(stage, "--fail-on", "distorted", "--report", str(page), status=1)
    printed = capsys.readouterr().out
    assert "Not good: 1 frame, with edges shorter than a third of the shot's" in printed and ", 0 remain." in printed
    assert f"; at {HIT} the worst, 0." in printed
    ends = np.array(quads()).reshape(-1, 4)[:, :2]
    lengths = [np.linalg.norm(np.diff(x[ends], axis=1), axis=2) for x in (points_of(output, HIT), sheet(0.116, -6.0))]
    assert (lengths[0] / lengths[1]).min() < 0.34
    frames = Page(page.read_text()).data["frames"]
    assert [frame["distortion"] > 2.9 for frame in frames] == [frame["time"] == HIT for frame in frames]
    repaired(stage, "--json", "--fail-on", "remaining")
    found = json.loads(capsys.readouterr().out)
    assert found["distorted"] == [HIT] and found["stretches"][0]["edge_ratio"][0] < 1.0 / 3.0


@pytest.mark.parametrize("dip", [-1.0, pytest.param(-2.0, marks=pytest.mark.slow)])
def test_springs_relax_what_contacts_strain(tmp_path, capsys, dip):
    """Contacts alone press the middle of the sheet flat, with edges at a third of their lengths."""
    repaired(dipping_sheet(tmp_path, dip=dip), "--json", "--fail-on", "remaining")
    found = json.loads(capsys.readouterr().out)
    (stretch,) = found["stretches"]
    assert found["remaining"] == {"collisions": 0, "intersections": 0} and not stretch["uncertified"]
    assert stretch["edge_ratio"][0] > 0.9 and stretch["edge_ratio"][1] < 1.1


@pytest.mark.parametrize(("bottom", "lowest", "highest"), [(0.2, 0.3, 0.4), (0.6, 0.45, 0.55)])
def test_a_frame_is_relaxed_only_as_far_as_the_next_one_can_be_reached(bottom, lowest, highest):
    """A fin passes above the tip of a sheet halfway to the next frame, in which the sheet is flat: springs would raise
    the tip to 0.5, where it is in the shot, and it may be at twice the height of the fin at most.
    """
    n = SIZE + 1
    tip, fin = n * n // 2, np.array([(0, -0.5, bottom), (0, 0.5, bottom), (0, 0, bottom + 1.0)])
    faces = [*np.array(quads()).reshape(-1, 4)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3), np.arange(3) + n * n]

    def frame(height, fin_at, given=None):
        x = np.concatenate([sheet(0.0), fin + np.array([fin_at, 0, 0])]).astype(np.float32)
        x[tip, 2] = height
        return ShotFrame(x if given is None else given, x, np.zeros_like(x))

    mesh = CollisionMesh(faces, n * n + 3, device="cpu")
    before, after = frame(0.3, -9.0), frame(0.0, 3.0)
    follower = Follower(mesh, before.x, np.arange(n * n + 3) < n * n)
    relaxed, following = follower.relax(before, frame(0.3, -3.0, frame(0.5, -3.0).x), after)
    assert relaxed.certified and following.certified
    detector = CollisionDetector(mesh, method="exact")
    assert not len(detector.detect(before.x, relaxed.x)) and not len(detector.detect(relaxed.x, after.x))
    assert lowest <= relaxed.x[tip, 2] <= highest


@pytest.mark.parametrize("rigid", [["--rigid", "*Button*"], []])
def test_hard_parts_move_as_a_whole(tmp_path, capsys, rigid):
    """A button whose corner dips through the plate keeps its shape in the shot, which turns it, up to rounding."""
    stage = dipping_sheet(tmp_path)
    ball = trimesh.creation.icosphere(1, 0.05)
    turns = [trimesh.transformations.rotation_matrix(0.1 * time, (1, 2, 3))[:3, :3] for time in range(FRAMES)]
    centres = [(0.9, 0.9, 0.03 if time == HIT else 0.1) for time in range(FRAMES)]
    shape = ball.vertices * (1.0, 0.5, 1.5)
    points = {t: [tuple(map(float, p)) for p in shape @ turns[t].T + centres[t]] for t in range(FRAMES)}
    add_mesh(stage, "/World/Button", points, [3] * len(ball.faces), ball.faces.ravel().tolist())
    output = repaired(stage, "--json", "--fail-on", "remaining", *rigid)
    found = json.loads(capsys.readouterr().out)
    assert found["remaining"] == {"collisions": 0, "intersections": 0}
    x, given = points_of(output, HIT, "/World/Button"), np.array(points[HIT])
    assert np.abs(x - given).max() > 0.01
    distances = [np.linalg.norm(y[:, None] - y[None], axis=2) for y in (x.astype(float), given)]
    assert (np.abs(distances[0] - distances[1]).max() < 1e-6) == bool(rigid)


@pytest.mark.parametrize(("length", "is_good"), [(1e-4, True), (0.04, False)])
def test_an_edge_of_no_length_in_the_shot_does_not_wreck_a_frame(tmp_path, length, is_good):
    """Two points of the sheet are nearly one; when the one is moved and the other is not, their edge counts only if it
    has a length: a thousandth of the median one, an eighth of a unit, is the limit."""
    n = SIZE + 1
    given = sheet(0.0)
    given[1] = given[0] + np.float32((length / SIZE, 0, 0))
    x = given.copy()
    x[1] += np.float32((1.0 / SIZE, 0, 0))
    edges = np.array([(row * n + i, row * n + i + 1) for row in range(n) for i in range(SIZE)])
    recorder = StretchRecorder(np.ones(len(given), bool), edges, 1.0 / SIZE)
    moved = MovedFrame(0.0, False, None, np.array([1]), x[1:2].astype(np.float64))
    recorder.add(ShotFrame(given, x, x - given), moved)
    stretch = recorder.finish([])
    assert bool(stretch.distorted()) != is_good
    assert 0 < stretch.edge_ratio[0] <= 1 <= stretch.edge_ratio[1]


def test_kept_meshes_do_not_move_and_are_not_left(tmp_path, capsys):
    """What they do among themselves is counted in a note alone."""
    stage = dipping_sheet(tmp_path)
    output = repaired(stage, "--keep", "/World/Sheet", "--json", "--fail-on", "remaining")
    found = json.loads(capsys.readouterr().out)
    assert found["kept"]["/World/Sheet"] == "it is to be kept"
    assert found["remaining"] == found["before"] == {"collisions": 0, "intersections": 0} and found["output"] == output
    repaired(stage, "--keep", "/World/Sheet")
    printed = capsys.readouterr().out
    hits = sum(len(result.contacts) for result in replay(Scene(save(stage)), device="cpu"))
    assert hits
    assert f"note: collisions of meshes that are not moved with each other: {hits}, not counted" in printed
    assert "Nothing was moved" in printed


def overlapping_sheets(folder):
    """A sheet that dips through a plate, and a board that crosses the sheet at all times; both deform."""
    stage = dipping_sheet(folder)
    board = sheet(0.0)[:, [2, 0, 1]] * np.float32(0.6) + np.float32([0.31, 0.0, 0.35])
    points = {time: (board * np.float32(1.0 + 1e-4 * (time % 2))).tolist() for time in range(FRAMES)}
    add_mesh(stage, "/World/Board", points, [4] * SIZE**2, quads())
    return stage


def test_meshes_that_cross_at_first_are_left_and_named(tmp_path, capsys):
    output = repaired(
        overlapping_sheets(tmp_path), "--report", str(tmp_path / "moves.html"), "--fail-on", "remaining", status=1
    )
    printed = capsys.readouterr().out
    assert "Not repaired: /World/Board with /World/Sheet, which cross at 0 already." in printed
    assert "Collisions: " in printed and ", 0 remain." in printed
    page = Page((tmp_path / "moves.html").read_text())
    assert ["Not repaired: /World/Board", "with /World/Sheet, which it crosses at first"] in page.data["facts"]
    assert page.data["tiles"][2][1].startswith("collisions of meshes that cross at the first frame, of ")
    assert np.array_equal(points_of(output, 0), sheet(0.1)), "what is left moves nothing"
    command = ["replay", output, "--device", "cpu", "--fail-on", "collisions"]
    assert main([*command, "--ignore", "/World/Board", "/World/Sheet"]) == 0
    capsys.readouterr()
    assert main(command) == 1
    assert "It leaves 1 pair of meshes that cross at the first time" in capsys.readouterr().out


def test_replay_names_bodies_for_a_repair_to_keep(tmp_path, capsys):
    """Bodies are closed: where a sheet crosses one at first, the sheet alone is to move. Sheets alone get no hint."""
    stage, ball = dipping_sheet(tmp_path, dip=0.0), trimesh.creation.icosphere(2, 0.2)
    points = {time: (ball.vertices * (1.0 + 1e-3 * (time % 2)) + [0.0, 0.0, 0.28]).tolist() for time in range(FRAMES)}
    add_mesh(stage, "/World/Ball", points, [3] * len(ball.faces), ball.faces.ravel().tolist())
    assert main(["replay", save(stage), "--device", "cpu"]) == 0
    assert "With --keep /World/Ball bodies stay where they are" in capsys.readouterr().out
    output = repaired(stage, "--include-initial", "--keep", "/World/Ball", "--fail-on", "remaining")
    assert np.array_equal(points_of(output, 3, "/World/Ball"), np.float32(points[3]))
    assert not np.array_equal(points_of(output, 3), sheet(0.103))
    (tmp_path / "open").mkdir()
    assert main(["replay", save(overlapping_sheets(tmp_path / "open")), "--device", "cpu"]) == 0
    assert "It leaves 1 pair" in (printed := capsys.readouterr().out) and "--keep" not in printed


def test_ignored_meshes_are_not_kept_apart(tmp_path, capsys):
    """Only the dip is repaired: the board, which the sheet crosses at all times, keeps every bit."""
    options = ["--ignore", "/World/Board", "/World/Sheet", "--fail-on", "remaining"]
    output = repaired(overlapping_sheets(tmp_path), *options)
    assert "Not repaired: " not in capsys.readouterr().out
    assert np.array_equal(points_of(output, 0), sheet(0.1))
    assert not np.array_equal(points_of(output, HIT), sheet(0.1 + 0.001 * HIT, -0.12))
    board = sheet(0.0)[:, [2, 0, 1]] * np.float32(0.6) + np.float32([0.31, 0.0, 0.35])
    assert np.array_equal(points_of(output, HIT, "/World/Board"), board)


def test_meshes_that_cross_at_first_are_repaired_if_asked(tmp_path, capsys):
    output = repaired(overlapping_sheets(tmp_path), "--include-initial", "--fail-on", "remaining", "--json")
    found = json.loads(capsys.readouterr().out)
    assert found["unrepaired_pairs"] == [] and not any(found["remaining"].values())
    assert main(["replay", output, "--device", "cpu", "--fail-on", "collisions,intersections"]) == 0


def test_a_first_frame_that_cannot_be_freed_says_why(tmp_path, capsys, monkeypatch):
    def repair(mesh, x, **options):
        return SimpleNamespace(x=x, crossings=7, unresolved=[SimpleNamespace(reason="no side of it is right")])

    monkeypatch.setattr("warp_bsc.repairing.shot.repair_shot.repair", repair)
    repaired(overlapping_sheets(tmp_path), "--include-initial", "--json")
    found = json.loads(capsys.readouterr().out)
    (reason, *_) = found["stretches"][0]["reasons"]
    assert reason.startswith("the frame at time 0 crosses itself, with 7 edges through faces, of ")
    assert reason.endswith(": no side of it is right")


def meshes_of(count):
    """Stands in for a segment of meshes with one vertex each, and one that the first two share."""
    meshes = [SimpleNamespace(name=f"/M{number}") for number in range(count)]
    vertices = [[number] + [count] * (number < 2) for number in range(count)]
    return SimpleNamespace(meshes=meshes, vertex_count=count + 1, vertices_of=lambda number: vertices[number])


@pytest.mark.parametrize("seed", range(8))
def test_groups_leave_out_kept_and_left_pairs(seed):
    random, count = np.random.default_rng(seed), 12
    segment = meshes_of(count)
    kept = {mesh.name for mesh in segment.meshes if random.random() < 0.3}
    pairs = {(i, j) for i in range(count) for j in range(i, count) if random.random() < 0.3}
    names = [mesh.name for mesh in segment.meshes]
    group, mask = groups_of(segment, kept, [(names[i], names[j]) for i, j in pairs])

    def meet(i, j):
        return bool(group[i] & mask[j] and group[j] & mask[i])

    for i, j in itertools.product(range(count), repeat=2):
        is_unrepaired = (min(i, j), max(i, j)) in pairs or kept >= {names[i], names[j]}
        assert meet(i, j) != is_unrepaired, (i, j)
        assert meet(count, j) or not (meet(0, j) or meet(1, j)), "a shared vertex meets what either mesh meets"


def test_groups_are_limited():
    segment = meshes_of(33)
    names = [mesh.name for mesh in segment.meshes]
    assert groups_of(segment, set(), []) == (None, None)
    groups_of(segment, set(), itertools.combinations(names[:31], 2))
    with pytest.raises(ValueError, match="33 combinations"):
        groups_of(segment, set(), itertools.combinations(names, 2))


def test_larger_moves_are_not_made(tmp_path, capsys):
    stage = dipping_sheet(tmp_path)
    repaired(stage, "--max-move", "0.001", "--fail-on", "remaining", status=1)
    assert "more than 0.001" in capsys.readouterr().out


def test_moved_mesh_with_a_transform(tmp_path):
    stage = dipping_sheet(tmp_path)
    for name in ("Plate", "Sheet"):
        UsdGeom.Xformable(stage.GetPrimAtPath(f"/World/{name}")).AddRotateXYZOp().Set((30, 40, 50))
    output = repaired(stage)
    found = find(output)
    assert not found["hits"]
    old = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/World/Sheet")).GetPointsAttr().Get(2))
    assert np.array_equal(points_of(output, 2), old)


def test_a_limb_that_turns_is_left_free_on_its_arc(tmp_path):
    """A cylinder turns by 8 degrees about an axis outside of it, through a curtain that its chord does not reach."""
    stage = new_stage(tmp_path / "shot.usda")
    angles = np.arange(24) * np.pi / 12
    rings = [
        np.stack([1.5 + 0.5 * np.cos(angles), 0.5 * np.sin(angles), z + 0.0 * angles], axis=1) for z in (-0.7, 0.7)
    ]
    points = np.concatenate(rings).tolist()
    sides = [v for i in range(24) for v in (i, (i + 1) % 24, 24 + (i + 1) % 24, 24 + i)]
    add_mesh(stage, "/World/Limb", points, [4] * 24, sides)
    turn = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Limb")).AddRotateZOp()
    for time, angle in {0: -4, HIT: -4, HIT + 1: 4, FRAMES - 1: 4}.items():
        turn.Set(angle, time)
    curtain = {time: (sheet(0.0)[:, [2, 1, 0]] + [1.9975 + 1e-4 * (time % 2), 0, 0]).tolist() for time in range(FRAMES)}
    add_mesh(stage, "/World/Curtain", curtain, [4] * SIZE**2, quads())
    assert find(stage)["hits"]
    output = repaired(stage)
    assert not find(output)["hits"]
    moved = [points_of(output, time, "/World/Curtain") for time in (0, HIT, HIT + 1, FRAMES - 1)]
    assert (moved[1] + moved[2])[:, 0].max() > 2 * 2.0
    assert np.array_equal(moved[0], np.float32(curtain[0]))
    assert np.allclose(moved[3], curtain[FRAMES - 1], atol=0.01)


def test_last_frame_is_repaired(tmp_path):
    output = repaired(dipping_sheet(tmp_path, last=HIT + 1))
    found = find(output)
    assert not found["hits"] and not any(at["crossings"] for at in found["intersections"])
    assert not np.array_equal(points_of(output, HIT), sheet(0.1 + 0.001 * HIT, -0.12))
    assert points_of(output, HIT)[:, 2].min() > 0


def test_blend():
    displacements = np.zeros((21, 3, 3), np.float32)
    displacements[10, 1] = (0.0, 0.0, 1.0)
    blended = blend(displacements)[:, 1, 2]
    assert not blended[: 10 - BLEND - 2].any() and not blended[11 + BLEND + 2 :].any()
    assert (np.diff(blended[:11]) >= 0).all() and np.allclose(blended, blended[::-1])
    assert blended[10] > 0.9
    assert not blend(displacements)[:, [0, 2]].any()


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"keep": ("/None",)}, "keep: no mesh matches /None"),
        ({"max_move": -1.0}, "max_move"),
        ({"min_distance": -1.0}, "min_distance"),
    ],
)
def test_errors_name_the_argument(dipped, options, error):
    scene = Scene(dipped[0].GetRootLayer().realPath)
    with pytest.raises(ValueError, match=error):
        repair_shot(scene, [], **options)


def test_findings_know_where_a_mesh_jumps(tmp_path):
    stage = dipping_sheet(tmp_path, last=4)
    scene = Scene(save(stage))
    findings = list(find_collisions(scene, replay(scene, device="cpu")))
    assert [finding.is_joined for finding in findings] == [False, True, True]
    assert all(finding.is_free for finding in findings)


def skinned_dipping_sheet(folder, *, by_blend_shape):
    """The sheet of :func:`dipping_sheet`, moved by a joint or a blend shape; its skeleton stands elsewhere."""
    stage = new_stage(folder / "shot.usda")
    plate = sheet(0.0) * np.float32(3.0)
    add_mesh(stage, "/World/Plate", [tuple(map(float, point)) for point in plate], [4] * SIZE**2, quads())
    UsdSkel.Root.Define(stage, "/World/Model").AddTranslateOp().Set((0.05, 0.02, 0.3))
    skeleton = UsdSkel.Skeleton.Define(stage, "/World/Model/Skeleton")
    skeleton.AddRotateZOp().Set(30.0)
    rest = Gf.Matrix4d(1.0)
    skeleton.CreateJointsAttr(["root", "root/tip"])
    skeleton.CreateBindTransformsAttr([rest, rest])
    skeleton.CreateRestTransformsAttr([rest, rest])
    animation = UsdSkel.Animation.Define(stage, "/World/Model/Animation")
    # the binding is inherited from the root
    binding = UsdSkel.BindingAPI.Apply(stage.GetPrimAtPath("/World/Model"))
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    mesh = add_mesh(stage, "/World/Model/Sheet", sheet(-0.1).tolist(), [4] * SIZE**2, quads())
    own = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    bump = sheet(0.0, -1.0)[:, 2]
    if by_blend_shape:
        shape = UsdSkel.BlendShape.Define(stage, "/World/Model/Sheet/Dip")
        shape.CreateOffsetsAttr([(0.0, 0.0, float(z)) for z in bump])
        own.CreateBlendShapesAttr(["Dip"])
        own.CreateBlendShapeTargetsRel().SetTargets([shape.GetPath()])
        animation.CreateBlendShapesAttr(["Dip"])
        for time in range(FRAMES):
            animation.CreateBlendShapeWeightsAttr().Set([0.25 if time == HIT else 0.01 * (time % 2)], time)
    else:
        animation.CreateJointsAttr(["root", "root/tip"])
        animation.CreateRotationsAttr([Gf.Quatf(1.0)] * 2)
        animation.CreateScalesAttr([Gf.Vec3h(1.0)] * 2)
        for time in range(FRAMES):
            down = -0.25 if time == HIT else -0.01 * (time % 2)
            animation.CreateTranslationsAttr().Set([(0, 0, 0), (0, 0, down)], time)
        own.CreateJointIndicesPrimvar(False, 2).Set([0, 1] * len(bump))
        weights = [float(w) for z in bump for w in (1.0 + z, -z)]
        own.CreateJointWeightsPrimvar(False, 2).Set(weights)
    return stage


@pytest.mark.parametrize("by_blend_shape", [False, True])
def test_skinned_mesh_gets_points_of_its_own(tmp_path, capsys, by_blend_shape):
    stage = skinned_dipping_sheet(tmp_path, by_blend_shape=by_blend_shape)
    output = repaired(stage, "--json")
    found = json.loads(capsys.readouterr().out)
    assert all(found["before"].values()) and not any(found["remaining"].values())
    before, after = (list(Scene(str(path))) for path in (save(stage), output))
    plays = Usd.Stage.Open(output)
    cache = UsdSkel.Cache()
    root = UsdSkel.Root(plays.GetPrimAtPath("/World/Model"))
    cache.Populate(root, Usd.PrimDefaultPredicate)
    assert not cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate)  # nothing deforms the points a second time
    mesh = UsdGeom.Mesh(plays.GetPrimAtPath("/World/Model/Sheet"))
    assert len(mesh.GetPointsAttr().GetTimeSamples()) == FRAMES
    for index in (0, 5):  # free frames play back as before
        np.testing.assert_allclose(after[index].x0, before[index].x0, atol=1e-6)
    assert np.abs(after[HIT].x0 - before[HIT].x0).max() > 0.01


def test_minimum_distance_is_kept_between_samples(tmp_path, capsys):
    stage = dipping_sheet(tmp_path, dip=-0.1)  # to 0.016 above the plate
    repaired(stage)
    assert "Nothing was moved" in capsys.readouterr().out
    output = repaired(stage, "--min-distance", "0.03", "--json")
    found = json.loads(capsys.readouterr().out)
    assert found["before"]["pairs nearer than 0.03"] and not found["remaining"]["pairs nearer than 0.03"]
    assert not found["stretches"][0]["uncertified"] and found["initially_near"] == 0
    for interval in Scene(output):
        faces, count = interval.segment.faces, interval.segment.vertex_count
        detector = CollisionDetector(CollisionMesh(faces, count, device="cpu"), method="exact", min_distance=0.03)
        found = detector.detect(interval.x0, interval.x1)
        assert not len(found.vertex_face) and not len(found.edge_edge)


def test_pairs_that_start_too_near_come_no_nearer(tmp_path, capsys):
    stage = dipping_sheet(tmp_path)
    repaired(stage, "--min-distance", "0.105", "--json")  # the sheet begins 0.1 above the plate
    found = json.loads(capsys.readouterr().out)
    assert found["initially_near"] > 0
    distances = [points_of(tmp_path / "fixed.usdc", time)[:, 2].min() for time in (0, HIT)]
    assert distances[0] == np.float32(0.1) and distances[1] > 0.0999
