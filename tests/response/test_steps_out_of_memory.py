"""Steps for which memory does not suffice: states and reports as before, and the same step once there is memory."""

import newton
import numpy as np
import pytest
import warp as wp
from failing_memory import fail_each, failing_memory
from newton_scenes import DT, SOLVERS, add_patch

import warp_bsc as bsc


def falling(device):
    """A small cloth that flies through a larger one."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 6, 0.05, (0.0, 0.0, 0.0), fixed=True)
    add_patch(builder, 3, 0.03, (0.01, 0.01, 0.05), velocity=(0.0, 0.0, -30.0))
    return builder.finalize(device=device)


def arrays_in(state):
    return {name: array for name, array in vars(state).items() if isinstance(array, wp.array)}


KINDS = {
    "ccd": lambda model: bsc.SolverCCD(SOLVERS["vbd"](model)),
    "substeps": lambda model: bsc.SolverCCD(SOLVERS["xpbd"](model), substeps=2, report=["contacts", "worlds"]),
    "implicit": lambda model: bsc.SolverImplicit(model, report=["contacts"]),
    "monitor": lambda model: bsc.CollisionMonitor(SOLVERS["xpbd"](model)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_step_that_has_no_memory_changes_nothing(device, kind):
    model = falling(device)

    def make():
        return KINDS[kind](model), model.state(), model.state()

    with failing_memory(device) as memory:
        solver, start, end = make()
        counts = [memory.count]
        for _ in range(4):
            solver.step(start, end, None, None, DT)
            start, end = end, start
            counts.append(memory.count)
    print(kind, np.diff(counts))
    assert 0
