"""The commands ``warp-bsc check`` and ``warp-bsc repair`` for frames of mesh files, and the pages of mesh files."""

import json
import os
import signal

import numpy as np
import pytest
import trimesh
from replay_files import Page

import warp_bsc as bsc
from warp_bsc.cli.main import main
from warp_bsc.mesh_files.mesh_file import MeshFile

BODY = trimesh.creation.icosphere(2).apply_translation([0.0, 0.0, -1.4])
SHEET = trimesh.creation.icosphere(2, radius=0.5)
HEIGHTS = {number: 0.3 - 0.21 * (number in (9, 40)) for number in range(1, 51)}
"""The sheet dips into the body at two frames that are far apart."""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    BODY.export("body.obj", digits=17)
    for number, height in HEIGHTS.items():
        SHEET.copy().apply_translation([0.0, 0.0, height]).export(f"coat_{number:04}.ply")
    return tmp_path


def run(command, *arguments):
    return main([command, "body.obj", "coat_####.ply", *arguments, "--device", "cpu"])


def facts_of(capsys, command, *arguments, status=0):
    capsys.readouterr()
    assert run(command, *arguments, "--json") == status
    return json.loads(capsys.readouterr().out)


def hits(frames):
    """Collisions from each frame to the next, and edges that meet faces, as another reader has the files."""
    faces = np.concatenate([BODY.faces, SHEET.faces + len(BODY.vertices)])
    detector, found, last = None, [0, 0], None
    for path in frames:
        x = np.concatenate([BODY.vertices, trimesh.load_mesh(path, process=False).vertices])
        detector = detector or bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x), device="cpu"), method="exact")
        found[1] += len(detector.find_intersections(x))
        if last is not None:
            collisions = detector.detect(last, x)
            found[0] += len(collisions.vertex_face) + len(collisions.edge_edge)
        last = x
    return found


def test_check_finds_what_each_frame_and_each_motion_has(folder, capsys):
    facts = facts_of(capsys, "check", "--fail-on", "collisions", status=1)
    counts = {kind: len(rows) for kind, rows in facts["findings"].items() if rows}
    collisions, crossings = hits([f"coat_{number:04}.ply" for number in HEIGHTS])
    assert counts == {"collisions": collisions, "intersections": crossings} and crossings > 0 < collisions
    assert facts["frames"] == list(HEIGHTS) and facts["is_motion"]
    named = {element["of"] for row in facts["findings"]["intersections"] for element in row}
    assert named == {"body.obj", "coat_0009.ply", "coat_0040.ply"}
    run("check", "--fail-on", "intersections")
    assert "body.obj, coat_####.ply: 50 frames from 1 to 50, and their motion" in capsys.readouterr().out


def test_what_is_not_sound_is_told_of_the_frame_in_which_it_begins(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for number in (1, 2, 3):
        x = SHEET.vertices.copy()
        if number > 1:
            x[7] = x[70]  # far from each other, of no common face
        trimesh.Trimesh(x, SHEET.faces, process=False).export(f"f_{number}.ply", vertex_normal=False)
    assert main(["check", "f_#.ply", "--json", "--device", "cpu"]) == 0
    ((first, second),) = json.loads(capsys.readouterr().out)["findings"]["doubled"]
    assert {first["vertex"], second["vertex"]} == {7, 70} and first["of"] == "f_2.ply"


def test_other_faces_are_said_and_a_broken_frame_is_an_error(folder, capsys):
    trimesh.creation.icosphere(1).export("coat_0009.ply")
    facts = facts_of(capsys, "check")
    assert [note for note in facts["notes"] if "other faces" in note] == [
        f"body.obj, coat_00{number}.ply: other faces than in the frame before, so no motion is checked"
        for number in ("09", "10")
    ]
    (folder / "coat_0030.ply").write_bytes(b"ply\n")
    for command in (["check"], ["repair", "--output", "free/"]):
        assert run(*command) == 2
        assert capsys.readouterr().err.splitlines()[-1].startswith("warp-bsc: error: coat_0030.ply: it has no header")
    assert not os.path.exists("free")


@pytest.mark.parametrize(("output", "name"), [("free/", "free/coat_{:04}.ply"), ("f_#.ply", "f_{}.ply")])
def test_repaired_frames_are_free_for_another_reader(folder, capsys, output, name):
    facts = facts_of(capsys, "repair", "--output", output, "--fail-on", "remaining")
    paths = [name.format(number) for number in HEIGHTS]
    assert hits(paths) == [0, 0] and facts["remaining"] == {"collisions": 0, "intersections": 0}
    assert [*facts["before"].values()] == hits([f"coat_{number:04}.ply" for number in HEIGHTS])
    moved = {frame["time"] for stretch in facts["stretches"] for frame in stretch["frames"]}
    assert {9, 40} <= moved and len(moved) < 45 and facts["kept"] == {"body.obj": "it is one file for all frames"}
    for number, path in zip(HEIGHTS, paths, strict=True):
        before, after = f"coat_{number:04}.ply", MeshFile(path)
        is_copy = (folder / before).read_bytes() == (folder / path).read_bytes()
        assert is_copy == (number not in moved) and (after.faces == MeshFile(before).faces).all()
    assert not [file for file in os.listdir() if file.endswith((".part", ".tmp"))]


def stop_after_one_stretch(monkeypatch):
    module = __import__("warp_bsc.cli.repair_run", fromlist=["repair_shot"])
    whole = module.repair_shot

    def stopped(*arguments, **options):
        stretches = whole(*arguments, **options)
        yield next(stretches)
        os.kill(os.getpid(), signal.SIGINT)
        yield from stretches

    monkeypatch.setattr(module, "repair_shot", stopped)


def test_an_interrupted_repair_leaves_whole_frames_from_which_it_is_resumed(folder, monkeypatch):
    assert run("repair", "--output", "whole/") == 0
    with monkeypatch.context() as patch:
        stop_after_one_stretch(patch)
        assert run("repair", "--output", "free/", "--report", "page.html") == 130
    written = sorted(os.listdir("free"))
    assert 9 < len(written) < 40 and written == sorted(os.listdir("whole"))[: len(written)]
    assert hits([f"free/{name}" for name in written]) == [0, 0]
    assert Page((folder / "page.html").read_text()).data["partial"].startswith("Partial: interrupted.")
    assert run("repair", "--output", "free/", "--resume") == 0
    for name in os.listdir("whole"):
        assert (folder / "free" / name).read_bytes() == (folder / "whole" / name).read_bytes()
    assert len(os.listdir("free")) == 50 and not os.path.exists("free.part")


def test_a_repair_that_is_interrupted_before_anything_is_repaired_writes_nothing(folder, monkeypatch):
    module = __import__("warp_bsc.cli.repair_run", fromlist=["replay"])
    whole = module.replay

    def stopped(*arguments, **options):
        for result in whole(*arguments, **options):
            yield result
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(module, "replay", stopped)
    assert run("repair", "--output", "f_#.ply") == 130
    assert not [name for name in os.listdir() if name.startswith(("f_", "."))]


def test_an_error_while_a_frame_is_written_leaves_the_frames_before(folder, monkeypatch, capsys):
    file = __import__("warp_bsc._atomic_file", fromlist=["OutputFile"]).OutputFile
    write = file.write

    def full(output, text):
        if output.path.name == "coat_0012.ply":
            raise OSError(28, "No space left on device")
        write(output, text)

    monkeypatch.setattr(file, "write", full)
    assert run("repair", "--output", "free/") == 2
    assert "free/coat_0012.ply: No space left on device" in capsys.readouterr().err
    assert all(len(MeshFile(f"free/{name}").x) == len(SHEET.vertices) for name in os.listdir("free"))


def test_frames_before_and_after_a_change_of_faces_are_repaired(folder, capsys):
    for number in range(7, 13):
        mesh = trimesh.creation.icosphere(3 if number < 10 else 2, radius=0.5)
        mesh.apply_translation([0.0, 0.0, 0.05 + 0.001 * number]).export(f"coat_{number:04}.ply")
    for number in {*HEIGHTS} - {*range(7, 13)}:
        os.remove(f"coat_{number:04}.ply")
    assert run("repair", "--output", "free/", "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert (
        facts["before"]["intersections"] > 0 == facts["remaining"]["intersections"] == facts["remaining"]["collisions"]
    )
    assert {frame["time"] for stretch in facts["stretches"] for frame in stretch["frames"]} == set(range(7, 13))
    for number in range(7, 13):
        before, after = MeshFile(f"coat_{number:04}.ply"), MeshFile(f"free/coat_{number:04}.ply")
        assert (before.faces == after.faces).all()
        assert 0.0 < np.abs(after.x - before.x).max() < 0.1


def test_where_nothing_collides_the_frames_are_copied(folder, capsys):
    capsys.readouterr()
    assert main(["repair", "coat_000[1-5].ply", "--output", "free/", "--device", "cpu"]) == 0
    assert "Wrote free/." in capsys.readouterr().out
    assert sorted(os.listdir("free")) == [f"coat_000{number}.ply" for number in range(1, 6)]
    for name in os.listdir("free"):
        assert (folder / "free" / name).read_bytes() == (folder / name).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["--output", "free.ply"], "free.ply: must be a folder, or have #"),
        (["--output", "none/f_#.ply"], "none/f_1.ply: there is no folder none"),
        (["--output", "f_#.ply", "--order"], "--order is not for frames of mesh files"),
        (["--output", "f_#.ply", "--previous", "body.obj"], "--previous is not for frames of mesh files"),
        (["--output", "f_#.ply", "--frames", "1:2"], "--frames is not for frames of mesh files"),
        (["--output", "f_#.ply", "--keep", "x"], "--keep: no"),
        (["--output", "f_#.ply", "--report", "body.obj"], "--report must be a file of its own, .html, not body.obj"),
        (["--output", "f_#.ply", "--report", "-"], "--report must be a file of its own, .html, not standard output"),
    ],
)
def test_errors_of_frames(folder, capsys, arguments, error):
    before = sorted(os.listdir())
    assert run("repair", *arguments) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"warp-bsc: error: {error}")
    assert sorted(os.listdir()) == before


def test_the_page_of_a_check_has_its_findings(folder, capsys):
    counts = {kind: len(rows) for kind, rows in facts_of(capsys, "check", "--report", "page.html")["findings"].items()}
    page = Page((folder / "page.html").read_text())
    assert page.data["title"] == "Collisions in body.obj, coat_####.ply"
    assert sum(interval[2] + interval[3] for interval in page.data["intervals"]) == counts["collisions"]
    assert sum(at[1] for at in page.data["rest"]) == counts["intersections"]
    assert [mesh["name"] for mesh in page.data["meshes"]] == ["body.obj", "coat_####.ply"]
    assert "view-8" in page.blocks and page.data["cameras"] == []


def test_the_page_of_one_repaired_file(folder, capsys):
    SHEET.copy().apply_translation([0.0, 0.0, -0.05]).export("coat.glb")
    arguments = ["repair", "body.obj", "coat.glb", "--keep", "body.obj", "--output", "free.glb", "--report", "a.html"]
    assert main([*arguments, "--json", "--device", "cpu"]) == 0
    facts = json.loads(capsys.readouterr().out)
    page = Page((folder / "a.html").read_text())
    assert facts["certified"] and page.data["title"] == "Repair of body.obj, coat.glb"
    (before,), (after,) = page.data["before"], page.data["after"]
    assert before[3] == facts["before"]["intersections"] > 0 == after[3]
    (frame,) = page.data["frames"]
    assert frame["moved"] == facts["files"][1]["moved"]
    np.testing.assert_allclose(frame["move"], facts["files"][1]["largest_move"], rtol=1e-5)
    assert [mesh["kept"] for mesh in page.data["meshes"]] == [True, False]
    assert main(["check", "coat.glb", "--report", "b.html", "--device", "cpu"]) == 0
    assert Page((folder / "b.html").read_text()).data["nothing"].startswith("Nothing intersects")


def triage_of(*meshes):
    """A triage file by which files are meant to meet."""
    entry = {"meshes": meshes, "reason": "sewn on", "who": "ada", "date": "2026-11-29"}
    with open("meant.json", "w") as file:
        json.dump({"version": 1, "meant": [entry]}, file)
    return "--triage", "meant.json", "--device", "cpu"


def test_what_is_meant_is_neither_listed_nor_repaired(folder, capsys):
    """Names are those that the command is given; an entry that matches none is told."""
    names = ("body.obj", "coat_####.ply")
    triage = triage_of(*names)
    assert main(["check", *names, *triage, "--fail-on", "intersections,collisions"]) == 0
    assert "note: meant: sewn on (ada, 2026-11-29): " in capsys.readouterr().out
    assert main(["repair", *names, "--output", "free/", *triage, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert not facts["stretches"] and not any(facts["before"].values())
    triage = triage_of("body.obj", "cat.ply")
    assert main(["check", *names, *triage, "--fail-on", "intersections"]) == 1
    assert "triage: entries that match no meshes: 1, the first is body.obj cat.ply" in capsys.readouterr().out


def test_what_is_meant_in_one_frame_is_not_repaired(folder, capsys):
    """Of two balls that cross the body, the one that is not meant to leaves it, also with the other one kept."""
    SHEET.copy().apply_translation([0.4, 0.0, -0.2]).export("right.obj", digits=17)
    SHEET.copy().apply_translation([-0.9, 0.0, -0.3]).export("left.obj", digits=17)
    files, triage = ["body.obj", "left.obj", "right.obj"], triage_of("left.obj", "body.obj")
    for keep in ((), ("--keep", "left.obj")):
        assert main(["repair", *files, "--output", "free/", *keep, *triage, "--json"]) == 0
        facts = json.loads(capsys.readouterr().out)
        assert facts["before"]["intersections"] and facts["certified"]
        assert all(bool(row["moved"]) == (row["file"] != "left.obj") for row in facts["files"])
        fixed = ["free/body.obj", "left.obj", "free/right.obj"]
        x = [MeshFile(path) for path in fixed]
        counts = [len(file.x) for file in x]
        faces = np.concatenate([file.faces + shift for file, shift in zip(x, [0, *np.cumsum(counts)], strict=False)])
        mesh = bsc.CollisionMesh(faces, sum(counts), device="cpu")
        found = bsc.CollisionDetector(mesh).find_intersections(np.concatenate([file.x for file in x]))
        file_of = np.repeat([0, 1, 2], counts)
        ends = file_of[mesh.edges[found[:, 0], 0]], file_of[faces[found[:, 1], 0]]
        pairs = {frozenset(pair) for pair in zip(*ends, strict=True)}
        assert pairs == {frozenset({0, 1})}
