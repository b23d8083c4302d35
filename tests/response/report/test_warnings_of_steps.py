"""Warnings of a stage: given once the host can know of a step, at the line of the program that steps it or reads it."""

import linecache

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import SOLVERS, Changed, add_patch

import warp_bsc as bsc

DT = 1.0 / 240.0


def lost_patch(device, **options):
    """A model with a particle that is nowhere, so that no step of it is certified."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 2, 0.05, (0.0, 0.0, 0.0))
    builder.particle_q[4] = wp.vec3(np.nan, 0.0, 0.0)
    builder.color()
    return builder.finalize(device=device, **options)


def check_origin(said, text):
    """Checks that one warning says that a step is not certified, and has a line of this file with a text."""
    (warning,) = [warning for warning in said if "not certified" in str(warning.message)]
    assert warning.filename == __file__
    assert text in linecache.getline(warning.filename, warning.lineno)


@pytest.mark.parametrize("substeps", [1, 2])
@pytest.mark.parametrize("requires_grad", [False, True])
def test_a_step_warns_at_the_line_that_takes_it(substeps, requires_grad, device):
    model = lost_patch(device, requires_grad=requires_grad)
    solver = bsc.SolverCCD(Changed(model), substeps=substeps)
    with pytest.warns(UserWarning, match="not certified") as said:
        solver.step(model.state(), model.state(), None, None, DT)
        assert not solver.report.certified  # a GPU may not have been done before
    check_origin(said, "solver." if device.is_cuda else "solver.step(")


READS = ["certified", "predicted_contacts", "strain", "frozen", "totals", "uncertified_vertices"]


@pytest.mark.parametrize("read", READS)
def test_a_step_in_a_graph_warns_where_a_number_is_read(read, device):
    model = lost_patch(device)
    solver = bsc.SolverCCD(SOLVERS["vbd"](model))
    states = model.state(), model.state()
    with wp.ScopedCapture(device) as capture:
        solver.step(*states, None, None, DT)
    with pytest.warns(UserWarning, match="not certified") as said:
        wp.capture_launch(capture.graph)
        getattr(solver.report, read)
    check_origin(said, "getattr(")


def test_a_read_waits_for_the_step_before_it_warns(device, monkeypatch):
    """The totals of a step arrive on the host with the first number that is read, as on a GPU that is busy."""
    model = lost_patch(device)
    solver = bsc.SolverCCD(Changed(model))
    copy, read_result = solver.report.copy_totals, solver.report._read_result

    def read(result):
        copy()
        return read_result(result)

    monkeypatch.setattr(solver.report, "copy_totals", lambda: None)
    monkeypatch.setattr(solver.report, "_read_result", read)
    solver.step(model.state(), model.state(), None, None, DT)
    with pytest.warns(UserWarning, match="not certified"):
        assert not solver.report.certified


def test_a_replay_of_captured_steps_warns_where_it_is_called(device):
    model = lost_patch(device)
    solver = bsc.SolverCCD(SOLVERS["vbd"](model))
    states = model.state(), model.state()
    steps = bsc.CapturedSteps(lambda: solver.step(*states, None, None, DT), solver)
    with pytest.warns(UserWarning, match="not certified") as said:
        steps()
        wp.synchronize_device(device)
        steps()
    # on a GPU in the first call, which captures the step, or in the second, whichever has the totals
    check_origin(said, "steps" if device.is_cuda else "lambda: solver.step(")
