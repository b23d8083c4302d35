"""The command ``warp-bsc check``: findings by their numbers in the files, and exit statuses."""

import json

import numpy as np
import pytest
import trimesh

from warp_bsc.cli.main import main

BALL = trimesh.creation.icosphere(1)
CUBE = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv .5 .2 -1\nv .5 .2 1\nf 1 2 3 4\nf -1 -2 4\nf 1 2 3\n"
"""A quad, a triangle through it, and one on it."""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    BALL.export("ball.obj", digits=17)
    (tmp_path / "quad.obj").write_bytes(CUBE)
    return tmp_path


def run(capsys, *arguments, status=0):
    assert main(["check", *arguments, "--device", "cpu"]) == status
    return capsys.readouterr().out


def found(capsys, *arguments, status=0):
    facts = json.loads(run(capsys, *arguments, "--json", status=status))
    return facts, {kind: rows for kind, rows in facts["findings"].items() if rows}


def test_elements_have_their_numbers_in_the_file(folder, capsys):
    _, findings = found(capsys, "quad.obj")
    assert [
        {"edge": [4, 5], "of": "quad.obj", "at": [0.5, 0.2, -1.0]},
        {"face": 0, "of": "quad.obj", "at": [0, 0, 0]},
    ] in (findings["intersections"])
    assert [[element["face"] for element in row] for row in findings["duplicates"]] == [[2, 0]]
    said = run(capsys, "quad.obj")
    assert "edge [" in said and " of quad.obj" in " ".join(said.split()) and "quad.obj: one configuration" in said
    assert "checked as fans" in said


@pytest.mark.parametrize(
    ("reasons", "status"), [("intersections", 1), ("inside,duplicates", 1), ("inside", 0), ("collisions", 0)]
)
def test_exit_status(folder, capsys, reasons, status):
    run(capsys, "quad.obj", "--fail-on", reasons, status=status)


def test_several_files_are_one_scene(folder, capsys):
    facts, findings = found(capsys, "ball.obj", "quad.obj", "ball.obj")
    assert not facts["is_motion"] and {"intersections", "duplicates", "doubled"} <= findings.keys()
    assert {element["of"] for row in findings["intersections"] for element in row} == {"ball.obj", "quad.obj"}


def test_two_files_of_the_same_faces_are_a_motion(folder, capsys):
    """A ball that falls through a plate, and is apart from it at both ends."""
    plate = trimesh.Trimesh([[-9, -9, 0], [9, -9, 0], [0, 9, 0]], [[0, 1, 2]])
    for name, height in (("start.ply", 2.0), ("end.ply", -2.0), ("above.ply", 3.0)):
        moved = BALL.copy().apply_translation([0.0, 0.0, height])
        trimesh.util.concatenate([plate, moved]).export(name)
    facts, findings = found(capsys, "start.ply", "end.ply", "--fail-on", "collisions", status=1)
    assert facts["is_motion"] and findings.keys() == {"collisions", "borders"} and len(findings["borders"]) == 3
    with_face = [row for row in findings["collisions"] if "vertex" in row[0] and row[1].get("face") == 0]
    assert len(with_face) == len(BALL.vertices)
    _, findings = found(capsys, "start.ply", "above.ply", "--fail-on", "collisions")
    assert findings.keys() == {"borders"}
    assert "start.ply, end.ply: 2 frames from 0 to 1, and their motion" in " ".join(
        run(capsys, "start.ply", "end.ply").split()
    )


def test_errors(folder, capsys):
    for arguments, error in (
        (["none.obj"], "none.obj: No such file or directory"),
        (["ball.gltf"], "ball.gltf: the name of a mesh file must end in"),
        (["ball.obj", "--fail-on", "new"], "argument --fail-on: must be of collisions, intersections,"),
    ):
        assert main(["check", *arguments]) == 2
        assert capsys.readouterr().err.splitlines()[-1].startswith(f"warp-bsc: error: {error}")


def test_stl(folder, capsys):
    """A soup is closed where its corners are in one place."""
    both = trimesh.util.concatenate([BALL, trimesh.creation.icosphere(1, radius=np.float32(0.4))])
    both.export("both.stl")
    _, findings = found(capsys, "both.stl", "--fail-on", "borders,nonmanifold,orientation")
    assert findings.keys() == {"inside"} and len(findings["inside"]) == 1
