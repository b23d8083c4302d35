"""Frames of mesh files: what patterns stand for, where files are written to, and the scene that they are."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest
import trimesh

import warp_bsc as bsc
from warp_bsc.mesh_files.file_scene import FileScene
from warp_bsc.mesh_files.frames import Frames, find_frames, make_folder

BALL = trimesh.creation.icosphere(1)
PLATE = trimesh.Trimesh([[-9, -9, 0], [9, -9, 0], [0, 9, 0]], [[0, 1, 2]])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def touch(*names):
    for name in names:
        os.makedirs(os.path.dirname(name) or ".", exist_ok=True)
        open(name, "w").close()


def test_patterns_stand_for_numbered_files(folder):
    touch("body.obj", "a_0009.obj", "a_0010.obj", "a_12345.obj", "a_1.obj", "a_0010_b.obj", "x/2_v7.ply", "x/10_v9.ply")
    frames = find_frames(["body.obj", "a_####.obj"])
    assert frames.numbers == [9, 10, 12345] and frames.are_several == [False, True]
    assert frames.paths == [["body.obj", name] for name in ("a_0009.obj", "a_0010.obj", "a_12345.obj")]
    assert find_frames(["x/*.ply"]) == Frames(["x/*.ply"], [7, 9], [["x/2_v7.ply"], ["x/10_v9.ply"]])
    assert find_frames(["x/#_v?.ply"]).numbers == [2, 10]
    assert find_frames(["a_001?.obj"]) == Frames(["a_001?.obj"], [10], [["a_0010.obj"]])
    assert find_frames(["body.obj", "none.obj"]) == Frames(["body.obj", "none.obj"], [0], [["body.obj", "none.obj"]])


def test_a_file_whose_name_is_like_a_pattern_is_that_file(folder):
    touch("a_#1.obj", "a_11.obj", "b[1].obj")
    assert find_frames(["a_#1.obj", "b[1].obj"]).paths == [["a_#1.obj", "b[1].obj"]]


@pytest.mark.parametrize(
    ("names", "error"),
    [
        (["b_##.obj"], "b_##.obj: no file matches"),
        (["a_###.obj"], "a_###.obj: no file matches"),
        (["a_*.obj"], "a_1.obj: has the number of a_01.obj"),
        (["*.ply"], "c.ply: its name has no number"),
        (["a_##.obj", "d_##.obj"], "a_##.obj: there is no file for frame 2"),
    ],
)
def test_patterns_that_do_not_fit(folder, names, error):
    touch("a_01.obj", "a_1.obj", "c.ply", "d_02.obj")
    with pytest.raises((ValueError, FileNotFoundError), match=re.escape(error)):
        find_frames(names)


def test_outputs(folder):
    touch("body.obj", "a_09.obj", "a_10.obj", "b_9.ply", "b_10.ply")
    frames = find_frames(["body.obj", "a_##.obj", "b_#.ply"])
    assert frames.outputs(["b_*"], "free_####.obj") == [[None, "free_0009.obj", None], [None, "free_0010.obj", None]]
    assert frames.outputs([], "out/") == [[None, "out/a_09.obj", "out/b_9.ply"], [None, "out/a_10.obj", "out/b_10.ply"]]
    assert not os.path.exists("out")
    make_folder("out")
    assert not os.path.exists("out")
    make_folder("out/x/")
    assert os.path.isdir("out/x")
    assert find_frames(["body.obj"]).outputs([], "x#.obj") == [["x#.obj"]]
    for names, keep, output, error in (
        (["a_##.obj"], [], "free.obj", "free.obj: must be a folder, or have #"),
        (["a_##.obj"], [], "free_#.ply", "free_9.ply: must end as a_09.obj does"),
        (["a_##.obj"], [], "a_1#.obj", None),
        (["a_##.obj"], [], "a_##.obj", "a_09.obj: named twice, or read"),
        (["a_##.obj"], [], "./", "./a_09.obj: named twice, or read"),
        (["a_##.obj", "b_#.ply"], [], "free_#.ply", "free_#.ply: must be a folder, as not one"),
        (["a_##.obj"], ["b"], "free_#.obj", "--keep: no file matches b"),
        (["a_##.obj", "body.obj"], ["a*"], "free_#.obj", "free_#.obj: must be a folder, as not one"),
    ):
        if error:
            with pytest.raises(ValueError, match=re.escape(error)):
                find_frames(names).outputs(keep, output)
        else:
            find_frames(names).outputs(keep, output)


def write_frames(heights, name="ball_{:02}.ply", mesh=BALL):
    for number, height in heights.items():
        mesh.copy().apply_translation([0.0, 0.0, height]).export(name.format(number))


@pytest.mark.parametrize("name", ["ball_{:02}.ply", "ball_{:02}.obj", "ball_{:02}.stl", "ball_{:02}.glb"])
def test_the_motion_from_frame_to_frame_is_replayed(folder, name):
    """A ball that falls through a plate between two frames at which it is free."""
    write_frames({3: 3.0, 4: 2.0, 6: -2.0}, name)
    PLATE.export("plate.obj")
    scene = FileScene(find_frames(["plate.obj", name.replace("{:02}", "##")]))
    assert scene.times == [3.0, 4.0, 6.0] and len(scene) == 2 and scene.stage is None
    results = list(bsc.replay(scene, device="cpu"))
    x0, x1 = (np.concatenate([PLATE.vertices, BALL.vertices + np.array([0.0, 0.0, height])]) for height in (2.0, -2.0))
    mesh = bsc.CollisionMesh(np.concatenate([PLATE.faces, BALL.faces + 3]), len(x0), device="cpu")
    found = bsc.CollisionDetector(mesh, method="exact").detect(x0, x1)
    assert [result.summary.hits for result in results] == [0, len(found.vertex_face) + len(found.edge_edge)]
    assert sorted(results[1].summary.earliest.meshes) == sorted(scene.names)
    assert not results[1].summary.intersections[1].crossings


def test_frames_of_a_soup_that_turns_have_the_same_faces(folder):
    for number in range(3):
        BALL.copy().apply_transform(trimesh.transformations.rotation_matrix(number, [1, 2, 3])).export(
            f"b_{number}.stl"
        )
    scene = FileScene(find_frames(["b_#.stl"]))
    assert len(scene) == 2 and not any("other faces" in warning for warning in scene.warnings)


def test_single_precision_stays(folder):
    write_frames({1: 0.0, 2: 0.1})
    scene = FileScene(find_frames(["ball_##.ply"]))
    assert scene.dtype == np.float32 and scene.interval(0).x1.dtype == np.float32


@pytest.mark.parametrize("at", [2, 3])
def test_where_faces_change_the_motion_is_not_checked(folder, at):
    write_frames({number: 2.0 - 4.0 * (number >= at) for number in (1, 2, 3)})
    write_frames({number: -2.0 for number in range(at, 4)}, mesh=trimesh.creation.icosphere(2))
    PLATE.export("plate.obj")
    scene = FileScene(find_frames(["plate.obj", "ball_##.ply"]))
    assert scene.warnings[-1] == f"ball_##.ply has other faces at time {at}: the motion to it is not checked"
    results = list(bsc.replay(scene, device="cpu"))
    assert sum(result.summary.hits for result in results) == 0
    assert [len(interval.segment.faces) for interval in scene] == ([81, 321] if at == 2 else [81, 81, 321])


def test_a_scene_of_one_frame_is_at_rest(folder):
    trimesh.util.concatenate([BALL, BALL.copy().apply_translation([1.5, 0, 0])]).export("two.glb")
    scene = FileScene(find_frames(["two.glb"]))
    (result,) = bsc.replay(scene, device="cpu")
    assert scene.is_still and result.summary.intersections[0].crossings > 0
    with pytest.raises(ValueError, match="a file is named twice"):
        FileScene(find_frames(["two.glb", "two.glb"]))


def test_files_that_change_meanwhile_are_an_error(folder):
    write_frames({1: 0.0, 2: 1.0})
    scene = FileScene(find_frames(["ball_##.ply"]))
    assert "ball_01.ply" in scene.files and "other.ply" not in scene.files
    write_frames({2: 2.5}, "ball_{:02}.ply", trimesh.creation.icosphere(2))
    with pytest.raises(ValueError, match=r"ball_02\.ply: the file has changed"):
        scene.files.check()


def test_openusd_is_not_needed(folder):
    write_frames({1: 0.0, 2: 1.0})
    script = (
        "import sys; sys.modules['pxr'] = None\n"
        "import warp_bsc as bsc\n"
        "from warp_bsc.mesh_files.file_scene import FileScene\n"
        "from warp_bsc.mesh_files.frames import find_frames\n"
        "print(len(list(bsc.replay(FileScene(find_frames(['ball_##.ply'])), device='cpu'))))"
    )
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert found.stdout.splitlines()[-1] == "1"
