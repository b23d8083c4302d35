"""Triage files: which are read, and what is meant to meet."""

import json

import pytest
from usd_stages import find, resting_stage, save

from warp_bsc.cli.main import main

FLOOR, FALLS, RESTS = "/World/Floor", "/World/Falling", "/World/Resting"


def entry(*meshes, **more):
    return {"meshes": list(meshes), "reason": "stands in it", "who": "ada", "date": "2026-11-29"} | more


def write(path, *entries):
    path.write_text(json.dumps({"version": 1, "meant": entries}))
    return str(path)


@pytest.fixture
def stage(tmp_path):
    return resting_stage(tmp_path)


def met(found):
    return {frozenset(pair["meshes"]) for pair in found["mesh_pairs"]}


@pytest.mark.parametrize(
    ("meshes", "left"),
    [
        ((FLOOR, FALLS), {(FLOOR, RESTS)}),
        ((RESTS, "/World/Fl*"), {(FLOOR, FALLS)}),
        ((FLOOR,), set()),
        ((RESTS,), {(FLOOR, FALLS)}),
        ((FLOOR, FLOOR), {(FLOOR, FALLS), (FLOOR, RESTS)}),
    ],
)
def test_what_is_meant_is_counted_apart(stage, tmp_path, capsys, meshes, left):
    whole = {frozenset(pair["meshes"]): pair["hits"] for pair in find(stage)["mesh_pairs"]}
    capsys.readouterr()
    found = find(stage, "--triage", write(tmp_path / "shot.triage.json", entry(*meshes)))
    assert met(found) == set(map(frozenset, left))
    ignored = {frozenset(pair["meshes"]): pair["hits"] for pair in found["ignored"]}
    assert {**ignored, **{pair: whole[pair] for pair in met(found)}} == whole
    assert all(pair["meant"]["reason"] == "stands in it" for pair in found["ignored"])
    printed = capsys.readouterr().out
    if hits := sum(ignored.values()):
        pairs = "1 meant pair" if len(ignored) == 1 else f"{len(ignored)} meant pairs"
        assert f"Not counted: {pairs} of meshes, {hits} collision" in printed
        assert ": stands in it (ada, 2026-11-29)\n" in printed


def test_what_meets_at_rest_alone_is_counted_too(stage, tmp_path):
    """Nothing moves, so that nothing collides; an edge passes through the floor at time 2."""
    triage = write(tmp_path / "shot.triage.json", entry(FLOOR, RESTS))
    whole = find(stage, "--frames", "2:2")
    crossing = {frozenset(span["meshes"]): span["most"] for span in whole["intersections"]}
    found = find(stage, "--frames", "2:2", "--triage", triage)
    (ignored,) = found["ignored"]
    assert (ignored["hits"], ignored["edges"]) == (0, crossing[frozenset((FLOOR, RESTS))])


def test_it_neither_fails_nor_is_repaired(stage, tmp_path, capsys):
    path = save(stage)
    triage = ["--triage", write(tmp_path / "shot.triage.json", entry(FLOOR), entry("/World/Gone", FLOOR))]
    for fail in ("collisions", "intersections"):
        assert main(["replay", path, "--device", "cpu", "--fail-on", fail]) == 1
        assert main(["replay", path, "--device", "cpu", "--fail-on", fail, *triage]) == 0
    out = str(tmp_path / "fixed.usdc")
    capsys.readouterr()
    assert main(["repair", path, "--device", "cpu", "--output", out, "--fail-on", "remaining", *triage]) == 0
    printed = capsys.readouterr().out
    assert "meant to or ignored: 2, not counted and not repaired, the first is" in printed
    assert "Nothing was moved" in printed
    assert "note: --triage: entries that match no meshes: 1, the first is /World/Gone /World/Floor" in printed


def test_a_baseline_holds_after_more_is_meant(stage, tmp_path, capsys):
    path, before = save(stage), str(tmp_path / "before.json")
    triage = ["--triage", write(tmp_path / "shot.triage.json", entry(FLOOR, RESTS))]
    replay = ["replay", path, "--device", "cpu"]
    assert main([*replay, "--json", before]) == 0
    assert main([*replay, "--baseline", before, "--fail-on", "new", *triage]) == 0
    assert main([*replay, "--json", before, *triage]) == 0
    capsys.readouterr()
    assert main([*replay, "--baseline", before]) == 2
    assert f"ignored pairs that this one does not; cannot compare: {FLOOR} with {RESTS}\n" in capsys.readouterr().err
    assert main([*replay, "--baseline", before, "--fail-on", "new", "--ignore", FLOOR, RESTS]) == 0


def test_a_stopped_run_resumes_with_what_is_meant(stage, tmp_path):
    path, out = save(stage), tmp_path / "hits.json"
    options = ["--device", "cpu", "--json", str(out), "--triage", write(tmp_path / "a.json", entry(FLOOR, RESTS))]
    assert main(["replay", path, *options]) == 0
    whole = out.read_bytes()
    head, *intervals = whole.splitlines()
    out.write_bytes(b"\n".join([head, *intervals[:2], b""]))
    assert main(["replay", path, *options, "--resume"]) == 0
    assert out.read_bytes() == whole


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\xff", "'utf-8' codec can't decode byte 0xff in position 0"),
        (b"{", "Expecting property name"),
        (b"[]", "the file must be an object, not []"),
        ({"version": 1, "ment": []}, "the file: unknown key 'ment'; the keys are version, meant"),
        ({"version": 1}, "the file: meant is missing"),
        ({"version": 2, "meant": []}, "version is 2, and this version of warp-bsc reads version 1"),
        ({"version": True, "meant": []}, "the file: version must be of type int, not True"),
        ([7], "meant[0] must be an object, not 7"),
        ([entry(FLOOR), entry(FLOOR, why="x")], "meant[1]: unknown key 'why'; the keys are meshes, reason, who, date"),
        ([entry(FLOOR, reason=None)], "meant[0]: reason must be of type str, not None"),
        ([entry(FLOOR, who="")], "meant[0]: who is missing"),
        ([{"meshes": [FLOOR]}], "meant[0]: reason is missing"),
        ([entry(FLOOR, date="29.11.2026")], "meant[0]: date must be such as 2026-11-29, not '29.11.2026'"),
        ([entry(FLOOR, meshes=FLOOR)], "meant[0]: meshes must be of type list"),
        ([entry()], "meant[0]: meshes must be one or two, not 0"),
        ([entry(FLOOR, FLOOR, FLOOR)], "meant[0]: meshes must be one or two, not 3"),
        ([entry("World/Floor")], "meant[0]: meshes: 'World/Floor' is not the path of a prim, and no pattern of one"),
        ([entry("/World//Floor")], "meant[0]: meshes: '/World//Floor' is not"),
        ([entry("/World/My Floor")], "meant[0]: meshes: '/World/My Floor' is not"),
        ([entry(FLOOR, 3)], "meant[0]: meshes: 3 is not the path"),
    ],
)
def test_broken_files_are_one_line(stage, tmp_path, capsys, content, message):
    path = tmp_path / "bad.json"
    if isinstance(content, list):
        content = {"version": 1, "meant": content}
    path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    assert main(["replay", save(stage), "--device", "cpu", "--triage", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"warp-bsc: error: {path}: not a triage file: {message}")


def test_a_missing_file_and_mesh_files(stage, tmp_path, capsys):
    gone = str(tmp_path / "gone.json")
    assert main(["replay", save(stage), "--device", "cpu", "--triage", gone]) == 2
    assert capsys.readouterr().err == f"warp-bsc: error: {gone}: No such file or directory\n"
    assert main(["repair", "a.obj", "--output", "b.obj", "--triage", gone]) == 2
    assert capsys.readouterr().err == f"warp-bsc: error: {gone}: No such file or directory\n"
