"""Steps for which memory does not suffice: states and reports as before, and the same step once there is memory."""

import newton
import pytest
import warp as wp
from failing_memory import fail_each, failing_memory
from newton_scenes import DT, SOLVERS, add_patch

import warp_bsc as bsc

KINDS = {
    "ccd": lambda model: bsc.SolverCCD(SOLVERS["vbd"](model)),
    "substeps": lambda model: bsc.SolverCCD(SOLVERS["xpbd"](model), substeps=2, report=["contacts", "worlds"]),
    "implicit": lambda model: bsc.SolverImplicit(model, report=["contacts"]),
    "monitor": lambda model: bsc.CollisionMonitor(SOLVERS["xpbd"](model)),
}

LONG = [pytest.mark.slow]


@pytest.fixture
def model(device):
    """A small cloth that flies through a larger one."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 6, 0.05, (0.0, 0.0, 0.0), fixed=True)
    add_patch(builder, 3, 0.03, (0.01, 0.01, 0.05), velocity=(0.0, 0.0, -30.0))
    builder.color()
    return builder.finalize(device=device)


def content(*states):
    return [
        (name, array.numpy().tobytes())
        for state in states
        for name, array in vars(state).items()
        if isinstance(array, wp.array)
    ]


@pytest.mark.parametrize(
    ("kind", "in_place"),
    [
        *((kind, True) for kind in KINDS),
        *(pytest.param(kind, False, marks=LONG * (kind != "ccd")) for kind in KINDS),
    ],
)
def test_a_step_without_memory_leaves_its_start_and_the_report(device, model, kind, in_place):
    """Also where the inner solver writes to its start, as XPBD does, and where a substep has been taken."""

    def make():
        start = model.state()
        return KINDS[kind](model), start, start if in_place else model.state()

    def read(made):
        solver, start, _ = made
        report = solver.report
        return content(start), str(report.totals), report.certified, report.remaining, report.strain

    def step(made):
        solver, start, end = made
        solver.step(start, end, None, None, DT)
        # on a GPU, XPBD adds floats in the order of threads
        return None if device.is_cuda and kind in ("substeps", "monitor") else (content(end), read(made))

    messages = fail_each(device, make, step, read)
    assert any("CollisionStage.step needs " in message for message in messages)
    if device.is_cpu:  # whose first queues are too small for this
        assert any("NarrowPhase.grow" in message for message in messages)
    if device.is_cpu and kind == "implicit":  # the same
        assert any("self.problem.candidates in NewtonMethod._allocate_candidates" in message for message in messages)


def test_what_a_failed_step_puts_back_takes_no_memory_of_its_own_again(device, model):
    solver, start = KINDS["implicit"](model), model.state()
    solver.step(start, start, None, None, DT)
    with failing_memory(device) as memory:
        solver.step(start, start, None, None, DT)
    assert memory.count == 0
