"""The speed limit of VBD's self-contact: lifted where it brakes, kept where nothing is fast."""

import contextlib

import newton
import numpy as np
import pytest
import warp as wp
from newton.solvers import SolverVBD
from newton_scenes import DT, Rollout, add_patch, bullet

import warp_bsc as bsc
from warp_bsc.response.integration.vbd_speed_limit import SpeedLimit

LONGEST = 0.5 * 0.85 * 0.0035
"""Longest path that VBD with these margins leaves a particle between two detections [m]."""


class Derived(SolverVBD):
    """A class of a program's own, behind which a graph cannot branch."""


def vbd_with_self_contact(model, solver=SolverVBD):
    """VBD with self-contact as in Newton's example ``cloth_twist``, but for the number of iterations."""
    margins = {"particle_self_contact_margin": 0.002, "particle_self_contact_gap": 0.0015}
    return solver(model, iterations=3, particle_enable_self_contact=True, **margins)


@pytest.mark.parametrize("lift", [True, False])
def test_the_speed_limit_of_self_contact_is_lifted(lift, device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 3, 0.05, (0.0, 0.0, 0.0), velocity=(0.0, 0.0, 60.0))
    builder.color()
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(vbd_with_self_contact(model), lift_speed_limit=lift)
    rollout = Rollout(model, solver)
    for _ in range(3):
        rollout.step()
    assert solver.report.speed_limit_lifted is lift
    assert ("speed limit" in str(solver.report)) is lift
    speed = rollout.velocities[:, 2].mean()
    assert np.isclose(speed, 60.0, rtol=1e-5) if lift else speed < 2.0 * LONGEST / DT


def test_layers_in_reach_of_self_contact_fly_on_together(device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for height in (0.0, 0.0025):
        add_patch(builder, 3, 0.02, (0.0, 0.0, height), velocity=(3.0, 0.0, -10.0))
    builder.color()
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(vbd_with_self_contact(model)))
    for _ in range(4):
        rollout.step()
    assert np.allclose(rollout.velocities, [3.0, 0.0, -10.0], atol=1e-3)


def test_the_limit_stays_in_worlds_in_which_nothing_is_fast(device):
    """Two layers move slowly as one, so that VBD cuts the path of the one behind, unless another patch is fast."""
    slow = 0.5 * LONGEST / DT
    world = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for place in ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0004), (0.5, 0.0, 0.0)):
        add_patch(world, 3, 0.02, place, velocity=(0.0, 0.0, slow))
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for _ in range(2):
        builder.add_world(world)
    builder.color()
    model = builder.finalize(device=device)
    model.soft_contact_ke = 1e-6  # the layers do not push each other apart

    def ways(speed, lift=True):
        """The way of each patch of each world in a step in which the last patch has a speed."""
        velocities = model.particle_qd.numpy().reshape(2, 3, -1, 3)
        velocities[1, 2, :, 2] = speed
        rollout = Rollout(model, bsc.SolverCCD(vbd_with_self_contact(model), lift_speed_limit=lift))
        rollout.states[0].particle_qd.assign(velocities.reshape(-1, 3))
        rollout.step()
        return (rollout.positions - model.particle_q.numpy()).reshape(2, 3, -1, 3)[..., 2]

    corner = np.zeros(16)
    corner[0] = 1.5 * slow
    assert np.array_equal(ways(slow + corner), ways(slow + corner, lift=False))  # one that trembles alone is not fast
    kept, lifted = ways(slow), ways(4.0 * slow)
    assert np.array_equal(kept, ways(slow, lift=False)) and np.array_equal(lifted[0], kept[0])
    assert kept[1, 0].max() < 0.75 * slow * DT  # the layer behind
    assert np.allclose(lifted[1, :2], slow * DT, rtol=1e-3)
    assert np.allclose(lifted[1, 2], 4.0 * slow * DT, rtol=1e-4)
    assert ways(4.0 * slow, lift=False).max() < 0.7 * 4.0 * slow * DT


@pytest.mark.parametrize(("inner", "substeps"), [(SolverVBD, "auto"), (SolverVBD, None), (Derived, "auto")])
def test_a_graph_lifts_the_limit_in_steps_in_which_something_is_fast(inner, substeps, device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 3, 0.02, (0.0, 0.0, 0.0))
    builder.color()
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(vbd_with_self_contact(model, inner), substeps=substeps)
    start, end, control = model.state(), model.state(), model.control()
    solver.step(start, end, control, None, DT)
    with wp.ScopedCapture(device) as capture:
        solver.step(start, end, control, None, DT)
    ways = []
    for speed in (0.5 * LONGEST / DT, 40.0, 0.0):
        start.particle_q.assign(model.particle_q)
        start.particle_qd.fill_(wp.vec3(0.0, 0.0, speed))
        wp.capture_launch(capture.graph)
        ways.append((end.particle_q.numpy() - model.particle_q.numpy())[:, 2] - speed * DT)
    assert np.allclose(ways, 0.0, atol=1e-4)


@pytest.mark.parametrize("self_contact", [True, False])
def test_a_graph_begins_with_a_step_in_which_vbd_allocates(self_contact, device):
    """Buffers for contacts grow in the first step with them, which a condition in a graph must not contain."""
    builder = newton.ModelBuilder()
    builder.add_shape_sphere(builder.add_body(xform=wp.transform((1.0, 0.0, 0.0))), radius=0.05)
    add_patch(builder, 3, 0.02, (0.0, 0.0, 0.0), velocity=(0.0, 0.0, 40.0))
    builder.color()
    ends = []
    for in_graph in (False, True):
        model = builder.finalize(device=device)
        vbd = vbd_with_self_contact(model) if self_contact else SolverVBD(model, iterations=3)
        pipeline = newton.CollisionPipeline(model, soft_contact_max=5000, rigid_contact_max=500)
        solver, contacts = bsc.SolverCCD(vbd), pipeline.contacts()
        start, end, control = model.state(), model.state(), model.control()
        pipeline.collide(start, contacts)
        with wp.ScopedCapture(device) if in_graph else contextlib.nullcontext() as capture:
            solver.step(start, end, control, contacts, DT)
        if capture is not None:
            wp.capture_launch(capture.graph)
        assert solver.report.certified
        ends.append(end.particle_q.numpy())
    assert np.array_equal(*ends)
    assert np.allclose(ends[0][:, 2], 40.0 * DT, atol=1e-3)


@pytest.mark.parametrize("source", ["gravity", "force"])
def test_what_gravity_and_forces_move_is_fast(source, device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -4.0 * LONGEST / DT**2 if source == "gravity" else 0.0))
    add_patch(builder, 3, 0.02, (0.0, 0.0, 0.0))
    builder.color()
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(vbd_with_self_contact(model))
    start, end = model.state(), model.state()
    if source == "force":
        force = -4.0 * LONGEST / DT**2 * model.particle_mass.numpy()
        start.particle_f.assign(force[:, None] * np.float32([0.0, 0.0, 1.0]))
    solver.step(start, end, model.control(), None, DT)
    ways = end.particle_q.numpy() - model.particle_q.numpy()
    assert np.allclose(ways[:, 2], -4.0 * LONGEST, rtol=1e-3)


def test_self_contact_without_its_limit_still_pushes(device):
    """Two patches nearer than the margin part by VBD's forces alone, which the stage would not add."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for height in (0.0, 0.001):
        add_patch(builder, 4, 0.05, (0.3 * height, 0.0, height), velocity=(3.0, 0.0, 0.0))  # so that it is lifted
    builder.color()
    model = builder.finalize(device=device)
    model.soft_contact_ke = 1e3
    rollout = Rollout(model, bsc.SolverCCD(vbd_with_self_contact(model)))
    for _ in range(3):
        rollout.step()
    assert rollout.solver.report.hits == 0
    lower, upper = np.split(rollout.positions[:, 2], 2)
    assert upper.mean() - lower.mean() > 0.00105


def test_a_bullet_behind_self_contact_is_stopped(device):
    rollout_of = bullet(60.0, device=device)
    rollout = Rollout(rollout_of, bsc.SolverCCD(vbd_with_self_contact(rollout_of)))
    for _ in range(8):
        rollout.step()
    assert rollout.collisions == 0 and rollout.solver.report.totals.uncertified_steps == 0


def test_the_inner_solver_alone_keeps_its_limit(device):
    """Outside a step of the stage, VBD is as it was made."""
    model = bullet(60.0, device=device)
    inner = vbd_with_self_contact(model)
    Rollout(model, bsc.SolverCCD(inner)).step()
    assert inner.particle_enable_self_contact
    assert "_penetration_free_truncation" not in vars(inner)


@pytest.mark.parametrize("speed", [0.0, 30.0])
def test_cuts_before_rigid_shapes_stay(speed, device):
    """Where a graph cannot branch, VBD cuts twice, and what the cut before shapes leaves is kept where it is fast."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 3, 0.02, (0.0, 0.0, 0.0), velocity=(0.0, 0.0, speed))
    builder.color()
    model = builder.finalize(device=device)
    inner, state, cuts = vbd_with_self_contact(model), model.state(), []
    truncate = inner._penetration_free_truncation
    inner.rigid_soft_enable_dat = True

    def cut(*arguments):
        cuts.append(inner.particle_enable_self_contact)
        if not cuts[-1]:
            inner.particle_displacements.fill_(wp.vec3(0.0, 0.0, 0.5))  # as if a shape were in the way
        truncate(*arguments)

    def step():
        inner.particle_displacements.fill_(wp.vec3(0.0, 0.0, 1.0))
        inner._penetration_free_truncation(state, None)

    inner._penetration_free_truncation = cut
    SpeedLimit(inner).step(step, state, DT, can_branch=False)
    assert cuts == [False, True] and inner._penetration_free_truncation is cut
    assert np.allclose(inner.particle_displacements.numpy()[:, 2], 0.5 if speed else LONGEST)
    assert np.allclose(state.particle_q.numpy()[:, 2], 0.5 if speed else LONGEST)
