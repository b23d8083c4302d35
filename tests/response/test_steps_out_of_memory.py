"""Steps for which memory does not suffice: states and reports as before, and the same step once there is memory."""

import newton
import pytest
import warp as wp
from failing_memory import fail_each
from newton_scenes import DT, SOLVERS, add_patch

import warp_bsc as bsc

KINDS = {
    "ccd": lambda model: bsc.SolverCCD(SOLVERS["vbd"](model)),
    "substeps": lambda model: bsc.SolverCCD(SOLVERS["xpbd"](model), substeps=2, report=["contacts", "worlds"]),
    "implicit": lambda model: bsc.SolverImplicit(model, report=["contacts"]),
    "monitor": lambda model: bsc.CollisionMonitor(SOLVERS["xpbd"](model)),
}


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


@pytest.mark.parametrize("in_place", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_a_step_without_memory_changes_nothing(device, model, kind, in_place):
    def make():
        start = model.state()
        return KINDS[kind](model), start, start if in_place else model.state()

    def read(made):
        solver, start, end = made
        return content(start, end), str(solver.report.totals), solver.report.certified

    def step(made):
        solver, start, end = made
        solver.step(start, end, None, None, DT)
        return read(made)

    from failing_memory import failing_memory
    from warp_bsc.detection.run.memory import DeviceMemoryError

    with failing_memory(device) as memory:
        made = make()
        before = memory.count
        expected = step(made)

    def diff(x, y):
        return [
            ("start" if i * 2 < len(x[0]) else "end") + "." + a[0] for i, (a, b) in enumerate(zip(x[0], y[0])) if a != b
        ] + [(a, b) for a, b in zip(x[1:], y[1:]) if a != b]

    for number in range(memory.count - before):
        made = make()
        state = read(made)
        with failing_memory(device, number):
            try:
                step(made)
                print(number, "no error")
            except DeviceMemoryError as error:
                print(number, str(error)[:150])
            except Exception as error:
                print(number, "OTHER", repr(error)[:300])
        print("   changed", diff(read(made), state))
        try:
            print("   again", diff(step(made), expected))
        except Exception as error:
            print("   AGAIN", repr(error)[:300])
    assert 0
