"""Substeps add no energy, whatever contacts a program passes on: scenes of ``tests/support/substep_energy.py``."""

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import SOFT
from substep_energy import RISE, Scene, Settings

import warp_bsc as bsc


@pytest.mark.parametrize(
    "settings",
    [
        Settings(1, "pile", "vbd", True, "auto", 60),
        Settings(2, "bodies", "vbd", True, 4, 60),
        Settings(3, "drape", "xpbd", True, 2, 60),
        Settings(25, "pile", "style3d", False, "auto", 60),
    ],
    ids=str,
)
def test_substeps_gain_no_energy(settings, device):
    scene = Scene(settings, device)
    rise, with_elastic, report = scene.run(substeps=settings.substeps, duration=0.2)
    assert report.totals.substepped_steps > 4 or "sees the contacts" in report.substeps_omitted
    assert rise <= RISE
    if settings.substeps == "auto":
        assert with_elastic <= RISE


def test_a_drape_with_contacts_passed_on_gains_no_energy(device):
    """Whole steps on Newton's contacts would leave cloth stretched by a sixth, and substeps release that: 0.5 J."""
    builder = newton.ModelBuilder()
    builder.add_shape_sphere(body=-1, radius=0.2)
    cells = {"dim_x": 16, "dim_y": 16, "cell_x": 0.05, "cell_y": 0.05, "mass": 0.0005}
    at = wp.vec3(-0.4, -0.4, 0.23)
    builder.add_cloth_grid(pos=at, rot=wp.quat_identity(), vel=wp.vec3(), **cells, **SOFT)
    builder.color()
    model = builder.finalize(device=device)
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu, model.particle_mu = 1e4, 1e-2, 0.5, 0.5
    solver = bsc.SolverCCD(newton.solvers.SolverVBD(model, iterations=10), substeps="auto")
    pipeline = newton.CollisionPipeline(model)
    start, end, control, contacts = model.state(), model.state(), model.control(), pipeline.contacts()
    mass = model.particle_mass.numpy().astype(float)

    def energy(state):
        x, v = state.particle_q.numpy(), state.particle_qd.numpy()
        return mass @ (0.5 * (v**2).sum(axis=1) + 9.81 * x[:, 2])

    energies = [energy(start)]
    for _ in range(22):
        start.clear_forces()
        pipeline.collide(start, contacts)
        solver.step(start, end, control, contacts, 1.0 / 60.0)
        start, end = end, start
        energies.append(energy(start))
    assert max(energies) <= (1.0 + RISE) * energies[0]
    assert solver.report.totals.substepped_steps > 10


def test_a_ball_that_pushes_a_stiff_card_is_as_without_the_stage(device):
    """In short steps the inner solver has the contacts: where the stage had them alone, the ball wedged the card, and
    strained its first edges by 3% of their length in each step: 1.6 mJ, where the card moves with 0.4 mJ.
    """
    rate, speed, start_x = 1200.0, 0.5, -0.025
    builder = newton.ModelBuilder()
    builder.default_shape_cfg.mu = 0.1
    builder.add_ground_plane()
    ball = builder.add_body(xform=wp.transform((start_x, 0.045, 0.02), wp.quat_identity()), is_kinematic=True)
    builder.add_shape_sphere(ball, radius=0.02)
    card = {"dim_x": 4, "dim_y": 6, "cell_x": 0.016, "cell_y": 0.015, "mass": 5e-5, "particle_radius": 0.003}
    material = {"tri_ke": 1e4, "tri_ka": 1e4, "tri_kd": 1.0, "edge_ke": 100.0, "edge_kd": 1.0}
    builder.add_cloth_grid(pos=wp.vec3(0.0, 0.0, 0.003), rot=wp.quat_identity(), vel=wp.vec3(), **card, **material)
    builder.color(include_bending=True)
    model = builder.finalize(device=device)
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = 1e5, 100.0, 0.3

    def run(solver):
        pipeline = newton.CollisionPipeline(model)
        start, end, control, contacts = model.state(), model.state(), model.control(), pipeline.contacts()
        positions = []
        for step in range(60):
            start.clear_forces()
            poses = start.body_q.numpy()
            poses[0, 0] = start_x + speed * step / rate
            start.body_q.assign(poses)
            pipeline.collide(start, contacts)
            solver.step(start, end, control, contacts, 1.0 / rate)
            start, end = end, start
            positions.append(start.particle_q.numpy())
        return np.array(positions)

    alone, solver = run(newton.solvers.SolverVBD(model)), bsc.SolverCCD(newton.solvers.SolverVBD(model))
    staged = run(solver)
    assert alone[-1, :, 0].min() > 0.01  # the ball has pushed it
    np.testing.assert_allclose(staged, alone, rtol=0.0, atol=1e-6 * device.is_cuda)  # atomic sums of contact forces
    assert solver.report.totals.substepped_steps == solver.report.totals.uncertified_steps == 0
