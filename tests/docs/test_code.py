"""The Python code of the documentation runs, page by page, and prints what its comments say."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import trimesh

from warp_bsc.cli.main import main

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
SCENE = ROOT / "assets" / "cloth_twist.usd"
PAGES = sorted(str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md") if "upstream" not in path.parts)
BLOCK = re.compile(r"(?:<!-- not run: (?P<reason>[^>]*) -->\n)?```(?P<language>\w*)\n(?P<code>.*?)```", re.DOTALL)

CLOTH = """
import newton, warp as wp, warp_bsc as bsc
builder = newton.ModelBuilder()
for height in (1.0, 2.0):
    builder.add_shape_sphere(-1, radius=0.1)
place = {"pos": wp.vec3(0.0, 0.0, height), "rot": wp.quat_identity(), "vel": wp.vec3()}
builder.add_cloth_grid(dim_x=2, dim_y=2, cell_x=0.1, cell_y=0.1, mass=0.1, **place)
builder.color()
inner = newton.solvers.SolverVBD(builder.finalize())
"""
BEFORE = {
    "newton/contacts.md": CLOTH,
    "newton/reports.md": CLOTH,
    "usd/files.md": "import json\nimport numpy as np\n",
    "usd/programs.md": f"import warp_bsc as bsc\nfrom pxr import Usd\nstage = Usd.Stage.Open({str(SCENE)!r})\n",
}
"""What the code of a page takes for granted."""


def blocks_of(page):
    """The Python blocks of a page that run, and the reasons of those that do not."""
    found = [match for match in BLOCK.finditer((DOCS / page).read_text()) if match["language"] == "python"]
    return [block["code"] for block in found if block["reason"] is None], [b["reason"] for b in found if b["reason"]]


def run(page, folder, capsys):
    """Runs the code of a page, and returns its names and what it printed."""
    path = folder / "page.py"  # Warp reads the source of kernels from a file
    path.write_text("\n".join([BEFORE.get(page, ""), *blocks_of(page)[0]]))
    names = {"__name__": f"docs_{Path(page).stem}", "__file__": str(path)}
    exec(compile(path.read_text(), str(path), "exec"), names)
    return names, capsys.readouterr().out


CODE = [page for page in PAGES if blocks_of(page)[0]]
TUTORIAL = [page for page in CODE if page.startswith("tutorial/")]
LONG = (pytest.mark.slow,)


def test_detector(tmp_path, capsys):
    names, output = run("detector.md", tmp_path, capsys)
    assert names["c"].vertex_face.tolist() == [[3, 0], [4, 0], [5, 0]] and names["c"].certified
    np.testing.assert_allclose(names["c"].vertex_face_toi, [0.25, 0.5, 0.5], atol=2.0**-20)
    assert names["r"].hit.tolist() == [True]
    assert names["found"].earliest_toi == names["c"].earliest_toi  # of the graph
    assert "[[3, 0], [4, 0], [5, 0]]" in output and re.search(r"\n2\.0\n0\.489\d+ True\n0\.2499995\d+ False\n", output)


def test_from_ipctk(tmp_path, capsys):
    names, output = run("from_ipctk.md", tmp_path, capsys)
    lines = output.splitlines()
    assert lines[:2] == ["6", "3 False True"] and lines[2].startswith("0.249999")
    assert lines[3:5] == ["True", "False True"]
    assert lines[5:7] == ["[[3, 4], [3, 5]]", "[[3, 0], [4, 0], [5, 0]]"]
    assert lines[8:] == ["False", "[[3, 0]] 1.0", "1.0", "[1.]", "[ 1.   -0.5  -0.25 -0.25]", "0"]
    shown = set(re.findall(r"# ([^,;\n]*?)(?:[,;]|\.\.\.|$)", "\n".join(blocks_of("from_ipctk.md")[0]), re.MULTILINE))
    assert shown >= {"6", "3 False True", "True", "False True", "False", "1.0", "[1.]", "0"}
    assert names["r"].hit.all() and names["group"].tolist() == [2] * 3 + [4] * 3


def test_intersections(tmp_path, capsys):
    _, output = run("intersections.md", tmp_path, capsys)
    shown = re.findall(r"print\(.*  # (.*)$", "\n".join(blocks_of("intersections.md")[0]), re.MULTILINE)
    assert output.splitlines() == shown == ["True", "[3, 4] [0, 1, 2]", "True", "False"]


def test_detectors(tmp_path, capsys):
    _, output = run("detectors.md", tmp_path, capsys)
    assert output == "[ True] [ True]\n"


def test_kernels(tmp_path, capsys):
    names, output = run("kernels.md", tmp_path, capsys)
    assert names["count"].numpy().tolist() == [1] and output.startswith("[1]\n")
    assert 0.5 - 2.0**-20 <= names["first"].numpy()[0] <= 0.5 and (names["first"].numpy()[1:] == 2.0).all()
    np.testing.assert_allclose(names["x1"].grad.numpy()[0], [0.0, 0.0, 0.25], atol=1e-6)
    moved = names["x"].numpy()
    assert 0.0 < moved[0, 2] < 2e-6 and (moved[1:] == names["x0"][1:]).all()


@pytest.mark.parametrize("page", [pytest.param(page, marks=LONG * ("4_" in page or "5_" in page)) for page in TUTORIAL])
@pytest.mark.filterwarnings("ignore:a step is not certified", "ignore:edges pass through faces")
def test_tutorial(page, tmp_path, capsys):
    """Each block ends with something that it prints, and what it prints stands beside or below."""
    blocks = blocks_of(page)[0]
    assert len(blocks) > 1 and all(re.search(r"\bprint\(.*(  #|\n#) .*\n\Z", block) for block in blocks)
    _, output = run(page, tmp_path, capsys)
    shown = re.findall(r"\bprint\(.*(?:  |\n)# (.*)$", "\n".join(blocks), re.MULTILINE)
    assert output.splitlines() == shown


def test_newton(tmp_path, capsys):
    names, output = run("newton.md", tmp_path, capsys)
    totals = names["solver"].report.totals
    assert (totals.steps, totals.uncertified_steps) == (10, 0) and names["plain"].report.totals.steps == 1
    assert re.fullmatch(r"10 0\n10 0\nPenetrated\(passed=\d+, crossed=0, inside=\d+, steps=[01]\)\n", output)


def test_gripper(tmp_path, capsys):
    """The cloth hangs from the fingers, which carry its weight by friction."""
    names, output = run("newton/gripper.md", tmp_path, capsys)
    lowest, weight = map(float, output.split("\n")[0].split())
    forces = names["forces"]
    assert 0.05 < lowest < 0.065 and abs(forces[:, 2].sum() + weight) < 0.02 * weight
    assert (0.8 * np.abs(forces[:, 0]) > np.abs(forces[:, 2])).all()
    report = names["solver"].report
    assert not report.penetrated and report.totals.uncertified_steps == 0


def test_from_vbd(tmp_path, capsys):
    names, _ = run("newton/from_vbd.md", tmp_path, capsys)
    assert names["solver"].report.totals.steps == 1 and names["solver"].report.certified


def test_from_libuipc(tmp_path, capsys):
    _, output = run("from_libuipc.md", tmp_path, capsys)
    uncertified, height = output.split()
    assert uncertified == "0" and 0.2 < float(height) < 0.21  # on the ball


def test_implicit(tmp_path, capsys):
    names, output = run("newton/implicit.md", tmp_path, capsys)
    assert output == "20 0\n"
    assert names["state_0"].particle_q.numpy()[:, 2].max() > 0.19  # on the ball


def test_contacts(tmp_path, capsys):
    names, _ = run("newton/contacts.md", tmp_path, capsys)
    state, end = names["inner"].model.state(), names["inner"].model.state()
    names["solver"].step(state, end, None, None, 0.01)
    assert names["solver"].report.certified


def test_reports(tmp_path, capsys):
    names, output = run("newton/reports.md", tmp_path, capsys)
    assert names["force"].shape == (3,) and "shape" in output and "[-0.88 -0.88]" in output


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:contacts strained", "ignore:in the state of the program")
def test_robots(tmp_path, capsys):
    """Only a stage in the coupled solver alone lets the arm into the cloth."""
    names, output = run("newton/robots.md", tmp_path, capsys)
    crossing, angles = np.array([line.split() for line in output.splitlines()], dtype=float).T
    assert crossing.tolist() == [0, 0, 0, 0, 44] and angles.tolist() == [0.66, 0.93, 0.93, 0.93, 0.66]
    assert names["stages"][0].report.totals.unseen_steps == 0


def test_gradients(tmp_path, capsys):
    names, output = run("newton/gradients.md", tmp_path, capsys)
    assert names["solver"].report.totals.uncertified_steps == 0
    gradient = names["states"][0].particle_qd.grad.numpy()
    assert np.isfinite(gradient).all() and np.abs(gradient).max() > 0.0
    derivative, counts, shapes = output.strip().split("\n")
    assert np.isfinite([float(number) for number in derivative.strip("[]").split()]).all()
    assert "unsolved=0, failed_solves=0, growing=0" in counts
    of_forces = names["forces"].grad.numpy()
    assert shapes == "(30, 49, 3) (49, 3)" and np.isfinite(of_forces).all() and np.abs(of_forces).max() > 0.0
    assert names["solver"].report.gradient_counts.unrepeated == 0


def test_repair(tmp_path, capsys):
    names, output = run("usd/repair.md", tmp_path, capsys)
    assert (names["result"].crossings_before, names["result"].crossings, names["result"].certified) == (60, 0, True)
    lines = output.split("\n")
    moved, strain = map(float, lines[1].split())
    assert lines[0] == "72 0 True" and lines[2:4] == ["True 0 True", "42 0 60 0"]
    assert round(moved, 2) == 0.03 and round(strain, 3) == 0.014


def test_commands_of_mesh_files(tmp_path, capsys, monkeypatch):
    """On files of these names: balls as a body, and garments that cross it and each other."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "free").mkdir()
    ball = trimesh.creation.icosphere(2)
    dent = np.exp(-40.0 * ((ball.vertices - [1.0, 0.0, 0.0]) ** 2).sum(axis=1))[:, None] * [-0.05, 0.0, 0.0]
    for name, radius, moves in (
        ("body.obj", 1.0, 0.0),
        ("frame_11.obj", 1.02, 0.0),
        ("garment.obj", 1.02, dent),
        ("shirt.ply", 1.02, dent),
        ("coat.stl", 1.04, dent),
        ("coat.obj", 1.02, dent),
        ("buttons.obj", 0.05, np.array([0.0, 0.0, 1.03])),
        ("hero.glb", 1.0, 0.0),
        *((f"body_{number}.obj", 1.0, 0.0) for number in (1, 2)),
        *((f"coat_{number}.obj", 1.02, number * dent) for number in (1, 2)),
        *((f"coat_000{number}.ply", 1.02, number * dent) for number in (1, 2)),
    ):
        trimesh.Trimesh(radius * ball.vertices + moves, ball.faces).export(name)
    section = (DOCS / "usd" / "repair.md").read_text().partition("## Positions")[0]
    commands, frames, checks = (block.splitlines() for block in re.findall(r"```sh\n(.*?)```", section, re.DOTALL))
    assert (len(commands), len(frames), len(checks)) == (6, 2, 5)
    for number, command in enumerate(commands):
        assert main([*shlex.split(command)[1:], "--device", "cpu"]) == 0
        said = capsys.readouterr().out
        assert " 0 remain." in said and "read again: certified." in said
        assert ("Intersections: 0 before" in said) == (number in (0, 3, 4))  # the garment alone, and the hero
    assert sorted(path.name for path in tmp_path.glob("free/*")) == ["buttons.obj", "coat.obj", "coat.stl", "shirt.ply"]
    for command in frames:
        assert main([*shlex.split(command)[1:], "--device", "cpu"]) == 0
        said = capsys.readouterr().out
        assert "Intersections: 0 before" not in said and said.count(" 0 remain.") == 2
    assert len(list(tmp_path.glob("free/coat_*"))) == 4
    for command in checks:
        assert main([*shlex.split(command)[1:], "--device", "cpu"]) == 0
        capsys.readouterr()


def test_index(tmp_path, capsys):
    names, output = run("index.md", tmp_path, capsys)
    np.testing.assert_allclose(names["c"].vertex_face_toi, [0.25, 0.5, 0.5], atol=2.0**-20)
    assert output.startswith("[[3, 0], [4, 0], [5, 0]] [0.2") and output.endswith(" True\n")


def test_files(tmp_path, capsys, monkeypatch):
    """And the page of the command, which shows what it prints."""
    monkeypatch.chdir(tmp_path)
    assert main(["replay", str(SCENE), "--json", "hits.json", "--npz", "hits.npz", "--device", "cpu"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    shown = re.search(r"```\n(Broken: .*?)\n\.\.\.\n", (DOCS / "usd" / "replay.md").read_text(), re.DOTALL)[1]
    parts = re.split(r"\n(?=Collisions in|The first at|Intersections at|Frames )", shown)
    assert len(parts) == 5 and all(" ".join(part.split()) in printed for part in parts)
    names, output = run("usd/files.md", tmp_path, capsys)
    assert names["counts"].sum() == output.count("\n") == 33 and len(names["counts"]) == 14


def test_programs(tmp_path, capsys):
    with pytest.raises(AssertionError, match="meshes collide from time 246 on"):
        run("usd/programs.md", tmp_path, capsys)


def test_each_page_with_code_has_a_test_and_each_block_that_does_not_run_a_reason():
    tests = {name.removeprefix("test_") for name in globals() if name.startswith("test_")}
    assert len(TUTORIAL) == 7 and {Path(page).stem for page in set(CODE) - set(TUTORIAL)} <= tests
    reasons = [reason for page in PAGES for reason in blocks_of(page)[1]]
    assert reasons and all(len(reason.split()) > 3 for reason in reasons)
