"""The README: its Python code runs as printed, its commands are those that the project runs."""

import re
from pathlib import Path

import numpy as np
import pytest

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.cli.main import main
from warp_bsc.usd.scene import Scene

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_python_code_runs_as_printed(tmp_path, capsys):
    path = tmp_path / "readme.py"  # Warp reads the source of kernels from a file
    path.write_text("\n".join(blocks("python")))
    names = {"__name__": "readme", "__file__": str(path)}
    exec(compile(path.read_text(), str(path), "exec"), names)
    assert (names["solver"].report.totals.steps, names["solver"].report.totals.uncertified_steps) == (10, 0)
    cloth = names["states"][0].particle_q.numpy()
    assert np.linalg.norm(cloth, axis=1).min() > 0.19  # thrown at the ball, and outside of it
    assert capsys.readouterr().out == "10 0\n"


def test_it_is_one_page():
    assert README.count("\n") <= 120


def test_the_scenes_of_its_commands_come_with_the_package():
    scenes = re.findall(r"warp-bsc (?:replay|repair) (\S+)", "".join(blocks("sh")))
    assert len(scenes) >= 3 and set(scenes) == {"demo"}


def test_the_scene_of_the_readme_replays_with_its_figures(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["replay", "demo", "--device", "cpu"]) == 0
    output = capsys.readouterr().out
    assert "Collisions in 12 of 14 intervals" in output and "33 collisions from" in output
    assert "33 collisions of a recorded scene that comes with it, in 12 of 14 intervals" in README.replace("\n", " ")


def test_the_collisions_of_the_scene_are_real():
    scene = Scene(ROOT / "assets" / "cloth_twist.usd")
    segment = scene.interval(0).segment
    detector = bsc.CollisionDetector(bsc.CollisionMesh(segment.faces, segment.vertex_count))
    neighbours = np.zeros((segment.vertex_count,) * 2, dtype=bool)
    neighbours[tuple(detector.mesh.edges.T)] = True
    neighbours |= neighbours.T
    confirmed = one_ring_apart = 0
    for interval in scene:
        x0, x1 = interval.x0, interval.x1
        c = detector.detect(x0, x1)
        confirmed += checker.vertex_face(bsc.query_points(detector.mesh.faces, c.vertex_face, x0, x1)).sum()
        confirmed += checker.edge_edge(bsc.query_points(detector.mesh.edges, c.edge_edge, x0, x1)).sum()
        corners = np.concatenate([c.vertex_face[:, :1], segment.faces[c.vertex_face[:, 1]]], axis=1)
        one_ring_apart += neighbours[corners[:, :1, None], corners[:, None, 1:]].any(axis=(1, 2)).sum()
        corners = detector.mesh.edges[c.edge_edge].reshape(-1, 4)
        one_ring_apart += neighbours[corners[:, :2, None], corners[:, None, 2:]].any(axis=(1, 2)).sum()
        assert len(detector.find_intersections(x0))  # the cloth is through itself at rest, too
    assert confirmed == one_ring_apart == 33


@pytest.mark.skipif(not (ROOT / ".ci" / "run").exists(), reason="not a checkout")
def test_continuous_integration_runs_the_command_of_the_readme():
    command = next(block.strip() for block in blocks("sh") if "pytest" in block)
    assert command in (ROOT / ".ci" / "run").read_text()


def test_its_links_are_absolute_as_pypi_needs_them():
    """Whether they lead to files is tested with those of the other pages, see tests/docs/test_site.py."""
    inline, defined = re.findall(r"\]\(([^)\s]+)\)", README), re.findall(r"^\[[\w-]+\]: (\S+)$", README, re.MULTILINE)
    assert len(defined) > 15 and all(link.startswith("https://") for link in inline + defined)
    used = re.findall(r"\]\[([\w-]+)\]", README)
    assert {*used} == {*re.findall(r"^\[([\w-]+)\]: ", README, re.MULTILINE)}
