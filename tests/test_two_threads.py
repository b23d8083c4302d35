"""Two threads at once: right answers, or an error that says so."""

import copy
import os
import subprocess
import sys
import threading
from pathlib import Path

import newton
import pytest
import two_threads
from newton_scenes import DT, Changed, add_patch

import warp_bsc as bsc

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the guard of memory is for Linux")
def test_answers_of_shared_objects_are_right_under_guarded_memory():
    program = [sys.executable, two_threads.__file__, str(ROOT / "assets" / "cloth_twist.usd")]
    folder = os.path.dirname(two_threads.__file__)
    run = subprocess.run(
        program, capture_output=True, text=True, check=False, env=os.environ | {"PYTHONPATH": folder}, timeout=300
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert run.stdout.endswith("shared scene\n")


class Waiting(Changed):
    """A solver whose step waits."""

    def __init__(self, model):
        super().__init__(model)
        self.inside, self.go_on = threading.Event(), threading.Event()

    def step(self, *arguments, **options):
        self.inside.set()
        assert self.go_on.wait(60)
        super().step(*arguments, **options)


@pytest.fixture
def model(device):
    builder = newton.ModelBuilder()
    add_patch(builder, 2, 0.1, (0.0, 0.0, 1.0))
    return builder.finalize(device=device)


@pytest.mark.parametrize("stage", [bsc.SolverCCD, bsc.CollisionMonitor])
def test_a_second_thread_in_a_stage_gets_an_error(model, stage):
    """Its step would begin in the middle of the other."""
    solver = stage(Waiting(model))
    start, end = model.state(), model.state()
    stepping = threading.Thread(target=solver.step, args=(start, end, None, None, DT))
    stepping.start()
    assert solver.solver.inside.wait(60)
    try:
        for call in (lambda: solver.step(start, end, None, None, DT), lambda: solver.reset(start)):
            with pytest.raises(RuntimeError, match=f"another thread is using this {stage.__name__}"):
                call()
    finally:
        solver.solver.go_on.set()
        stepping.join()
    assert solver.report.totals.steps == 1 and solver.report.certified
    solver.step(start, end, None, None, DT)
    assert solver.report.totals.steps == 2


def test_a_second_thread_in_captured_steps_gets_an_error(model):
    inside, go_on = threading.Event(), threading.Event()

    def steps():
        inside.set()
        assert go_on.wait(60)

    captured = bsc.CapturedSteps(steps, Changed(model))
    running = threading.Thread(target=captured)
    running.start()
    assert inside.wait(60)
    try:
        with pytest.raises(RuntimeError, match="another thread is using this CapturedSteps"):
            captured()
    finally:
        go_on.set()
        running.join()


def test_a_stage_cannot_be_copied_and_says_so(model):
    solver = bsc.SolverCCD(Changed(model))
    with pytest.raises(TypeError, match="a SolverCCD cannot be copied: put a new one behind"):
        copy.deepcopy(solver)
    assert copy.copy(solver).mesh is solver.mesh
