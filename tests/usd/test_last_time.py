"""What changes at the last time is checked there at rest, as it is then; and one time alone."""

import csv
import json

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from usd_stages import FALLING, HIT, add_falling, add_floor, add_instancer, add_mesh, find, hits, moved, new_stage, save

from warp_bsc.cli.main import main
from warp_bsc.usd.frames import FrameRange
from warp_bsc.usd.scene import Scene

ABOVE, THROUGH = moved(FALLING, (0, 0, 0.25)), moved(FALLING, (0, 0, -0.25))
"""Of THROUGH, the two edges at point 0 pass through the floor."""


@pytest.fixture
def stage(tmp_path):
    """A floor, and what moves beside it until time 2."""
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    beside = moved(FALLING, (9, 0, 0))
    add_mesh(stage, "/World/Beside", {1: beside, 2: moved(beside, (0, 0, 1))})
    return stage


def crossings(found):
    """Names, times and number of edges through faces."""
    return [
        (*span["meshes"], span["since"], span["until"], span["crossings"])
        for span in found["intersections"]
        if not span["inside"]
    ]


def change_topology(stage):
    # The number of points changes as well, so that USD holds the old ones until time 2.
    mesh = add_mesh(stage, "/World/Odd", {1: ABOVE, 2: [*THROUGH, (0.9, -0.9, 0.5)]})
    for time, count, corners in ((1, [3], [0, 1, 2]), (2, [3, 3], [0, 1, 2, 1, 3, 2])):
        mesh.GetFaceVertexCountsAttr().Set(count, time)
        mesh.GetFaceVertexIndicesAttr().Set(corners, time)


def appear(stage):
    visibility = UsdGeom.Imageable(add_mesh(stage, "/World/Odd", THROUGH)).CreateVisibilityAttr()
    for time, value in ((1, "invisible"), (2, "inherited")):
        visibility.Set(value, time)


def vanish(stage):
    visibility = UsdGeom.Imageable(add_mesh(stage, "/World/Odd", {1: THROUGH, 2: ABOVE})).CreateVisibilityAttr()
    for time, value in ((1, "inherited"), (2, "invisible")):
        visibility.Set(value, time)


def emit(stage):
    add_mesh(stage, "/World/Many/Odd", FALLING)
    places = {1: [(0, 0, 1)], 2: [(0, 0, 1), (0, 0, -0.25)]}
    numbers = add_instancer(stage, "/World/Many", places, ["/World/Many/Odd"]).GetProtoIndicesAttr()
    numbers.Clear()
    for time, place in places.items():
        numbers.Set([0] * len(place), time)


def jump(stage):
    """The clip from time 2 on begins elsewhere than the one before ended."""
    folder = save(stage).rsplit("/", 1)[0]
    for name, heights in {"one": {0: 0.5, 1: 0.25}, "two": {0: -0.25, 1: -0.25}, "manifest": {}}.items():
        clip = new_stage(f"{folder}/{name}.usda")
        points = UsdGeom.Mesh(clip.OverridePrim("/Odd")).CreatePointsAttr()
        for time, height in heights.items():
            points.Set(moved(FALLING, (0, 0, height)), time)
        save(clip)
    prim = add_mesh(stage, "/World/Odd", FALLING).GetPrim()
    prim.RemoveProperty("points")
    api = Usd.ClipsAPI(prim)
    api.SetClipAssetPaths(["./one.usda", "./two.usda"])
    api.SetClipPrimPath("/Odd")
    api.SetClipManifestAssetPath("./manifest.usda")
    api.SetClipActive([(1, 0), (2, 1)])
    api.SetClipTimes([(1, 0), (2, 1), (2, 0), (3, 1)])


AT_LAST = {
    change_topology: ("/World/Odd", 2.0, "/World/Odd changes its topology at time 2"),
    appear: ("/World/Odd", 2.0, "/World/Odd appears at time 2"),
    vanish: ("/World/Odd", 1.0, "/World/Odd vanishes at time 2"),
    emit: ("/World/Many[1]/Odd", 2.0, "/World/Many[1]/Odd appears at time 2"),
    jump: ("/World/Odd", 2.0, "/World/Odd jumps at time 2"),
}


@pytest.mark.parametrize("options", [[], ["--subdivide", "3"], ["--frames", "1:2"], ["--frames", "2:2"]])
@pytest.mark.parametrize("change", AT_LAST)
def test_what_changes_at_the_last_time_is_checked_there_as_it_is_then(stage, change, options):
    change(stage)
    name, since, note = AT_LAST[change]
    if change is jump and "--frames" not in options:
        options = [*options, "--frames", "1:2"]  # the clips go on
    found = find(stage, *options)
    is_alone = options == ["--frames", "2:2"]
    if change is vanish and is_alone:
        assert crossings(found) == []
    else:
        last = since if change is vanish else found["intervals"][-1]["end"]
        if "--subdivide" in options and change is vanish:
            last = 1 + 1 / 3  # its heights there are -0.25 and -1/12
        floor = ["/World/Floor"]
        expected = [*floor, name] if found["meshes"].index(name) else [name, *floor]
        assert crossings(found) == [(*expected, since, pytest.approx(last), 2)]
    times = [(interval["start"], interval["end"]) for interval in found["intervals"]]
    assert times[-1] == (2, 2)
    assert is_alone or any(warning.startswith(note) for warning in found["warnings"])
    assert is_alone == any("one time alone: checked at rest, at time 2" in warning for warning in found["warnings"])


def test_the_motion_up_to_the_last_time_is_that_of_the_old_state(stage):
    falling = add_mesh(stage, "/World/Falling", {1: ABOVE, 2: THROUGH})
    falling.CreateVisibilityAttr().Set("inherited", 1)
    falling.GetVisibilityAttr().Set("invisible", 2)
    found = find(stage)
    assert hits(found) == [(*HIT[:4], 1.5, HIT[5])] and crossings(found) == []


def test_a_topology_that_changes_at_each_time(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    points = {time: THROUGH + moved([FALLING[0]] * time, (0, 0, 3)) for time in range(4)}
    mesh = add_mesh(stage, "/World/Fluid", points)
    for time, own in points.items():
        mesh.GetFaceVertexCountsAttr().Set([3] * (1 + time), time)
        indices = [0, 1, 2] + [corner for number in range(3, len(own)) for corner in (1, 2, number)]
        mesh.GetFaceVertexIndicesAttr().Set(indices, time)
    found = find(stage)
    assert [(interval["start"], interval["end"]) for interval in found["intervals"]] == [(0, 1), (1, 2), (2, 3), (3, 3)]
    assert crossings(found) == [("/World/Floor", "/World/Fluid", 0, 3, 2)]


def test_all_files_have_the_last_time(stage, tmp_path, capsys):
    change_topology(stage)
    files = {name: str(tmp_path / f"hits.{name}") for name in ("csv", "npz", "html", "usda")}
    options = ["--csv", files["csv"], "--npz", files["npz"], "--report", files["html"], "--overlay", files["usda"]]
    found = find(stage, *options)
    assert "Intersections at rest at 1 of 2 times" in capsys.readouterr().out
    with open(files["csv"]) as file:
        rows = [row for row in csv.DictReader(file) if row["phase"] == "crosses"]
    assert [(row["start"], row["end"], row["time"]) for row in rows] == [("2.0", "2.0", "2.0")] * 2
    columns = np.load(files["npz"])
    assert columns["starts"].tolist() == [1, 2] and columns["ends"].tolist() == [2, 2]
    overlay = Usd.Stage.Open(files["usda"])
    curves = overlay.GetPrimAtPath("/Collisions/Floor_with_Odd/Intersections").GetAttribute("points")
    assert len(curves.Get(2)) == 2 and not curves.Get(1.9)
    assert found["complete"] and main(["replay", save(stage), "--device", "cpu", "--fail-on", "intersections"]) == 1


def test_a_run_is_resumed_at_the_last_time(stage, tmp_path):
    change_topology(stage)
    whole = find(stage)
    path = tmp_path / "scene.usda.json"
    lines = path.read_text().splitlines(keepends=True)
    unfinished = tmp_path / "scene.usda.json.part"
    unfinished.write_text("".join(lines[:2]))
    path.unlink()
    assert find(stage, "--resume") == whole
    assert json.loads(path.read_text())["complete"]


@pytest.mark.slow
@pytest.mark.parametrize("change", [change_topology, emit])
def test_workers_check_the_last_time(stage, change):
    change(stage)
    alone = find(stage)
    assert find(stage, "--workers", "2")["intervals"] == alone["intervals"]


@pytest.mark.parametrize(("time", "count"), [(2, 2), (1.75, 2), (1.25, 0), (1, 0)])
def test_one_time_alone_is_checked_at_rest(stage, time, count):
    add_mesh(stage, "/World/Odd", {1: ABOVE, 2: THROUGH})
    found = find(stage, "--frames", f"{time}:{time}", "--clearance", "0.001")
    assert [(interval["start"], interval["end"]) for interval in found["intervals"]] == [(time, time)]
    assert found["hits"] == 0 and [crossing[-1] for crossing in crossings(found)] == [2] * (count > 0)
    assert f"frames: one time alone: checked at rest, at time {time:g}" in found["warnings"]
    assert found["motion"] == "At one time there are no collisions, only intersections at rest."
    (interval,) = Scene(save(stage), frames=FrameRange(time, time))
    assert interval.is_at_rest and interval.x0 is interval.x1


def test_a_time_before_or_after_the_scene_is_an_error(stage, capsys):
    for frames in ("0:0", "3:3", "2:1"):
        assert main(["replay", save(stage), "--device", "cpu", "--frames", frames]) == 2
        assert "--frames: " in capsys.readouterr().err
    with pytest.raises(ValueError, match="end must not be before the start"):
        FrameRange(2, 1)


# --- Points with other numbers ---

CUBE = np.array([(x, y, z) for z in (3, 5) for y in (-1, 1) for x in (-1, 1)], dtype=float)
SIDES = np.array([(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)])


def add_renumbered(stage, times, lots):
    """A cube above the floor that does not move, and whose points have other numbers at each time."""
    mesh = add_mesh(stage, "/World/Cube", [(0, 0, 0)] * 8, [4] * 6, SIDES.ravel().tolist())
    mesh.GetPointsAttr().Clear()
    for time in times:
        numbers = lots.permutation(8)
        points = np.empty_like(CUBE)
        points[numbers] = CUBE
        mesh.GetPointsAttr().Set([tuple(point) for point in points.tolist()], time)
        mesh.GetFaceVertexIndicesAttr().Set(numbers[SIDES].ravel().tolist(), time)
    return mesh


@pytest.mark.parametrize("seed", range(4))
def test_points_with_other_numbers_do_not_move(tmp_path, seed):
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    add_renumbered(stage, [0, 1, 2.5], np.random.default_rng(seed))
    found = find(stage, "--subdivide", "2")
    assert found["hits"] == 0 and found["intersections"] == []
    for interval in Scene(save(stage), subdivide=2):
        for x in (interval.x0, interval.x1):
            cube = x[interval.segment.vertices_of(1)]
            assert sorted(map(tuple, cube.tolist())) == sorted(map(tuple, CUBE.tolist()))
    assert "/World/Cube changes its topology 2 times, first at time 1: " in " ".join(found["warnings"])


def test_what_is_renumbered_is_moved_by_its_transform(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    operation = add_renumbered(stage, [0, 1], np.random.default_rng(1)).AddTranslateOp()
    operation.Set((0, 0, 0), 0)
    operation.Set((0, 0, -6), 1)
    found = find(stage)
    # the lower side is at a height of 3, and the cube moves by 6
    assert min(contact["time"] for contact in found["intervals"][0]["contacts"]) == pytest.approx(0.5, abs=1e-5)


def test_equal_topology_that_is_written_again_is_none_that_changes(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    mesh = add_falling(stage)
    for time in (0, 0.5, 1):
        mesh.GetFaceVertexIndicesAttr().Set([0, 1, 2], time)
        mesh.GetFaceVertexCountsAttr().Set([3], time)
    found = find(stage)
    assert hits(found) == [HIT] and found["warnings"] == []
    assert [(interval["start"], interval["end"]) for interval in found["intervals"]] == [(0, 1)]


def test_curves_with_other_numbers_do_not_move(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    curves = UsdGeom.BasisCurves.Define(stage, "/World/Ropes")
    curves.CreateTypeAttr("linear")
    line = [(0.5, -0.5, 1.0), (0.6, -0.5, 1.0), (0.7, -0.5, 1.0), (0.8, -0.5, 1.0), (0.9, -0.5, 1.0)]
    for time, counts, height in ((0, [2, 3], 0.0), (1, [3, 2], -2.0)):
        curves.CreateCurveVertexCountsAttr().Set(counts, time)
        curves.CreatePointsAttr().Set(moved(line, (0, 0, height)), time)
    assert find(stage)["hits"] == 0
