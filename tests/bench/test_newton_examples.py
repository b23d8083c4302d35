"""Measurements of Newton's examples: what is counted, and that every end of an example is a row."""

import os
import sys
import textwrap
from types import SimpleNamespace

import compilation
import newton
import newton.examples
import newton.utils
import pytest
import warp as wp

from warp_bsc.bench.measure import newton_examples, newton_process
from warp_bsc.bench.measure.newton_examples import WARM_UP, measure_example
from warp_bsc.bench.scenes.newton_examples import NewtonExample, describe_needs, find_examples

# A triangle stands above a pinned sheet and moves down by 1 cm a frame, its tip from 5.5 cm: after the sixth frame two
# of its edges cross a face of the sheet. Nothing else crosses, and nothing but the stage stops it.
FALLING_TRIANGLE = """
    import os
    from pathlib import Path

    import newton
    import newton.examples
    import warp as wp
    from compilation import compile_quickly
    from newton._src.solvers import SolverXPBD as OwnSolver  # which a stage does not take the place of
    from newton.solvers import SolverXPBD
    from newton.solvers.experimental.coupled import SolverCoupled, SolverCoupledADMM

    compile_quickly()  # as the tests do, so that both take the same kernels


    class Derived(SolverXPBD):
        pass


    class Example:
        def __init__(self, viewer, args):
            self.viewer = viewer
            if args.note:
                Path(args.note).write_text(str(os.getpid()))
            builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
            for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                builder.add_particle(wp.vec3(x, y, 0.0), wp.vec3(), 0.0, radius=0.0)
            for x, z in ((0.4, 0.0), (0.5, 0.3), (0.3, 0.3)):
                place, velocity = wp.vec3(x, 0.1, args.height + z), wp.vec3(0.0, 0.0, -args.speed)
                builder.add_particle(place, velocity, 1.0, radius=0.0)
            for corners in ((0, 1, 2), (0, 2, 3), (4, 5, 6)):
                builder.add_triangle(*corners)
            self.model = builder.finalize()
            if args.coupled:  # the sheet and the triangle by a solver each, in two passes a step
                make = lambda view: SolverXPBD(view, iterations=1)
                parts = {"sheet": [0, 1, 2, 3], "triangle": [4, 5, 6]}
                entries = [SolverCoupled.Entry(name=name, solver=make, particles=parts[name]) for name in parts]
                self.solver = SolverCoupledADMM(self.model, entries, SolverCoupledADMM.Config(iterations=2))
            else:
                self.solver = (Derived if args.derived else SolverXPBD)(self.model, iterations=1)
                assert isinstance(self.solver, SolverXPBD) and not isinstance(self.model, SolverXPBD)
                solver = getattr(self.solver, "solver", self.solver)  # before the stage
                assert type(solver) is (Derived if args.derived else OwnSolver), type(solver)
            self.state_0, self.state_1 = self.model.state(), self.model.state()
            self.frames = 0

        def step(self):
            self.state_0.clear_forces()
            self.solver.step(self.state_0, self.state_1, None, None, 0.01)
            self.state_0, self.state_1 = self.state_1, self.state_0
            self.frames += 1

        def test_post_step(self):
            assert self.frames < 4, f"frame {self.frames}"

        def test_final(self):
            raise ValueError("it never landed\\nat all")

        def render(self):
            pass


    if __name__ == "__main__":
        parser = newton.examples.create_parser()
        parser.add_argument("--height", type=float, default=0.055)
        parser.add_argument("--speed", type=float, default=1.0)
        parser.add_argument("--derived", action="store_true")
        parser.add_argument("--coupled", action="store_true")
        parser.add_argument("--note")
        parser.set_defaults(num_frames=8)
        viewer, args = newton.examples.init(parser)
        newton.examples.run(Example(viewer, args), args)
    """


@pytest.fixture
def write_example(tmp_path, monkeypatch):
    """Writes the source of an example, in a module that a process of its own can import, and describes it."""
    folders = [str(tmp_path), compilation.FOLDER, *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(folders))

    def write(source, *options):
        (tmp_path / "example_written.py").write_text(textwrap.dedent(source))
        return NewtonExample("written", "example_written", options)

    return write


@pytest.fixture
def in_this_process(monkeypatch, tmp_path):
    """Measures in the process of the tests, which takes less time than to start one, and is put right afterwards."""
    monkeypatch.syspath_prepend(tmp_path)
    for module, name in (
        (newton.examples, "run"),
        (newton.examples, "download_external_git_folder"),
        (newton.utils, "download_asset"),
        (sys, "argv"),
        *((newton.solvers, name) for name in newton_process.SOLVERS),
    ):
        monkeypatch.setattr(module, name, getattr(module, name))

    def replies(request, errors):
        given = []
        with wp.ScopedDevice(request["device"]):
            newton_process.serve(request, given.append)
        yield from given

    monkeypatch.setattr(newton_examples, "_replies", replies)


def fail(example, mode="plain", *, device):
    """The reason why there is no measurement."""
    run = measure_example(example, mode, device=str(device))
    assert (run.example, run.mode, run.measured) == (example.title, mode, None)
    return run.problem


def measure(example, mode="plain", *, device, **options):
    run = measure_example(example, mode, device=str(device), **options)
    assert (run.example, run.mode, run.problem) == (example.title, mode, None)
    stage = run.measured["stage"]
    return SimpleNamespace(**run.measured | {"stage": stage and SimpleNamespace(**stage)})


def test_finds_examples_with_cloth_or_soft_bodies():
    found = {example.name: example for example in find_examples()}
    assert {"cloth_twist", "cloth_hanging", "softbody_hanging", "softbody_gift", "rigid_soft_contact"} <= found.keys()
    assert not {"basic_pendulum", "mujoco_mpm_coupled_solver"} & found.keys()  # other folder; rigid bodies and sand
    assert found["cloth_franka"].downloads == ("franka_emika_panda",)
    assert describe_needs(found["cloth_franka"]) == ["needs a download: franka_emika_panda"]
    assert not describe_needs(found["cloth_franka"], download=True)
    assert not describe_needs(found["cloth_twist"])


def test_finds_examples_by_name_with_their_options():
    first, second = find_examples(["basic_pendulum", "cloth_hanging --solver xpbd"])
    assert (first.title, first.module) == ("basic_pendulum", "newton.examples.basic.example_basic_pendulum")
    assert (second.title, second.options) == ("cloth_hanging --solver xpbd", ("--solver", "xpbd"))
    with pytest.raises(ValueError, match="'cloth_twst': Newton has no example of this name; did you mean cloth_twist"):
        find_examples(["cloth_twst"])
    with pytest.raises(ValueError, match="No closing quotation"):
        find_examples(["cloth_twist '"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mode": "both"}, "both"),
        ({"frames": WARM_UP}, "frames must be more than"),
        ({"check_every": 0}, "check_every must be at least 1, not 0"),
    ],
)
def test_wrong_options(options, message):
    example = NewtonExample("gone", "gone")
    with pytest.raises(ValueError, match=message):
        measure_example(example, **{"mode": "plain", "device": "cpu"} | options)


def test_what_an_example_lacks_is_known_before_it_runs():
    missing = NewtonExample("gone", "gone", missing=("nowhere", "nothing"))
    assert measure_example(missing, "plain", device="cpu").problem == "needs the package nowhere"
    downloads = NewtonExample("gone", "gone", downloads=("shirt", ""))
    assert measure_example(downloads, "stage", device="cpu").problem == "needs a download: shirt"


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        ("raise RuntimeError('the string broke\\nat its end')", "failed: RuntimeError: the string broke"),
        ("import nowhere_to_be_found", "needs the package nowhere_to_be_found"),
        (
            "try:\n    import nowhere_to_be_found\nexcept ImportError as error:\n"
            "    raise ImportError('no backend') from error",
            "needs the package nowhere_to_be_found",
        ),
        ("import newton.utils as u; getattr(u, 'download' + '_asset')('shirt')", "needs a download: shirt"),
        ("print('{}')", "not applicable: it does not call newton.examples.run"),
        (
            "import newton, newton.examples as e; from types import SimpleNamespace as N\n"
            "m = newton.ModelBuilder().finalize(); e.run(N(model=m, state_0=m.state()), N(num_frames=3))",
            "not applicable: it has neither cloth nor soft bodies",
        ),
    ],
    ids=["error", "package", "backend", "download", "no frames", "no cloth"],
)
def test_an_example_that_fails_is_a_row(write_example, in_this_process, device, source, problem):
    assert fail(write_example(source), device=device) == problem


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        pytest.param(
            "import os, signal; os.kill(os.getpid(), signal.SIGKILL)",
            "failed: the process was ended by SIGKILL",
            marks=pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals"),
        ),
        pytest.param(
            "import os; print('a {'); os.write(2, b'no room\\n\\n'); os._exit(3)",
            "failed: the process ended with status 3: no room",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["crash", "exit"],
)
def test_a_process_that_ends_is_a_row(write_example, device, source, problem):
    assert fail(write_example(source), device=device) == problem


def test_entries_of_a_coupled_example(in_this_process, device):
    """Newton's own: a cloth of one solver that particles of another fall on, each with a stage."""
    (example,) = find_examples(["xpbd_vbd_coupled_solver"])
    found = measure(example, "stage", device=device, frames=3)
    assert (found.particles, found.triangles, found.crossings_at_start, found.most_crossings) == (300, 392, 0, 0)
    assert (found.stage.steps, found.stage.uncertified_steps) == (3 * 8 * 2, 0)  # eight steps a frame, two entries
    assert found.test_final == "ok"


def test_without_a_solver_the_stage_is_not_applicable(write_example, in_this_process, device):
    example = write_example(FALLING_TRIANGLE.replace("from newton.solvers import", "from newton._src.solvers import"))
    problem = fail(example, "stage", device=device)
    assert problem is not None
    assert problem.startswith("not applicable: no solver with particles is one of SolverVBD,")


@pytest.mark.slow
def test_measures_a_triangle_that_falls_through_a_sheet(write_example, in_this_process, device):
    example, frames = write_example(FALLING_TRIANGLE), []
    found = measure(example, device=device, check_every=1, progress=lambda *done: frames.append(done))
    assert frames == [(frame, 8) for frame in range(9)]
    assert (found.device, found.particles, found.triangles, found.tetrahedra) == (str(device), 7, 3, 0)
    assert found.frames == 8
    times = found.milliseconds
    assert len(times["frames"]) == 8 - WARM_UP
    assert 0.0 < times["median"] <= times["percentile_95"] <= times["worst"]
    assert (found.crossings_at_start, found.most_crossings) == (0, 2)
    assert (found.first_frame_with_crossings, found.first_frame_not_finite) == (5, None)
    assert found.stage is None
    assert (found.test_post_step, found.test_final) == ("frame 4", "it never landed")
    found = measure(example, device=device, check_every=3)
    assert found.first_frame_with_crossings == 5
    found = measure(example, device=device, frames=5, check_every=3)
    assert (found.frames, found.most_crossings) == (5, 0)


@pytest.mark.slow
@pytest.mark.parametrize("option", ["", "--derived", "--coupled"])
def test_measures_the_stage_that_stops_it(write_example, device, option, request):
    if option:
        request.getfixturevalue("in_this_process")
    found = measure(write_example(FALLING_TRIANGLE, *filter(None, [option])), "stage", device=device, check_every=1)
    assert (found.crossings_at_start, found.most_crossings, found.first_frame_with_crossings) == (0, 0, None)
    stages_and_passes = 2 * 2 if option == "--coupled" else 1
    assert (found.stage.steps, found.stage.uncertified_steps) == (8 * stages_and_passes, 0)
    assert (type(newton.solvers.SolverXPBD) is type) != bool(option)  # replaced only in that process


@pytest.mark.slow
def test_a_coupled_triangle_falls_without_the_stage(write_example, in_this_process, device):
    found = measure(write_example(FALLING_TRIANGLE, "--coupled"), device=device, check_every=1)
    assert (found.most_crossings, found.first_frame_with_crossings) == (2, 5)


@pytest.mark.slow
def test_counts_crossings_at_the_start(write_example, in_this_process, device):
    example = write_example(FALLING_TRIANGLE, "--height", "-0.1", "--speed", "0")
    found = measure(example, device=device, frames=3)
    assert (found.crossings_at_start, found.most_crossings, found.first_frame_with_crossings) == (2, 2, None)


def test_positions_that_are_not_finite(write_example, in_this_process, device):
    example = write_example(FALLING_TRIANGLE, "--speed", "nan")
    found = measure(example, device=device, frames=4, check_every=2)
    assert (found.first_frame_not_finite, found.most_crossings) == (1, 0)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signal 0 asks for a process only on POSIX")
def test_an_interrupt_ends_the_process(write_example, device, tmp_path):
    def interrupt(*_):
        raise KeyboardInterrupt

    example = write_example(FALLING_TRIANGLE, "--note", str(tmp_path / "note"))
    with pytest.raises(KeyboardInterrupt):
        measure_example(example, "plain", device=str(device), progress=interrupt)
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "note").read_text()), 0)


@pytest.mark.slow
def test_the_solver_with_contact_inside_takes_the_place_of_vbd(in_this_process, device):
    """Newton's own; with XPBD there is nothing to replace."""
    example, other = find_examples(["cloth_hanging --width 8 --height 4", "cloth_hanging --solver xpbd --width 8"])
    found = measure(example, "implicit", device=device, frames=3)
    assert (found.particles, found.crossings_at_start, found.most_crossings) == (9 * 5, 0, 0)
    assert (found.stage.steps, found.stage.uncertified_steps) == (3 * 10, 0)
    assert (found.test_post_step, found.test_final) == (None, "ok")
    assert fail(other, "implicit", device=device) == "not applicable: no solver with particles is one of SolverVBD"


@pytest.mark.slow
def test_an_example_of_newton(in_this_process, device):
    (example,) = find_examples(["cloth_hanging --width 8 --height 4"])
    for mode in ("plain", "stage"):
        found = measure(example, mode, device=device, frames=4)
        assert (found.particles, found.triangles, found.shapes) == (9 * 5, 2 * 8 * 4, 1)
        assert (found.crossings_at_start, found.most_crossings) == (0, 0)
        assert (found.test_post_step, found.test_final) == (None, "ok")
        assert (found.stage is not None) == (mode == "stage")
    assert (found.stage.steps, found.stage.uncertified_steps) == (4 * 10, 0)  # ten steps a frame
