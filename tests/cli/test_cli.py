"""The command line: what it prints, and the status it exits with."""

import contextlib
import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from progress_lines import without_progress
from pxr import Tf, Usd, UsdGeom
from usd_stages import with_names

from warp_bsc.cli import progress, replay_options
from warp_bsc.cli.main import main

ASSETS = Path(__file__).resolve().parents[2] / "assets"
FLOOR = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
# Corner 1 meets the floor at time 3.25, corners 2 and 0 in the same interval; all within one triangle of the floor.
FALLING = [(0.5, -0.5, 0.5), (0.6, -0.5, 0.0), (0.6, -0.6, 0.25)]


@pytest.fixture(scope="session")
def scenes(tmp_path_factory):
    return tmp_path_factory.mktemp("scenes")


def write_scene(path, falling_times=range(5)):
    """A triangle that falls through a floor at rest, in the interval from time 3 to 4."""
    stage = Usd.Stage.CreateNew(str(path))
    floor = UsdGeom.Mesh.Define(stage, "/World/Floor")
    floor.CreatePointsAttr(FLOOR)
    floor.CreateFaceVertexCountsAttr([4])
    floor.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    falling = UsdGeom.Mesh.Define(stage, "/World/Falling")
    falling.CreateFaceVertexCountsAttr([3])
    falling.CreateFaceVertexIndicesAttr([0, 1, 2])
    for time in falling_times:
        falling.CreatePointsAttr().Set([(x, y, z + 3.25 - time) for x, y, z in FALLING], time)
    stage.GetRootLayer().Save()
    return stage


@pytest.fixture(scope="session")
def falling_scene(scenes):
    path = scenes / "falling.usda"
    write_scene(path)
    return str(path)


@pytest.fixture(scope="session")
def safe_scene(scenes):
    path = scenes / "safe.usda"
    write_scene(path, falling_times=range(3))
    return str(path)


def run(capsys, *arguments):
    status = main([*map(str, arguments), "--device", "cpu"])
    output = capsys.readouterr()
    assert status == 0, output.err
    return output.out


def fail(capsys, *arguments):
    """The one line that says what is wrong."""
    assert main([*map(str, arguments)]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    line = output.err.splitlines()[-1]
    assert line.startswith("warp-bsc: error: ")
    assert "Traceback" not in output.err
    return line


@pytest.mark.parametrize("method", ["float", "conservative", "exact"])
def test_replay_finds_the_interval(capsys, falling_scene, method):
    found = with_names(json.loads(run(capsys, "replay", falling_scene, "--json", "--method", method)))
    assert [interval["hits"] for interval in found["intervals"]] == [0, 0, 0, 3]
    interval = found["intervals"][3]
    assert (interval["start"], interval["end"]) == (3, 4)
    assert (interval["vertex_face_hits"], interval["edge_edge_hits"]) == (3, 0)
    assert interval["mesh_pairs"] == [{"meshes": ["/World/Floor", "/World/Falling"], "hits": 3}]
    earliest = interval["earliest"]
    assert 3.25 - 2**-19 <= earliest["time"] <= 3.25
    assert dict(zip(earliest["meshes"], earliest["elements"], strict=True)) == {
        "/World/Falling": "vertex 1",
        "/World/Floor": "face 0",
    }
    assert found["intervals"][0]["earliest"] is None
    assert found["hits"] == 3
    assert found["method"] == method
    assert found["certified"] == (method != "float")


def test_replay_table_fits_a_terminal(capsys, monkeypatch, falling_scene):
    monkeypatch.setenv("COLUMNS", "80")
    output = run(capsys, "replay", falling_scene)
    lines = output.splitlines()
    start = next(number for number, line in enumerate(lines) if "Frames" in line)
    assert lines[start].split() == ["Frames", "Collisions", "Mesh", "pairs", "First", "at"]
    assert max(map(len, lines[start : start + 3])) <= 80
    row = next(line for line in lines if line.startswith("3 → 4"))
    assert row.split() == ["3", "→", "4", "3", "1", "3.25"]
    for part in (
        "2 meshes, 7 vertices, 3 faces, 4 intervals; method exact on cpu",
        "Collisions in 1 of 4 intervals: 3 vertex-face and 0 edge-edge pairs.",
        "  /World/Falling with /World/Floor: 3 collisions from 3 to 4\n",
        "The first at time 3.25: /World/Falling, vertex 1, with /World/Floor, face 0.",
        "Certified for vertices that move straight or turn about one axis between the times checked: every pair",
    ):
        assert part in output


def test_replay_without_collisions(capsys, safe_scene):
    output = run(capsys, "replay", safe_scene)
    assert "No collision in 2 intervals." in output


def test_long_replay_lists_the_collisions(capsys, scenes):
    path = scenes / "long.usda"
    write_scene(path, falling_times=[*(step / 100 for step in range(100)), 3, 4])
    output = run(capsys, "replay", path)
    assert next(line for line in output.splitlines() if "→" in line).startswith("3 → 4")
    assert "100 intervals not listed, 0 with collisions" in output
    assert len(json.loads(run(capsys, "replay", path, "--json"))["intervals"]) == 101


def test_replay_of_transforms(capsys, scenes):
    stage = write_scene(scenes / "transform.usda", falling_times=[3.25])
    world = UsdGeom.Xform.Define(stage, "/World")
    world.AddScaleOp().Set((3, 0.5, 7))
    translate = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Falling")).AddTranslateOp()
    translate.Set((0, 0, 3.25), 0)
    translate.Set((0, 0, 0.25), 3)
    translate.Set((0, 0, -0.75), 4)
    stage.GetRootLayer().Save()
    found = json.loads(run(capsys, "replay", scenes / "transform.usda", "--json"))
    assert [interval["hits"] for interval in found["intervals"]] == [0, 3]
    assert found["intervals"][1]["earliest"]["time"] == pytest.approx(3.25, abs=1e-5)


def test_replay_of_meshes_sampled_at_other_times(capsys, scenes):
    stage = write_scene(scenes / "other_times.usda", falling_times=[0, 4])
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Floor")).GetPointsAttr()
    for time in (1, 2, 3.5):
        points.Set(FLOOR, time)
    stage.GetRootLayer().Save()
    found = json.loads(run(capsys, "replay", scenes / "other_times.usda", "--json"))
    intervals = [(interval["start"], interval["end"], interval["hits"] > 0) for interval in found["intervals"]]
    assert intervals == [(0, 1, False), (1, 2, False), (2, 3.5, True), (3.5, 4, True)]
    assert found["intervals"][2]["earliest"]["time"] == pytest.approx(3.25, abs=1e-5)


def test_self_collision(capsys, scenes):
    path = scenes / "itself.usda"
    stage = Usd.Stage.CreateNew(str(path))
    mesh = UsdGeom.Mesh.Define(stage, "/Cloth")
    mesh.CreateFaceVertexCountsAttr([4, 3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3, 4, 5, 6])
    for time in (0, 1):
        mesh.CreatePointsAttr().Set(FLOOR + [(x, y, z + 0.2 - time) for x, y, z in FALLING], time)
    stage.GetRootLayer().Save()
    output = run(capsys, "replay", path)
    assert "  /Cloth with itself: 3 collisions from 0 to 1\n" in output
    assert "/Cloth, vertex 5, with its face 0." in output


def test_obstacles_that_touch_do_not_count(capsys, scenes):
    stage = write_scene(scenes / "obstacles.usda")
    wall = UsdGeom.Mesh.Define(stage, "/World/Wall")
    wall.CreatePointsAttr([(-1, 0.5, -1), (-1, 0.5, 1), (-0.5, 0.6, 0)])  # a vertex and an edge meet the floor
    wall.CreateFaceVertexCountsAttr([3])
    wall.CreateFaceVertexIndicesAttr([0, 1, 2])
    stage.GetRootLayer().Save()
    found = json.loads(run(capsys, "replay", scenes / "obstacles.usda", "--json"))
    assert [interval["hits"] for interval in found["intervals"]] == [0, 0, 0, 3]


def test_recording_of_newton(capsys):
    found = with_names(json.loads(run(capsys, "replay", ASSETS / "cloth_twist.usd", "--json")))
    assert [interval["hits"] for interval in found["intervals"]] == [1, 2, 2, 3, 7, 3, 5, 0, 0, 3, 2, 1, 3, 1]
    assert found["mesh_pairs"] == [{"meshes": ["/root/model/triangles"] * 2, "hits": 33}]


def test_progress_without_a_terminal(capsys, falling_scene, monkeypatch):
    monkeypatch.setattr("warp_bsc.cli.progress.LOG_SECONDS", -1.0)
    assert main(["replay", falling_scene, "--device", "cpu"]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in lines] == [f"Replaying: {done} of 4" for done in (1, 2, 3, 4)]
    assert re.fullmatch(r"Replaying: 2 of 4, time \S+, \d+\.\d/s, about \d+ s left", lines[1])


def test_fail_on_collision(capsys, falling_scene, safe_scene):
    options = ["--fail-on", "collisions", "--device", "cpu"]
    assert main(["replay", falling_scene, *options]) == 1
    assert "Collisions in 1 of 4" in capsys.readouterr().out
    assert main(["replay", safe_scene, *options]) == 0


def write_queries(folder, name="pairs_vf.csv", truth=(1, 0)):
    """Two vertex-face queries: the vertex falls through the face, and beside it."""
    lines = []
    for x, answer in zip((1, 9), truth, strict=True):
        for z in (1, -1):
            rows = [(x, 1, z), (0, 0, 0), (4, 0, 0), (0, 4, 0)]
            lines += [",".join(f"{value},1" for value in row) + f",{answer}" for row in rows]
    path = folder / name
    path.write_text("\n".join(lines))
    return path


def test_query_as_json(capsys, tmp_path):
    found = json.loads(run(capsys, "query", write_queries(tmp_path), "--json"))
    (file,) = found["files"]
    assert file["kind"] == "vertex-face"
    assert file["hit"] == [True, False]
    assert file["status"] == ["hit", "free"]
    assert file["toi"] == [pytest.approx(0.5, abs=2**-20), None]
    assert file["certified"] == {"free": 1, "hit": 1, "unsure": 0}
    assert list(file["confusion"].values()) == [1, 0, 1, 0]


def test_query_tables(capsys, tmp_path):
    names = ("right_vf", "none_vf", "both_vf")
    paths = [
        write_queries(tmp_path, f"{name}.csv", truth)
        for name, truth in zip(names, [(1, 0), (0, 0), (1, 1)], strict=True)
    ]
    lines = [line.split() for line in run(capsys, "query", *paths).splitlines()]
    answers = [line[:-1] for line in lines if len(line) == 7 and line[0] in names]
    assert answers == [[name, "2", "1", "1", "1", "0"] for name in names]
    assert {line[0]: line[1:] for line in lines if len(line) == 5 and line[0] in {*names, "all"}} == {
        "right_vf": ["1", "0", "1", "0"],
        "none_vf": ["0", "1", "1", "0"],
        "both_vf": ["1", "0", "0", "1"],
        "all": ["2", "1", "2", "1"],
    }


def test_query_of_a_folder_with_truth_beside(capsys, tmp_path):
    path = write_queries(tmp_path)
    path.write_text("\n".join(line.rpartition(",")[0] for line in path.read_text().splitlines()))
    assert "Against the truth" not in run(capsys, "query", path)
    (tmp_path / "pairs_vf_mma_bool.json").write_text("[true, false]")
    output = run(capsys, "query", tmp_path)
    assert "Truth of pairs_vf.csv from pairs_vf_mma_bool.json." in output


def test_query_with_a_minimum_distance(capsys, tmp_path):
    """The second vertex passes the corner (4, 0) of the face at (9, 1), sqrt(26), about 5.099, away."""
    path = write_queries(tmp_path)
    for distance, hits in ((5.09, [True, False]), (5.1, [True, True])):
        found = json.loads(run(capsys, "query", path, "--min-distance", distance, "--json"))
        assert found["min_distance"] == distance
        assert found["files"][0]["hit"] == hits
        assert found["files"][0]["confusion"] is None
    assert "minimum distance 5.1" in run(capsys, "query", path, "--min-distance", "5.1")
    assert "more than 0" in fail(capsys, "query", path, "--min-distance", "-1")


def test_query_of_edges(capsys, tmp_path):
    rows = [(-1, 0, 1), (1, 0, 1), (0, -1, 0), (0, 1, 0), (-1, 0, -1), (1, 0, -1), (0, -1, 0), (0, 1, 0)]
    path = tmp_path / "pairs.csv"
    path.write_text("\n".join(",".join(f"{value},1" for value in row) for row in rows))
    found = json.loads(run(capsys, "query", path, "--kind", "edge-edge", "--json"))
    assert found["files"][0]["hit"] == [True]
    assert "--kind" in fail(capsys, "query", path)


def test_query_fails_on_collision(capsys, tmp_path):
    path = str(write_queries(tmp_path))
    assert main(["query", path, "--device", "cpu", "--fail-on", "collisions"]) == 1
    assert main(["query", path, "--device", "cpu"]) == 0
    capsys.readouterr()
    assert "--fail-on: must be of collisions, not 'new'" in fail(capsys, "query", path, "--fail-on", "new")


@pytest.mark.parametrize(
    ("command", "statuses"),
    [
        ("", [0, 1, 2, 3, 4, 5]),
        ("replay", [0, 1, 2, 3, 4, 5]),
        ("query", [0, 1, 2]),
        *((f"bench {name}".strip(), [0, 2]) for name in ("", "paper", "detector", "queries", "newton", "repair")),
    ],
)
def test_help_lists_the_exit_statuses(capsys, command, statuses):
    with pytest.raises(SystemExit):
        main([*command.split(), "--help"])
    options, text = capsys.readouterr().out.split("exit status:\n")
    assert [int(line[2]) for line in text.splitlines() if re.match(r"  \d  ", line)] == statuses
    assert "  129, 130, 143  interrupted by SIGHUP, by Ctrl-C, by SIGTERM\n  141  the reader" in text
    assert ("--fail-on WHAT" in options) == (1 in statuses and bool(command))
    assert "--fail-on-collision" not in options + text and max(map(len, text.splitlines())) <= 80


@pytest.mark.parametrize(
    ("content", "message"),
    [("1,2,3,4,5,6\n" * 9, "pairs_vf.csv:9: the file ends"), ("1,0,3,4,5,6\n" * 8, "pairs_vf.csv:1: x has the denom")],
)
def test_broken_query_file(capsys, tmp_path, content, message):
    path = tmp_path / "pairs_vf.csv"
    path.write_text(content)
    assert message in fail(capsys, "query", path)


def test_broken_scene(capsys, scenes):
    stage = write_scene(scenes / "broken.usda")
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Falling"))
    mesh.GetPointsAttr().Set([(0, 0, 0), (1, 0, 0), (0, float("nan"), 0)], 3)
    stage.GetRootLayer().Save()
    line = fail(capsys, "replay", scenes / "broken.usda", "--device", "cpu", "--strict")
    for part in ("broken.usda", "/World/Falling", "vertex 2", "time 3"):
        assert part in line


def test_scene_that_is_not_usd(capsys, tmp_path):
    path = tmp_path / "wrong.usd"
    path.write_text("hello")
    assert f"{path}: not a readable USD file" in fail(capsys, "replay", path)


def test_conservative_says_what_it_could_not_certify(capsys, falling_scene):
    output = run(capsys, "replay", falling_scene, "--method", "conservative")
    assert "no collision is missing. Pairs tested that floating point could not certify: " in output
    assert "every pair tested" not in output
    assert "collisions may be missing" in run(capsys, "replay", falling_scene, "--method", "float")


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ([], "COMMAND"),
        (["fly"], "fly"),
        (["replay"], "SCENE"),
        (["replay", "gone.usd"], "gone.usd: no such file"),
        (["replay", "gone.usd", "--method", "guess"], "guess"),
        (["replay", "gone.usd", "--frames", "3"], "--frames"),
        (["query"], "FILE"),
        (["query", "gone.csv"], "gone.csv: no such file"),
        (["query", "gone.csv", "--kind", "face-face"], "face-face"),
    ],
)
def test_wrong_use(capsys, arguments, part):
    assert part in fail(capsys, *arguments)


def test_device_that_is_not_there(capsys, falling_scene):
    assert "--device cuda:99: there is no such device" in fail(capsys, "replay", falling_scene, "--device", "cuda:99")


@pytest.mark.parametrize(
    "command",
    [
        [],
        ["replay"],
        ["query"],
        ["bench"],
        *(["bench", name] for name in ("paper", "detector", "queries", "newton", "repair")),
    ],
)
def test_help_has_examples(capsys, command):
    with pytest.raises(SystemExit) as end:
        main([*command, "--help"])
    assert end.value.code == 0
    output = capsys.readouterr().out
    assert f"  warp-bsc {' '.join(command)}" in output.partition("examples:")[2]
    assert "exit status:" in output
    assert max(map(len, output.splitlines())) <= 80


def test_interrupt(capsys, monkeypatch, falling_scene):
    def interrupt(path, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(replay_options, "Scene", interrupt)
    assert main(["replay", falling_scene]) == 130
    assert capsys.readouterr().err == "warp-bsc: interrupted\n"


def run_into(output, errors, *arguments):
    """The exit status of the program, whose output is buffered, as it is by default, and goes into files."""
    command = [sys.executable, "-m", "warp_bsc", *map(str, arguments)]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    return subprocess.run(command, stdout=output, stderr=errors, env=environment, check=False).returncode


@pytest.fixture
def unread():
    """The end of a pipe to write to, the other being closed, as after ``| head -1``."""
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "wb") as pipe:
        yield pipe


@pytest.mark.parametrize(
    ("command", "options"), [pytest.param("query", [], marks=pytest.mark.slow), ("replay", ["--json"])]
)
def test_nobody_reads_the_output(tmp_path, safe_scene, unread, command, options):
    path = write_queries(tmp_path) if command == "query" else safe_scene
    with open(tmp_path / "errors", "wb") as errors:
        assert run_into(unread, errors, command, path, "--device", "cpu", *options) == 141
    assert without_progress((tmp_path / "errors").read_text()) == ""


def test_nobody_reads_the_error(unread):
    assert run_into(None, unread, "query", "gone.csv") == 141


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no full device")
@pytest.mark.parametrize("options", [[], pytest.param(["--json"], marks=pytest.mark.slow)], ids=["table", "json"])
def test_no_room_for_the_output(tmp_path, options):
    path = write_queries(tmp_path)
    with open("/dev/full", "wb") as full, open(tmp_path / "errors", "wb") as errors:
        assert run_into(full, errors, "query", path, "--device", "cpu", *options) == 2
    (line,) = without_progress((tmp_path / "errors").read_text()).splitlines()
    assert line.startswith("warp-bsc: error: ")


def test_installed_program(safe_scene):
    program = Path(sys.executable).with_name("warp-bsc")
    done = subprocess.run(
        [program, "replay", safe_scene, "--device", "cpu", "--json"], capture_output=True, check=False
    )
    assert done.returncode == 0
    assert json.loads(done.stdout)["hits"] == 0
    done = run_program("replay", "gone.usd")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == "warp-bsc: error: gone.usd: no such file\n"


def run_program(*arguments, **options):
    """What the program does in a process of its own."""
    command = [sys.executable, "-m", "warp_bsc", *arguments]
    return subprocess.run(command, text=True, check=False, **({"capture_output": True} | options))


def test_error_while_the_program_is_loaded(safe_scene, tmp_path):
    (tmp_path / "rich.py").write_text("raise RuntimeError('broken\\ninstallation')")
    done = run_program("replay", safe_scene, env={**os.environ, "PYTHONPATH": str(tmp_path)})
    assert done.returncode == 2
    assert done.stderr.startswith("warp-bsc: error: RuntimeError: broken installation (")
    assert len(done.stderr.splitlines()) == 1


def test_interrupted_while_the_program_is_loaded(safe_scene, tmp_path):
    (tmp_path / "rich.py").write_text(
        "import os, signal, sys\n"
        "os.kill(os.getpid(), signal.SIGINT)\n"
        f"sys.path.remove({str(tmp_path)!r})\n"
        "del sys.modules['rich']\n"
        "import rich\n"
    )
    done = run_program("replay", safe_scene, env={**os.environ, "PYTHONPATH": str(tmp_path)})
    assert (done.returncode, done.stderr) == (130, "warp-bsc: interrupted\n")


@pytest.mark.parametrize("error", [TypeError("wrong"), RuntimeError("wrong"), Tf.ErrorException(), MemoryError()])
def test_unforeseen_error(capsys, monkeypatch, falling_scene, error):
    def fail_to_open(path, **options):
        raise error

    monkeypatch.setattr(replay_options, "Scene", fail_to_open)
    line = fail(capsys, "replay", falling_scene)
    assert f"{falling_scene}: {type(error).__name__}" in line
    assert "(replay_options.py:" in line


def test_output_that_cannot_encode_all(monkeypatch, scenes):
    write_scene(scenes / "näme.usda")
    output = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", output)
    assert main(["replay", str(scenes / "näme.usda"), "--device", "cpu", "--fail-on", "collisions"]) == 1
    text = output.buffer.getvalue().decode("ascii")
    assert "3 -> 4" in text and "n\\xe4me.usda: 2 meshes" in text
    assert output.errors == "strict"


needs_full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")


@needs_full
@pytest.mark.parametrize("options", [[], ["--json"], ["--csv", "/dev/stdout"]])
def test_standard_output_that_is_full(capsys, monkeypatch, falling_scene, options):
    full = open("/dev/full", "w")  # noqa: SIM115 (it cannot be closed without an error)
    monkeypatch.setattr(sys, "stdout", full)
    assert main(["replay", falling_scene, "--device", "cpu", *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warp-bsc: error: standard output: ") and "No space left on device" in line
    with contextlib.suppress(OSError):
        full.close()


@needs_full
def test_program_whose_standard_output_is_full(safe_scene):
    with open("/dev/full", "w") as full:
        done = run_program(
            "replay", safe_scene, "--device", "cpu", capture_output=False, stdout=full, stderr=subprocess.PIPE
        )
    assert (done.returncode, len(without_progress(done.stderr).splitlines())) == (2, 1)


@pytest.mark.parametrize("columns", [40, 60])
def test_replay_table_on_a_narrow_terminal(capsys, monkeypatch, falling_scene, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    lines = run(capsys, "replay", falling_scene).splitlines()
    start = next(number for number, line in enumerate(lines) if "Frames" in line)
    stop = next(number for number, line in enumerate(lines) if "intervals not listed" in line)
    assert max(len(line.rstrip()) for line in lines[start:stop]) <= columns
    row = lines[start + 2].split()
    assert row[:6] == ["3", "→", "4", "3", "1", "3.25"]  # frames, collisions, pairs of meshes, and when
    assert "…" not in "".join(lines[start:stop])


def test_frames_that_begin_with_a_minus(capsys, scenes):
    path = scenes / "negative.usda"
    write_scene(path, falling_times=range(-10, -5))
    for frames in (["--frames", "-10:-8"], ["--frames=-10:-8"]):
        found = json.loads(run(capsys, "replay", path, *frames, "--json"))
        assert [(interval["start"], interval["end"]) for interval in found["intervals"]] == [(-10, -9), (-9, -8)]
    assert "--frames" in fail(capsys, "replay", path, "--frames", "--json")


def test_progress_for_programs(capsys):
    """A line of JSON for each interval, and the same tables as without."""
    words = ["replay", str(ASSETS / "cloth_twist.usd"), "--device", "cpu"]
    assert main(words) == 0
    tables = capsys.readouterr().out
    assert main([*words, "--progress", "json"]) == 0
    output = capsys.readouterr()
    lines = [json.loads(line) for line in without_progress(output.err).splitlines()]
    lines = [line for line in lines if line["activity"] == "replaying"]
    assert [line["done"] for line in lines] == list(range(15)) and {line["of"] for line in lines} == {14}
    assert [line["hits"] for line in lines] == sorted(line["hits"] for line in lines) and lines[-1]["hits"] == 33
    assert [line["seconds"] for line in lines] == sorted(line["seconds"] for line in lines)
    assert output.out.splitlines()[0] == tables.splitlines()[0]


def test_progress_for_people_leaves_out_loading(monkeypatch, capsys):
    """What is slower than one a second is told in seconds, and what came before the first is not counted."""
    clock = iter([0.0, 5.0, 20.0, 35.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    run = progress.RunProgress("Replaying")
    run.show(1, 5)
    run.show(2, 5, "time 2")
    run.show(61, 91)
    assert capsys.readouterr().err.splitlines() == [
        "Replaying: 2 of 5, time 2, 15.0 s each, about 45 s left", "Replaying: 61 of 91, 2.0/s, about 15 s left"
    ]  # fmt: skip
