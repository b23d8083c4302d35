"""SolverImplicit reports the forces of what friction holds, wherever that is, and does not let it slip."""

import newton
import numpy as np
import pytest
import warp as wp

from warp_bsc.implicit.solver_implicit import SolverImplicit

DT = 1.0 / 240.0
GRAVITY = 9.81


def last_steps(model, impulse, **options):
    """Impulses by DT, and the largest velocity, in the last 20 of 80 steps."""
    solver, states, forces = SolverImplicit(model, report=["contacts"], **options), [model.state(), model.state()], []
    speed = 0.0
    for step in range(80):
        solver.step(*states, None, None, DT)
        states.reverse()
        assert solver.report.certified
        if step >= 60:
            forces.append(getattr(solver.report.forces, impulse).numpy()[:, :3].sum(axis=0) / DT)
            velocities = states[0].particle_qd if model.particle_count else states[0].body_qd
            speed = max(speed, np.abs(velocities.numpy()).max())
    return np.array(forces), speed


@pytest.mark.parametrize(
    ("between", "at"),
    [(3.98e-3, 0.0), (4.6e-3, 0.0), (4.6e-3, 2.0)],
    ids=["too near", "gripped", "far away"],
)
def test_pads_feel_the_weight_of_a_triangle_that_they_grip(between, at, device):
    """The distance of cloth and pads is 2 mm; first they begin nearer than that."""
    builder = newton.ModelBuilder()
    builder.default_shape_cfg.mu = 1.0
    builder.add_cloth_mesh(
        pos=wp.vec3(at), rot=wp.quat_identity(), scale=1.0, vel=wp.vec3(), density=1.0, tri_ke=1e3, tri_ka=1e3,
        tri_kd=0.0, edge_ke=0.0, indices=[0, 1, 2],
        vertices=[wp.vec3(-0.05, 0.0, -0.03), wp.vec3(0.05, 0.0, -0.03), wp.vec3(0.0, 0.0, 0.06)],
    )  # fmt: skip
    for side in (-1.0, 1.0):
        place = wp.transform(wp.vec3(at, at + side * (0.005 + 0.5 * between), at), wp.quat_identity())
        builder.add_shape_box(-1, xform=place, hx=0.01, hy=0.005, hz=0.01)
    model = builder.finalize(device=device)
    model.particle_mu = 1.0
    weight = GRAVITY * model.particle_mass.numpy().sum()
    forces, speed = last_steps(model, "shape_impulse", min_distance=0.002)
    np.testing.assert_allclose(forces, [3 * [0.0] - np.array([0.0, 0.0, weight])] * 20, atol=0.01 * weight)
    assert speed < 2e-4


def test_a_slope_holds_a_box_far_from_the_origin(device):
    angle = 0.4  # whose tangent is 0.42
    gravity = GRAVITY * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    cfg = newton.ModelBuilder.ShapeConfig(mu=0.8, density=0.0)
    builder = newton.ModelBuilder(gravity=tuple(gravity))
    builder.add_shape_box(
        -1, xform=wp.transform(wp.vec3(5.0, 5.0, 4.5), wp.quat_identity()), hx=1.0, hy=1.0, hz=0.5, cfg=cfg
    )
    place = wp.transform(wp.vec3(5.0, 5.0, 5.0502), wp.quat_identity())
    body = builder.add_body(xform=place, mass=1.0, inertia=wp.mat33(0.003 * np.eye(3)), lock_inertia=True)
    builder.add_shape_box(body, hx=0.1, hy=0.08, hz=0.05, cfg=cfg)
    forces, speed = last_steps(builder.finalize(device=device), "body_impulse")
    np.testing.assert_allclose(forces.mean(axis=0), -gravity, atol=0.002 * GRAVITY)
    np.testing.assert_allclose(forces, 20 * [-gravity], atol=0.01 * GRAVITY)
    assert speed < 1e-3


def test_newton_steps_with_friction_do_not_go_to_and_fro(device):
    """Towels thrown on a bar: without damping, 4 of 192 steps do not end, however many Newton steps they are given."""
    world, builder, worlds = newton.ModelBuilder(), newton.ModelBuilder(), 12
    cfg = newton.ModelBuilder.ShapeConfig(mu=0.8)
    along_y = wp.transform(wp.vec3(), wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.5 * wp.pi))
    world.add_shape_capsule(-1, xform=along_y, radius=0.03, half_height=0.25, cfg=cfg)
    world.add_cloth_grid(
        pos=wp.vec3(-0.3, -0.15, 0.05), rot=wp.quat_identity(), vel=wp.vec3(), dim_x=10, dim_y=5, cell_x=0.06,
        cell_y=0.06, mass=0.002, tri_ke=100.0, tri_ka=100.0, tri_kd=1e-3, edge_ke=2e-3, edge_kd=1e-4,
    )  # fmt: skip
    builder.replicate(world, worlds)
    model = builder.finalize(device=device)
    model.particle_mu = 0.8
    solver, states = SolverImplicit(model, max_iterations=100), [model.state(), model.state()]
    thrown = np.random.default_rng(1).normal(size=(worlds, 3)) * [0.5, 0.5, 0.2] - [0.0, 0.0, 1.0]
    states[0].particle_qd.assign(np.repeat(thrown, model.particle_count // worlds, axis=0).astype(np.float32))
    unconverged = 0
    for _ in range(16):
        solver.step(*states, None, None, 1.0 / 60.0)
        states.reverse()
        unconverged += (~solver.report.results.converged.numpy()).sum()
    assert unconverged <= 1
