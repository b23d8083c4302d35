"""Meshes that are there twice: which are duplicates, where they are named, and that many cost what few do."""

import json

import numpy as np
import pytest
from boxes import CORNERS, SIDES
from pxr import Usd
from replay_files import Page, replay
from usd_stages import add_mesh, find, moved, new_stage, save

import warp_bsc as bsc
from warp_bsc.cli.main import main
from warp_bsc.detection.at_rest import containment


def add_box(stage, path, size=1.0, by=(0, 0, 0), *, seed=None, counts=None, sides=SIDES):
    """A box; a seed changes the order of its points, of its faces, of their corners, and to which side they face."""
    points = moved(np.multiply(CORNERS, size), by)
    faces = np.reshape(sides, (-1, 4))
    if seed is not None:
        random = np.random.default_rng(seed)
        order = random.permutation(len(points))
        points, faces = [points[point] for point in order], random.permutation(np.argsort(order)[faces])
        faces = np.array([np.roll(face, random.integers(4))[:: random.choice([-1, 1])] for face in faces])
    return add_mesh(stage, path, points, counts or [4] * len(faces), faces.ravel().tolist())


@pytest.fixture
def stage(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    for name in "ABC":
        add_box(stage, f"/World/{name}")
    return stage


def groups(stage, **selection):
    """The duplicates of the first interval."""
    scene = bsc.Scene(save(stage), selection=bsc.Selection(**selection))
    return [set(name.removeprefix("/World/") for name in group) for group in next(iter_summaries(scene)).duplicates]


def iter_summaries(scene):
    return (result.summary for result in bsc.replay(scene, device="cpu"))


def test_meshes_with_the_same_polygons_are_duplicates(stage):
    for seed in range(4):
        add_box(stage, f"/World/Shuffled{seed}", seed=seed)
    unused = add_box(stage, "/World/WithPoint")
    unused.GetPointsAttr().Set([*unused.GetPointsAttr().Get(), (9, 9, 9)])
    ulp = add_box(stage, "/World/Ulp")
    points = np.array(ulp.GetPointsAttr().Get())
    points[0, 0] = np.nextafter(points[0, 0], np.float32(9))
    ulp.GetPointsAttr().Set([tuple(map(float, point)) for point in points])
    add_box(stage, "/World/Open", sides=SIDES[4:])
    add_box(stage, "/World/Larger", 2.0)
    shuffled = {f"Shuffled{seed}" for seed in range(4)}
    assert groups(stage) == [{"A", "B", "C", "WithPoint"} | shuffled]
    assert groups(stage, ignore=(("/World/A", "/World/*"), ("/World/B", "/World/Shuffled*"))) == [
        {"B", "C", "WithPoint"} | shuffled
    ]
    assert groups(stage, between=("/World/A", "/World/Shuffled*")) == [{"A"} | shuffled]
    assert groups(stage, exclude=("/World/[BC]", "/World/W*", "/World/S*")) == []


def test_duplicates_move_alike(stage):
    """B moves as A does until time 2; C stays where both begin, and so do D and E."""
    for name in "DE":
        add_box(stage, f"/World/{name}")
    for name, last in (("A", 2.0), ("B", 3.0)):
        points = stage.GetPrimAtPath(f"/World/{name}").GetAttribute("points")
        start = points.Get()
        for time, height in ((0, 0.0), (1, 1.0), (2, last)):
            points.Set(moved(start, (0, 0, height)), time)
    assert groups(stage) == [{"C", "D", "E"}]
    stage.GetPrimAtPath("/World/B").GetAttribute("points").Set(moved(start, (0, 0, 2.0)), 2)
    assert groups(stage) == [{"A", "B"}, {"C", "D", "E"}]


def test_all_files_name_duplicates(stage, tmp_path, capsys):
    add_box(stage, "/World/Case", 4.0, (-1, -1, -1))
    before = tmp_path / "before.json"
    stage.GetPrimAtPath("/World/C").SetActive(False)
    assert main(["replay", save(stage), "--device", "cpu", "--json", str(before)]) == 0
    stage.GetPrimAtPath("/World/C").SetActive(True)
    capsys.readouterr()
    options = ["--fail-on", "duplicates", "--baseline", str(before)]
    files = replay(stage, *options, status=1)
    printed = capsys.readouterr().out
    sentence = "3 meshes are duplicates of each other, at 0: /World/A, /World/B, /World/C"
    assert f"{sentence}.\n" in printed
    assert "  /World/A and 2 others are duplicates at 0\n" in printed
    found = json.loads(files[0].read_text())
    names = [found["meshes"][number] for number in found["duplicate_spans"][0].pop("mesh")]
    assert names == ["/World/A", "/World/B", "/World/C"] and found["duplicate_spans"] == [{"since": 0, "until": 0}]
    assert found["intervals"][0]["duplicates"] == [[0, 1, 2]]
    overlay = Usd.Stage.Open(str(files[2]))
    assert list(overlay.GetRootLayer().customLayerData["collisions"]["duplicates"]) == [sentence]
    page = Page(files[3].read_text())
    assert ["3", "meshes that are duplicates"] in page.data["tiles"] and f"{sentence}." in page.data["notes"]
    assert main(["replay", save(stage), "--device", "cpu", "--fail-on", "new", "--baseline", str(files[0])]) == 0
    stage.GetPrimAtPath("/World/C").SetActive(False)  # fewer are not new
    assert main(["replay", save(stage), "--device", "cpu", "--fail-on", "new", "--baseline", str(files[0])]) == 0


@pytest.mark.parametrize(
    ("options", "status"),
    [([], 0), (["--fail-on", "duplicates"], 1), (["--fail-on", "duplicates", "--no-intersections"], 2)],
)
def test_exit_status(stage, options, status):
    assert main(["replay", save(stage), "--device", "cpu", *options]) == status


def test_a_page_without_other_findings_is_not_green(stage, tmp_path):
    page = tmp_path / "page.html"
    assert main(["replay", save(stage), "--device", "cpu", "--report", str(page)]) == 0
    assert not Page(page.read_text()).data["nothing"]


def test_resumed_replays_have_the_duplicates(stage, tmp_path):
    points = stage.GetPrimAtPath("/World/A").GetAttribute("points")
    for time in range(3):
        points.Set(moved(points.Get(), (0, 0, 5.0)), time)
    out = tmp_path / "hits.json"
    command = ["replay", save(stage), "--device", "cpu", "--json", str(out)]
    assert main(command) == 0
    whole = out.read_text()
    assert json.loads(whole)["duplicate_spans"] == [{"mesh": [1, 2], "since": 0, "until": 2}]
    lines = whole.splitlines(keepends=True)
    out.write_text("".join([*lines[:2], *lines[-1:]]).replace('"complete": true', '"complete": false'))
    assert main([*command, "--resume"]) == 0
    assert out.read_text() == whole


def test_what_is_inside_duplicates_is_inside_each(tmp_path):
    """Boxes of three sizes in one place, each several times, against a replay of the two meshes of each pair alone."""
    stage = new_stage(tmp_path / "scene.usda")
    names = []
    for size, count in ((1.0, 3), (2.0, 2), (4.0, 3)):
        for number in range(count):
            names.append(f"/World/Box{size:.0f}_{number}")
            add_box(stage, names[-1], size, 3 * [-size / 2], seed=None if number < 2 else 7)
    path = save(stage)

    def rows_of(**selection):
        (result,) = bsc.replay(bsc.Scene(path, selection=bsc.Selection(**selection)), device="cpu")
        at, rows = result.intersections[0], result.intersections[0].inside_rows
        return sorted(zip(at.mesh_names(rows), at.element_names(rows), at.triangles(rows), strict=True))

    pairs = [(a, b) for i, a in enumerate(names) for b in names[i:] if a[:11] != b[:11]]
    expected = [row for pair in pairs for row in rows_of(prims=pair)]
    assert len(expected) == 3 * 2 + 3 * 3 + 2 * 3
    assert rows_of() == sorted(expected)
    some = rows_of(ignore=(("/World/Box1_0", "/World/Box4_1"),))
    assert len(some) == len(expected) - 1


def test_many_duplicates_cost_what_one_does(tmp_path, monkeypatch):
    """Pairs of bounding boxes that are compared are those of one of the boxes and what is in it."""
    compared = []
    enclosing = containment.enclosing_boxes
    monkeypatch.setattr(containment, "enclosing_boxes", lambda *args: compared.append(enclosing(*args)) or compared[-1])
    numbers = []
    for count in (1, 12):
        stage = new_stage(tmp_path / f"scene{count}.usda")
        for number in range(count):
            add_box(stage, f"/World/Box{number}", 2.0)
        add_box(stage, "/World/Inside", 0.5, (1, 1, 1))
        compared.clear()
        found = find(stage)
        numbers.append(sum(map(len, compared)))
        assert found["intervals"][0]["intersections"]["start"]["inside"] == [
            {"meshes": ["/World/Inside", f"/World/Box{number}"], "parts": 1} for number in range(count)
        ]
    assert numbers[0] == numbers[1] > 0
