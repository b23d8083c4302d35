"""The examples: all start, certify their first steps, and run as their docstrings print."""

import argparse
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import common
import compilation
import diffsim
import newton
import newton.examples
import numpy as np
import pytest
import searches
import warp as wp
from newton.viewer import ViewerNull

FOLDER = Path(__file__).parents[2] / "examples"
EXAMPLES = sorted(FOLDER.rglob("example_*.py"))
BULLET = FOLDER / "example_cloth_bullet.py"
THROW = FOLDER / "example_diffsim_throw.py"
GRIPPER = FOLDER / "example_gripper.py"
PUSH = FOLDER / "example_diffsim_push.py"
PROPELLER = FOLDER / "example_propeller.py"
TARGETS = {
    "identify": ({"STEPS": 12, "NOISE": 0.0}, ["--triangles", "18", "--starts", "1"], 0.6),
    "towel": ({"STEPS": 10, "LAST": 2, "START": wp.vec3(-0.1, 0.0, 0.07), "STARTS": [(0.5, 0.3, -0.5)]}, [], 0.8),
    "real_to_sim": ({"CELLS": (6, 3), "STEPS": 20, "POINTS": 60}, ["--worlds", "2"], 0.8),
    "fold": ({"CELLS": 4, "CELL": 0.1, "STEPS": 8, "MOVES": 7, "STARTS": [((0.0, 0.05, 0.1),) * 3]}, [], 0.8),
}
"""Short versions of examples with targets: constants, options, and the share of the first loss that a step leaves."""
PAPER_SCENES = {
    "twisting": "degrees",
    "funnel": "from the axis",
    "dancer": "hem",
    "flamenco": "a hem is",
    "crashing": "length",
}
"""Each scene fails its test at first, with a message that contains this."""
PRINTED = re.findall(
    r"^python examples/(example_\w+)\.py", (FOLDER.parent / "docs" / "newton.md").read_text(), re.MULTILINE
)
_IMPORTED = {FOLDER / "figures" / name for name in ("film.py", "table_rows.py")}
FIGURES = sorted(set((FOLDER / "figures").glob("*.py")) - _IMPORTED)
FRAMES = 2
RUN_LONGER = [
    "example_cloth_bullet",
    "example_diffsim_push",
    "example_diffsim_throw",
    "example_gripper",
    "example_propeller",
]
RUN_LONGER += [f"example_diffsim_{name}" for name in TARGETS]
"""Examples that other tests run with the same options, and for more frames."""
COMPARED = ["particle_q", "particle_qd", "particle_mass", "tri_indices", "tri_materials"]
COMPARED += ["tet_indices", "tet_poses", "tet_materials"]

each_paper_scene = pytest.mark.parametrize("name", PAPER_SCENES)
each_example = pytest.mark.parametrize("path", EXAMPLES, ids=[path.stem for path in EXAMPLES])


def load_module(path):
    """A script, as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def load(path):
    """The class ``Example`` of a script."""
    return load_module(path).Example


def run(path, frames, *options):
    """Runs an example for some frames, as its script would."""
    return run_class(load(path), frames, *options)


def run_class(example_class, frames, *options):
    """Runs the class of an example."""
    args = example_class.create_parser().parse_args(["--viewer", "null", "--num-frames", str(frames), *options])
    viewer = ViewerNull(num_frames=frames)
    example = example_class(viewer, args)
    while viewer.is_running():
        example.step()
        example.render()
    if "--no-ccd" not in options:
        totals = example.solver.report.totals
        assert totals.steps >= frames and totals.uncertified_steps == 0
    return example


def test_there_are_examples():
    assert len(EXAMPLES) >= 3


@pytest.mark.parametrize("path", [path for path in EXAMPLES if path.stem not in RUN_LONGER], ids=lambda path: path.stem)
def test_first_frames(path):
    run(path, FRAMES, *(["--triangles", "2000"] if path.parent.name == "paper" else []))


@pytest.mark.slow
def test_printed_commands_run_without_a_window_and_without_a_browser(tmp_path):
    """The first of them: all run in this process, above."""
    for missing in ("pyglet", "viser"):
        (tmp_path / f"{missing}.py").write_text("raise ImportError")
    environment = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}
    # without the gradients that the tests leave out, so that both take the same kernels
    start = "import compilation, newton.solvers\ncompilation.compile_quickly()\n"
    (tmp_path / "sitecustomize.py").write_text(start)
    folders = [str(tmp_path), compilation.FOLDER, *filter(None, [os.environ.get("PYTHONPATH")])]
    environment["PYTHONPATH"] = os.pathsep.join(folders)
    command = [sys.executable, FOLDER / f"{PRINTED[0]}.py", "--num-frames", "1", "--quiet"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    said, *_, report = [line for line in done.stdout.splitlines() if not line.startswith(("Warp", " ", "Module"))]
    assert said.startswith("No window (") and said.endswith(
        ", and no viser for a browser: simulating 1 frames without."
    )
    assert "Simulating" in done.stderr
    assert re.search(r"\d", report)


def test_commands_are_printed():
    assert len(PRINTED) >= 4


@pytest.mark.parametrize("path", [*EXAMPLES, *FIGURES], ids=lambda path: path.stem)
def test_docstring_prints_its_command(path):
    name = path.relative_to(FOLDER.parent).as_posix()
    assert re.findall(r"python (examples/\S+\.py)", path.read_text())[0] == name


@pytest.mark.slow
def test_scripts_without_a_viewer_start(tmp_path):
    """From any folder, by their path alone."""
    command = [sys.executable, FOLDER / "paper" / "record_scenes.py", "--help"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("path", FIGURES, ids=lambda path: path.stem)
def test_figures_have_options(path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(path), "--help"])
    with pytest.raises(SystemExit):
        load_module(path).main()
    assert "usage" in capsys.readouterr().out


class Browser:
    """What :func:`common.open_viewer` needs of Newton's viewer in a browser."""

    url = "http://localhost:8080"

    def __init__(self, **options):
        self.options = options


@pytest.mark.parametrize(("option", "viewer"), [("--paused", Browser), ("--test", common.ViewerProgress)])
def test_browser_where_there_is_no_window(monkeypatch, capsys, option, viewer):
    """Only from this machine, and not for what nobody looks at, as a browser has no end."""
    monkeypatch.setitem(sys.modules, "pyglet", None)
    monkeypatch.setattr(common, "ViewerViser", Browser)
    monkeypatch.setattr(sys, "argv", ["example", option])
    opened, args = common.open_viewer(newton.examples.create_parser())
    assert isinstance(opened, viewer)
    assert getattr(args, option[2:]) is True
    if viewer is Browser:
        assert opened.options == {"host": "localhost", "paused": True, "verbose": False}
        assert "open http://localhost:8080 in a browser" in capsys.readouterr().out


def test_viewers_that_are_asked_for_are_not_replaced(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyglet", None)
    monkeypatch.setattr(sys, "argv", ["example", "--viewer", "gl"])
    with pytest.raises(Exception, match="pyglet"):
        common.open_viewer(newton.examples.create_parser())
    monkeypatch.setattr(sys, "argv", ["example", "--viewer", "null"])
    opened, _ = common.open_viewer(newton.examples.create_parser())
    assert type(opened) is ViewerNull


def test_interrupted_browser_ends_in_the_report(monkeypatch, capsys):
    def interrupt(example, args):
        raise KeyboardInterrupt

    class Example:
        create_parser = staticmethod(argparse.ArgumentParser)

        def __init__(self, viewer, args):
            pass

        def print_report(self):
            print("all is well")

    monkeypatch.setattr(newton.examples, "run", interrupt)
    monkeypatch.setattr(common, "ViewerViser", Browser)
    monkeypatch.setattr(common, "open_viewer", lambda parser: (Browser(), None))
    common.main(Example)
    assert capsys.readouterr().out == "all is well\n"
    monkeypatch.setattr(common, "open_viewer", lambda parser: (None, None))
    with pytest.raises(KeyboardInterrupt):
        common.main(Example)


@each_example
def test_help(path, capsys):
    with pytest.raises(SystemExit, match=r"^0$"):
        load(path).create_parser().parse_args(["--help"])
    assert "--no-ccd" in capsys.readouterr().out


@pytest.mark.slow
def test_bullet_is_stopped(capsys):
    example = run(BULLET, 10, "--speed", "20")  # it flies back after about 8
    assert example.solver.report.totals.steps >= 40
    example.test_final()
    example.print_report()
    assert "0 particles of the patch are behind the sheet" in capsys.readouterr().out


@pytest.mark.parametrize("path", [pytest.param(THROW, marks=pytest.mark.slow), PUSH], ids=["throw", "push"])
def test_gradients_of_contacts_lead_to_the_mark(path):
    example = run(path, 2)
    first, second = example.loss_history
    assert (second < 0.65 * first).all()
    assert example.solver.report.unconverged_steps == 0
    run(path, 2, "--no-ccd").test_final()


def test_a_throw_has_gradients_before_its_bounce(monkeypatch):
    """The script of the throw runs; that its gradients lead to the mark is a slow test."""
    program = load_module(THROW)
    monkeypatch.setattr(program, "STEPS", 12)
    example = run_class(program.Example, 1)
    assert np.abs(example.throws.grad.numpy()).min() > 0.0 and example.solver.report.unconverged_steps == 0


def test_search_stays_where_the_loss_is_flat_and_goes_back_where_there_is_no_gradient():
    start = np.array([3.0, -1.0])
    flat, search = (searches.QuasiNewton(start, 0.5, 1.0) for _ in range(2))
    for _ in range(3):
        flat.take(1.0, np.array([1e-9, 0.0]))
        assert (flat.trial == start).all()
    search.take(5.0, np.array([2.0, 0.0]))
    np.testing.assert_allclose(search.trial, [2.5, -1.0])
    search.take(1.0, np.full(2, np.nan))
    np.testing.assert_allclose(search.trial, [2.75, -1.0])
    assert (search.x == start).all()


@pytest.mark.parametrize("name", TARGETS)
def test_gradients_of_the_solver_lead_to_the_target(name, monkeypatch):
    constants, options, share = TARGETS[name]
    program = load_module(FOLDER / f"example_diffsim_{name}.py")
    for constant, value in constants.items():
        monkeypatch.setattr(program, constant, value)
    example = run_class(program.Example, 2, *options)
    first, second = example.loss_history
    assert (second < share * first).all()
    assert example.solver.report.unconverged_steps == 0
    diffsim.DiffsimExample.test_final(example)


def test_a_propeller_throws_a_cloth_that_passes_it_without_stage(capsys):
    example = run(PROPELLER, 8)
    example.test_final()
    example.print_report()
    assert "turned by 30 degrees a step" in capsys.readouterr().out
    with pytest.raises(AssertionError, match=r"at most 0\.00 m/s"):
        run(PROPELLER, 8, "--no-ccd").test_final()


@pytest.mark.parametrize("robot", [pytest.param("featherstone", marks=pytest.mark.slow), "mujoco"])
@pytest.mark.parametrize("friction", [0.5, pytest.param(0.05, marks=pytest.mark.slow)])
def test_gripper_lifts_cloth_that_does_not_slip(robot, friction):
    if robot == "mujoco":
        pytest.importorskip("mujoco_warp")
    program = load_module(GRIPPER)
    program.LIFT, program.LIFT_TIME = 0.06, 0.22
    example = run_class(program.Example, 32, "--robot", robot, "--friction", str(friction))
    example.test_final()
    report = example.solver.report
    assert report.totals.steps == 128 and report.totals.frozen_steps == 0
    assert report.totals.truncated_steps == 0 or friction < 0.5


@pytest.mark.slow
def test_contacts_are_drawn(monkeypatch):
    drawn = []
    monkeypatch.setattr(ViewerNull, "log_arrows", lambda self, name, *arguments, **options: drawn.append(name))
    run(BULLET, 2, "--draw-contacts")
    assert drawn.count("/ccd/impulses") == 2
    with pytest.raises(ValueError, match="omit --no-ccd"):
        run(BULLET, 1, "--draw-contacts", "--no-ccd")


def test_bullet_passes_without_stage():
    example = run(BULLET, 10, "--no-ccd")
    with pytest.raises(AssertionError, match="441 particles of the patch passed"):
        example.test_final()


def path_of(name):
    return FOLDER / "paper" / f"example_{name}.py"


@each_paper_scene
@pytest.mark.parametrize("triangles", [2000, 20000])
def test_resolution(name, triangles):
    example = run(path_of(name), 0, "--triangles", str(triangles))
    assert example.model.tri_count == pytest.approx(triangles, rel=0.25)


def test_too_coarse():
    with pytest.raises(ValueError, match=r"--triangles must be in \[1000, 20000000\], not 10"):
        run(path_of("twisting"), 0, "--triangles", "10")


@each_paper_scene
def test_scene_has_to_become_what_it_is_called(name):
    with pytest.raises(AssertionError, match=PAPER_SCENES[name]):
        run(path_of(name), 1, "--triangles", "2000").test_final()


@pytest.mark.slow
def test_funnel_is_passed(capsys):
    example = run(path_of("funnel"), 46, "--triangles", "1352")  # of fewer, how many are in by then is chance
    example.test_final()
    example.print_report()
    assert "0 not certified" in capsys.readouterr().out


@pytest.mark.slow
def test_funnel_without_stage():
    with pytest.raises(AssertionError, match="of the particles are in the funnel"):
        run(path_of("funnel"), 46, "--triangles", "1000", "--no-ccd").test_final()


@pytest.mark.slow
def test_dancer_without_stage():
    with pytest.raises(AssertionError, match="edges of deforming meshes cross their faces"):
        run(path_of("dancer"), 40, "--triangles", "1000", "--no-ccd").test_final()


@pytest.mark.slow
def test_car_is_crushed():
    run(path_of("crashing"), 38, "--triangles", "1500").test_final()


def test_car_is_as_if_added_one_tetrahedron_at_a_time():
    crashing = load_module(path_of("crashing"))
    vertices, tets = crashing.shell((4, 3, 2), crashing.body_at)
    added, expected = newton.ModelBuilder(), newton.ModelBuilder()
    for _ in range(2):
        crashing.add_shell(added, vertices, tets)
        expected.add_soft_mesh(
            pos=wp.vec3(),
            rot=wp.quat_identity(),
            scale=1.0,
            vel=wp.vec3(-crashing.SPEED, 0.0, 0.0),
            vertices=vertices,
            indices=tets.reshape(-1),
            density=crashing.DENSITY,
            k_mu=crashing.STIFFNESS,
            k_lambda=crashing.STIFFNESS,
            k_damp=crashing.DAMPING,
            add_surface_mesh_edges=False,
        )
    models = [builder.finalize() for builder in (added, expected)]
    for name in COMPARED:
        values = [getattr(model, name).numpy() for model in models]
        np.testing.assert_allclose(*values, rtol=1e-4, atol=1e-5, err_msg=name)
