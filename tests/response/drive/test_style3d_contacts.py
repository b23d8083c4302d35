"""Contacts inside the solve of Style3D, which sees the constraints of the stage in its iterations."""

import newton
import numpy as np
import pytest
import warp as wp
from newton.solvers import SolverStyle3D
from newton_scenes import Rollout
from sample_sizes import cases
from style3d_scenes import add_sheet, drape

import warp_bsc as bsc
from warp_bsc.response.drive.inner_steps import InnerSteps
from warp_bsc.response.drive.style3d_springs import SpringSteps, Style3DContacts

RATE = 60.0


def largest_stretch(model, x):
    edges = np.unique(np.sort(model.tri_indices.numpy()[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    rest, now = (np.linalg.norm(y[edges[:, 0]] - y[edges[:, 1]], axis=1) for y in (model.particle_q.numpy(), x))
    return (now / rest).max() - 1.0


def roll(model, steps, **options):
    inner = SolverStyle3D(model)
    inner.collision = None  # its own contacts, which need those of Newton
    rollout = Rollout(model, bsc.SolverCCD(inner, **options))
    stretch = []
    for _ in range(steps):
        rollout.step(1.0 / RATE)
        stretch.append(largest_stretch(model, rollout.positions))
    assert rollout.solver.report.totals.uncertified_steps == 0 and rollout.collisions == 0
    return rollout, max(stretch)


@pytest.mark.parametrize("sheets", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_drape_stretches_hardly(sheets, device, monkeypatch):
    model = drape(device, sheets=sheets)
    rollout, stretch = roll(model, 36)
    monkeypatch.setattr(SpringSteps, "take", InnerSteps.take)  # which does not see them
    _, without = roll(model, 36)
    assert stretch < 0.12 and without > 2.0 * stretch
    assert rollout.positions[:, 2].max() > 0.15  # it lies on the sphere


def test_equal_runs_are_equal_bit_for_bit(device):
    """Threads of the detection find contacts in another order each time."""
    if device.is_cuda:
        pytest.skip("on a GPU Style3D itself adds forces in any order")
    model = drape(device, sheets=2, cells=16)
    ends = []
    for _ in range(1 + cases(3)):
        solver, states = bsc.SolverCCD(SolverStyle3D(model)), [model.state(), model.state()]
        for _ in range(8):
            solver.step(*states, model.control(), None, 1.0 / RATE)
            states.reverse()
        ends.append([states[0].particle_q.numpy(), states[0].particle_qd.numpy()])
    work = solver.work
    Style3DContacts(work).find(states[0], 1.0 / RATE)
    of_second = work.constraints.vertices.numpy()[: work.constraints.count.numpy()[0]] >= model.particle_count // 2
    of_cloth = work.constraints.vertices.numpy()[: len(of_second)] < model.particle_count
    pairs = (of_second & of_cloth).any(axis=1) & (~of_second).any(axis=1)
    assert pairs.sum() > 100  # between the sheets
    for end in ends[1:]:
        np.testing.assert_array_equal(end, ends[0])


def test_where_nothing_touches_no_bit_changes(device):
    model = drape(device, cells=6)
    plain, state = SolverStyle3D(model), [model.state(), model.state()]
    plain.collision = None
    rollout = Rollout(model, bsc.SolverCCD(SolverStyle3D(model)))
    for _ in range(4):
        rollout.step(1e-3)
        state[0].clear_forces()
        plain.step(*state, model.control(), None, 1e-3)
        state.reverse()
    assert rollout.solver.report.predicted_contacts == 0
    atol = 1e-7 if device.is_cuda else 0.0  # sums of Style3D are atomic on a GPU
    np.testing.assert_allclose(rollout.positions, state[0].particle_q.numpy(), rtol=0.0, atol=atol)


def test_in_a_graph_as_without(device):
    """Also on a GPU, where Style3D allocates in its steps: nothing here depends on a condition."""
    model, ends = drape(device, cells=6), []
    for in_graph in (False, True):
        solver = bsc.SolverCCD(SolverStyle3D(model))
        states, control = [model.state(), model.state()], model.control()

        def two_steps(solver=solver, states=states, control=control):
            for start, end in (states, states[::-1]):
                start.clear_forces()
                solver.step(start, end, control, None, 1.0 / RATE)

        two_steps()
        graph = None
        if in_graph:
            with wp.ScopedCapture(device) as capture:
                two_steps()
            graph = capture.graph
        for _ in range(4):
            wp.capture_launch(graph) if graph else two_steps()
        assert solver.report.totals.uncertified_steps == 0
        ends.append(states[0].particle_q.numpy())
        assert ends[-1][:, 2].max() > 0.15  # the sphere holds it
    # on a GPU forces are added up in any order
    np.testing.assert_allclose(*ends, rtol=0.0, atol=1e-4 if device.is_cuda else 0.0)


def test_a_moving_wedge_pushes_without_penetration(device):
    """A kinematic box that a program moves between steps goes on pushing the sheet."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    SolverStyle3D.register_custom_attributes(builder)
    body = builder.add_body(is_kinematic=True)
    builder.add_shape_box(body, hx=0.1, hy=0.1, hz=0.02)
    add_sheet(builder, 8, 0.03, size=0.4)
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(SolverStyle3D(model)))
    for k in range(30):
        pose = np.array([[0.0, 0.0, 0.01 * (k + 1), 0.0, 0.0, 0.0, 1.0]], dtype=np.float32)
        for state in rollout.states:
            state.body_q.assign(pose)
        rollout.step(1.0 / RATE)
        assert rollout.solver.report.certified
    centre = np.linalg.norm(rollout.positions[:, :2], axis=1) < 0.08
    assert (rollout.positions[centre, 2] > 0.32).all()
    assert largest_stretch(model, rollout.positions) < 0.1


def test_reset_worlds_start_anew(device):
    model = drape(device, cells=6)
    rollout, _ = roll(model, 12)
    first, _ = roll(model, 3)
    start = rollout.states[0]
    start.assign(model.state())
    rollout.solver.reset(start)
    for _ in range(3):
        rollout.step(1.0 / RATE)
    atol = 1e-6 if device.is_cuda else 0.0
    np.testing.assert_allclose(rollout.positions, first.positions, rtol=0.0, atol=atol)


@pytest.mark.parametrize("by_reset", [False, True])
def test_cloth_that_starts_in_a_solid_is_not_pushed(by_reset, device):
    """Springs sweep no plane through it: not to where the model has the plane, and not to where a reset puts it."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    SolverStyle3D.register_custom_attributes(builder)
    place = wp.transform(wp.vec3(0.0, 0.0, 0.2 - by_reset), wp.quat_identity())
    body = builder.add_body(xform=place, is_kinematic=True)
    builder.add_shape_plane(plane=(0.0, 0.0, 1.0, 0.0), body=body, width=0.0, length=0.0)
    add_sheet(builder, 4, 0.1)
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(SolverStyle3D(model)))
    if by_reset:
        rollout.step(1.0 / RATE)
        for state in rollout.states:
            state.body_q.assign(np.array([[0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0]], dtype=np.float32))
        rollout.solver.reset(rollout.states[0])
    rollout.step(1.0 / RATE)
    assert rollout.solver.report.excluded == 25
    np.testing.assert_allclose(rollout.positions, model.particle_q.numpy(), rtol=0.0, atol=1e-6)
