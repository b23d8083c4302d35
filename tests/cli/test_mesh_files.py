"""The command ``warp-bsc repair`` for mesh files: what is written, what is checked, and what is said."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from replay_files import Page

import warp_bsc as bsc
from warp_bsc._atomic_file import OutputFile
from warp_bsc.bench.scenes.repair import KNOWN
from warp_bsc.cli.main import main
from warp_bsc.mesh_files.mesh_file import MeshFile

FIRST, SECOND = (trimesh.creation.icosphere(2).apply_translation([x, 0, 0]) for x in (0.0, 1.9))
BALLS = trimesh.util.concatenate([FIRST, SECOND])
CROSSING = 72
"""Edges of the balls that pass through faces."""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, mesh in {"first": FIRST, "second": SECOND, "balls": BALLS}.items():
        for suffix in ("glb", "obj", "off", "ply", "stl"):
            mesh.export(f"{name}.{suffix}")
    return tmp_path


def repair(*arguments):
    return main(["repair", *map(str, arguments), "--device", "cpu"])


def facts_of(capsys, *arguments, status=0):
    assert repair(*arguments, "--json") == status
    return json.loads(capsys.readouterr().out)


def fail(capsys, *arguments):
    """The one line that says what is wrong."""
    assert repair(*arguments) == 2
    output = capsys.readouterr()
    assert output.out == "" and "Traceback" not in output.err
    return output.err.splitlines()[-1].removeprefix("warp-bsc: error: ")


def crossings(*paths):
    """How many edges meet faces in files, as another reader has them."""
    meshes = [trimesh.load_mesh(path, process=False) for path in paths]
    x = np.concatenate([np.asarray(mesh.vertices) for mesh in meshes])
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)])
    x, numbers = np.unique(x, axis=0, return_inverse=True)
    mesh = bsc.CollisionMesh(numbers.reshape(-1)[faces], len(x), device="cpu")
    return len(bsc.CollisionDetector(mesh).find_intersections(x))


@pytest.mark.parametrize("suffix", ["glb", "obj", "off", "ply", "stl"])
def test_what_is_written_is_free_for_another_reader(folder, capsys, suffix):
    assert crossings(f"balls.{suffix}") == CROSSING
    assert repair(f"balls.{suffix}", "--output", f"free.{suffix}") == 0
    said = capsys.readouterr().out
    assert f"Intersections: {CROSSING} before, 0 remain." in said
    assert "What was written has been read again: certified." in said
    assert ("normals are kept" in said) == (suffix == "stl")
    assert crossings(f"free.{suffix}") == 0
    before, after = MeshFile(f"balls.{suffix}"), MeshFile(f"free.{suffix}")
    if suffix != "stl":
        assert 0 < (before.x != after.x).any(axis=1).sum() < 40 and (before.faces == after.faces).all()


def test_it_repairs_as_the_library_does(folder, capsys):
    facts = facts_of(capsys, "balls.obj", "--output", "free.obj")
    result = bsc.repair(BALLS.faces, MeshFile("balls.obj").x, device="cpu")
    assert MeshFile("free.obj").x.tobytes() == result.x.tobytes()
    assert facts["before"] == {"intersections": CROSSING} and facts["remaining"] == {"intersections": 0}
    (file,) = facts["files"]
    assert file["moved"] == (result.moved > 0.0).sum() and file["largest_move"] == result.moved.max()
    assert facts["certified"] is True and facts["max_strain"] == result.max_strain and facts["notes"] == []


def test_a_trimesh_in_place_of_faces_and_positions(folder):
    result, expected = bsc.repair(BALLS, device="cpu"), bsc.repair(BALLS.faces, BALLS.vertices, device="cpu")
    assert isinstance(result.x, np.ndarray) and result.x.tobytes() == expected.x.tobytes() and result.certified
    with pytest.raises(TypeError, match="mesh: faces"):
        bsc.repair(BALLS, BALLS.vertices)
    with pytest.raises(TypeError, match="x must be"):
        bsc.repair(BALLS.faces)


def test_the_library_does_not_import_trimesh_for_it():
    script = (
        "import sys, warp_bsc as bsc, numpy as np; bsc.repair([[0, 1, 2]], np.eye(3)); print('trimesh' in sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert found.stdout.splitlines()[-1] == "False"


def test_files_that_are_kept_are_obstacles(folder, capsys):
    before = (folder / "first.obj").read_bytes()
    facts = facts_of(capsys, "first.obj", "second.ply", "--keep", "fir*", "--output", "free.ply")
    assert [file["output"] for file in facts["files"]] == [None, "free.ply"]
    assert facts["files"][0]["moved"] == 0 < facts["files"][1]["moved"]
    assert facts["certified"] and crossings("first.obj", "free.ply") == 0
    assert (folder / "first.obj").read_bytes() == before


def test_each_piece_of_a_rigid_file_moves_as_a_whole(folder, capsys):
    """Two balls as one file, with a third one between them."""
    trimesh.creation.icosphere(2).apply_translation([1.05, 1.6, 0.1]).export("third.obj")
    apart = trimesh.util.concatenate([FIRST, SECOND.copy().apply_translation([0.2, 0.0, 0.0])])
    apart.export("parts.obj")
    facts = facts_of(capsys, "third.obj", "parts.obj", "--rigid", "parts*", "--keep", "third.obj", "--output", "o.obj")
    assert facts["before"]["intersections"] > 0 and facts["certified"]
    moves = MeshFile("o.obj").x - MeshFile("parts.obj").x
    count = len(FIRST.vertices)
    for piece in (slice(count), slice(count, None)):
        before, after = (mesh.x[piece] for mesh in (MeshFile("parts.obj"), MeshFile("o.obj")))
        lengths = [np.linalg.norm(x[:, None] - x[None], axis=2) for x in (before, after)]
        assert moves[piece].any() and np.abs(lengths[0] - lengths[1]).max() < 1e-13
    assert np.abs(moves[:count].mean(axis=0) - moves[count:].mean(axis=0)).max() > 0.01


def test_what_crosses_among_obstacles_does_not_count(folder, capsys):
    """A ball that crosses another one, both of them obstacles, under a third."""
    SECOND.apply_translation([0.0, 1.8, 0.0]).export("third.obj")
    SECOND.apply_translation([0.0, -1.8, 0.0])
    arguments = ["balls.obj", "third.obj", "--keep", "balls.obj", "--output", "free.obj", "--fail-on", "remaining"]
    facts = facts_of(capsys, *arguments)
    assert facts["before"]["intersections"] > 0 == facts["remaining"]["intersections"] and facts["certified"]
    assert facts["notes"] == [f"in and among obstacles, {CROSSING} edges meet faces; they do not count"]
    assert crossings("balls.obj", "free.obj") == CROSSING


def test_several_files_that_move_are_written_to_a_folder(folder, capsys):
    os.mkdir("free")
    facts = facts_of(capsys, "first.obj", "second.stl", "--output", "free")
    assert [file["output"] for file in facts["files"]] == ["free/first.obj", "free/second.stl"]
    assert crossings("free/first.obj", "free/second.stl") == 0 and facts["certified"]


def test_a_minimum_distance(folder, capsys):
    facts = facts_of(capsys, "balls.obj", "--output", "free.obj", "--min-distance", "0.01")
    assert facts["before"]["pairs nearer than 0.01"] > 0 == facts["remaining"]["pairs nearer than 0.01"]
    mesh = bsc.CollisionMesh(BALLS.faces, len(BALLS.vertices), device="cpu")
    assert bsc.CollisionDetector(mesh).least_distance(MeshFile("free.obj").x) >= 0.01


def test_a_minimum_distance_is_not_certified_for_rounded_coordinates(folder, capsys):
    """A file of single precision in a scene of double precision."""
    arguments = ["first.obj", "second.ply", "--keep", "first.obj", "--output", "free.ply"]
    assert facts_of(capsys, *arguments)["certified"] is True
    assert facts_of(capsys, *arguments, "--min-distance", "0.01")["certified"] is False


def test_order_and_previous_free_sheets_that_have_changed_places(folder, capsys):
    """A sheet that is through another one from border to border."""
    corner = KNOWN["corner"](24)
    assert corner.free is not None
    for name, x, number in (("low", corner.x, 0), ("high", corner.x, 1), ("before", corner.free, 1)):
        faces = corner.faces[(corner.sheet[corner.faces] == number).all(axis=1)]
        mesh = trimesh.Trimesh(x[corner.sheet == number], faces - faces.min(), process=False)
        mesh.export(f"{name}.obj", digits=17)
    os.mkdir("free")
    scene = ["low.obj", "high.obj", "--output", "free"]
    moves = []
    for options in ([], ["--order"], ["--previous", "low.obj", "before.obj"]):
        facts = facts_of(capsys, *scene, *options, "--fail-on", "remaining")
        assert facts["certified"] and crossings("free/low.obj", "free/high.obj") == 0
        assert any(note.endswith("inside to outside: high.obj, low.obj") for note in facts["notes"]) == (not options)
        moves.append(max(row["largest_move"] for row in facts["files"]))
    assert moves[0] < 0.6 * min(moves[1:])


def test_what_is_not_freed_is_named(folder, capsys):
    """A panel that is there twice, which have their border in common."""
    x, faces = np.mgrid[0:1:4j, 0:1:4j].reshape(2, -1).T, []
    for i in (0, 1, 2, 4, 5, 6, 8, 9, 10):
        faces += [[i, i + 1, i + 5], [i, i + 5, i + 4]]
    for name in ("low", "high"):
        trimesh.Trimesh(np.column_stack([x, 0.0 * x[:, 0]]), faces, process=False).export(f"{name}.obj", digits=17)
    os.mkdir("free")
    scene = ["low.obj", "high.obj", "--output", "free"]
    facts = facts_of(capsys, *scene, "--fail-on", "remaining", "--report", "page.html", status=1)
    page = Page((folder / "page.html").read_text()).data
    assert page["tiles"][-1] == ["all but 1", "moved frames certified"]
    (contour,) = facts["unresolved"]
    assert "--order or --previous may tell" in contour["reason"] and facts["certified"] is False
    assert {element["of"] for pair in contour["elements"] for element in pair} == {"low.obj", "high.obj"}
    assert facts["remaining"]["intersections"] == len(contour["elements"]) > 0
    assert repair(*scene) == 0
    said = capsys.readouterr().out
    assert "Not repaired: " in said and "edge [" in said and "not certified." in said


def test_what_rounding_does_is_said(folder, capsys):
    """Sheets nearer to each other than single precision tells apart."""
    x = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    above = np.array([[0.1, 0.1, 1.0 + 1e-9], [0.9, 0.1, 1.0 + 1e-9], [0.1, 0.9, 1.0 + 1e-9]])
    trimesh.Trimesh(np.concatenate([x, above]), [[0, 1, 2], [3, 4, 5]], process=False).export("near.obj", digits=12)
    facts = facts_of(capsys, "near.obj", "--output", "free.obj")
    assert facts["certified"] and facts["before"] == {"intersections": 0}
    (note,) = facts["notes"]
    assert "rounded to single precision" in note


def test_where_nothing_crosses_the_file_is_copied(folder, capsys):
    facts = facts_of(capsys, "first.obj", "--output", "free.obj")
    assert (folder / "free.obj").read_bytes() == (folder / "first.obj").read_bytes()
    assert facts["files"][0]["moved"] == 0 and facts["certified"]


def test_seams_stay_closed(folder, capsys):
    """Vertices that are double, as at seams of textures: they touch, and move together."""
    soup = BALLS.vertices[BALLS.faces].reshape(-1, 3)
    trimesh.Trimesh(soup, np.arange(len(soup)).reshape(-1, 3), process=False).export("soup.obj", digits=17)
    facts = facts_of(capsys, "soup.obj", "--output", "free.obj")
    assert facts["before"] == {"intersections": CROSSING} and facts["certified"]
    x = MeshFile("free.obj").x
    assert len(np.unique(x, axis=0)) == len(BALLS.vertices)


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["none.obj", "--output", "free.obj"], "none.obj: No such file or directory"),
        (["balls.gltf", "--output", "free.gltf"], "balls.gltf: "),
        (["balls.obj", "balls.usd", "--output", "free.obj"], "balls.usd: the name of a mesh file must end in .glb,"),
        (["a.usda", "b.usda", "--output", "free.usda"], "only mesh files can be several"),
        (["balls.obj", "--output", "free.ply"], "free.ply: must end as balls.obj does"),
        (["balls.obj", "--output", "./balls.obj"], "./balls.obj: named twice, or read"),
        (["balls.obj", "--output", "-"], "--output must be a file, not standard output"),
        (["balls.obj", "--output", "none/free.obj"], "none/free.obj: there is no folder none"),
        (["balls.obj", "--output", "free.obj", "--keep", "x*"], "--keep: no file matches x*"),
        (["balls.obj", "--output", "free.obj", "--keep", "*"], "free.obj: must be a folder, as not one file may move"),
        (["first.obj", "second.obj", "--output", "free.obj"], "free.obj: must be a folder, as not one file may move"),
        (["balls.obj", "--output", "free.obj", "--frames", "1:2"], "--frames is not for mesh files"),
        (["balls.obj", "--output", "free.obj", "--fail-on", "distorted"], "--fail-on distorted is for shots"),
        (["demo", "--output", "free.usda", "--order"], "--order is not for USD scenes"),
        (["demo", "--output", "free.usda", "--rigid", "x*"], "--rigid: no mesh matches x*"),
        (["balls.obj", "--output", "free.obj", "--rigid", "x*"], "--rigid: no file matches x*"),
        (["demo", "--output", "free.usda", "--max-strain", "0.5"], "--max-strain is not for USD scenes"),
        (["balls.obj", "--output", "free.obj", "--previous", "first.obj"], "--previous: the files must have the faces"),
        (["balls.obj", "--output", "free.obj", "--previous", "balls.off"], "--previous must not cross"),
        (["first.obj", "--output", "free.obj", "--previous", "first.ply"], "--previous must have the type"),
        (["balls.obj", "--output", "free.obj", "--min-distance", "-1"], "argument --min-distance: must be a finite"),
    ],
)
def test_errors(folder, capsys, arguments, error):
    before = sorted(os.listdir())
    assert fail(capsys, *arguments).startswith(error)
    assert sorted(os.listdir()) == before


def test_two_files_of_one_name_do_not_replace_each_other(folder, capsys):
    os.mkdir("other")
    os.mkdir("free")
    SECOND.export("other/first.obj")
    error = fail(capsys, "first.obj", "other/first.obj", "--output", "free")
    assert error == "free/first.obj: named twice, or read; write to another file" and not os.listdir("free")


@pytest.mark.skipif(sys.platform != "linux", reason="root may write everywhere but to /proc")
def test_a_folder_that_is_not_writable(folder, capsys):
    assert fail(capsys, "balls.obj", "--output", "/proc/free.obj").startswith("/proc/free.obj: ")


def test_an_error_while_writing_leaves_no_file(folder, capsys, monkeypatch):
    (folder / "free.obj").write_text("of an earlier run")
    before = sorted(os.listdir())

    def stop(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(OutputFile, "write", stop)
    assert "No space left on device" in fail(capsys, "balls.obj", "--output", "free.obj")
    assert sorted(os.listdir()) == before and (folder / "free.obj").read_text() == "of an earlier run"


def test_what_was_written_is_judged_not_what_was_to_be(folder, capsys, monkeypatch):
    """A file that another program has changed meanwhile."""
    commit = OutputFile.commit

    def changed(file):
        file.truncate(0)
        file.write((folder / "balls.obj").read_bytes())
        commit(file)

    monkeypatch.setattr(OutputFile, "commit", changed)
    facts = facts_of(capsys, "balls.obj", "--output", "free.obj", "--fail-on", "remaining", status=1)
    assert facts["remaining"] == {"intersections": CROSSING} and facts["certified"] is False


def test_what_single_precision_cannot_hold_is_repaired_as_any_other(folder, capsys):
    x = 1e60 * np.array(
        [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.3, 0.3, -1.0], [0.4, 0.3, 0.1], [0.3, 0.4, 1.0]]
    )
    with open("huge.off", "w", encoding="utf-8") as file:
        file.write("OFF\n6 2 0\n" + "".join(f"{a!r} {b!r} {c!r}\n" for a, b, c in x.tolist()) + "3 0 1 2\n3 3 4 5\n")
    assert facts_of(capsys, "huge.off", "--output", "free.off")["certified"]
