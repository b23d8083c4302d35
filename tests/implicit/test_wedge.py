"""SolverImplicit in a vice: plates that a program closes on a soft block, cloth and a box until there is no room."""

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import add_patch

import warp_bsc as bsc
from warp_bsc.bench.elastic_energy import ElasticEnergy

DT = 1.0 / 60.0
PLATE = np.array([0.15, 0.12, 0.02])
BOX = np.array([0.03, 0.03, 0.006])
HEIGHT = 0.07
CLOSED = [0.25, 0.5, 0.75, 1.0, 1.0, 0.75, 0.5, 0.5, 0.5]
RELEASED = 5
"""The first of these steps in which the plates open."""


def poses(closed, angle):
    """Of both plates: the upper one comes down, or turns about an edge of the lower one, until their faces meet."""
    turn = angle * (1.0 - closed)
    x, z = np.array([np.cos(turn), 0.0, np.sin(turn)]), np.array([-np.sin(turn), 0.0, np.cos(turn)])
    hinge = np.array([-PLATE[0], 0.0, 0.0 if angle else HEIGHT * (1.0 - closed)])
    turned = [0.0, -np.sin(0.5 * turn), 0.0, np.cos(0.5 * turn)]
    return np.array([[0.0, 0.0, -PLATE[2], 0.0, 0.0, 0.0, 1.0], [*(hinge + PLATE[0] * x + PLATE[2] * z), *turned]])


def build(angle, device):
    """A world for each of what is between the plates, without gravity: only plates do work."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for content in ("block", "cloth", "box"):
        world = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        for pose in poses(0.0, angle):
            plate = world.add_body(xform=wp.transform(*pose.tolist()), is_kinematic=True)
            world.add_shape_box(plate, hx=PLATE[0], hy=PLATE[1], hz=PLATE[2])
        if content == "block":
            size = dict.fromkeys(("dim_x", "dim_y", "dim_z"), 1) | dict.fromkeys(("cell_x", "cell_y", "cell_z"), 0.06)
            material = {"density": 300.0, "k_mu": 2e4, "k_lambda": 4e4, "k_damp": 0.0}
            world.add_soft_grid(
                pos=wp.vec3(0.0, -0.03, 0.002), rot=wp.quat_identity(), vel=wp.vec3(), **size, **material
            )
        elif content == "cloth":
            add_patch(world, 3, 0.08, (0.0, 0.0, 0.02))
        else:
            body = world.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.007), wp.quat_identity()))
            world.add_shape_box(body, hx=BOX[0], hy=BOX[1], hz=BOX[2])
        builder.add_world(world)
    return builder.finalize(device=device)


def vertices_inside(state, plates):
    """Whether a particle or a corner of the box is inside of a plate, in each of the three worlds."""
    x, pose = state.particle_q.numpy(), state.body_q.numpy()[6]
    corners = BOX * np.stack(np.meshgrid(*3 * ([-1.0, 1.0],)), axis=-1).reshape(-1, 3)
    corners = pose[:3] + corners @ np.array(wp.quat_to_matrix(wp.quat(*pose[3:].tolist()))).reshape(3, 3).T
    found = []
    for content in (x[:8], x[8:], corners):
        depth = -np.inf
        for plate in plates:
            turn = np.array(wp.quat_to_matrix(wp.quat(*plate[3:].tolist()))).reshape(3, 3)
            depth = max(depth, (PLATE - np.abs((content - plate[:3]) @ turn)).min(axis=1).max())
        found.append(depth > 1e-6)
    return np.array(found)


@pytest.mark.filterwarnings("ignore:.*not certified", "ignore:edges pass", "ignore:.*strained")
@pytest.mark.parametrize(
    "angle", [pytest.param(0.0, marks=pytest.mark.slow), np.radians(35.0)], ids=["parallel", "wedge"]
)
def test_what_is_squeezed_is_named_and_does_not_explode(angle, device):
    model = build(angle, device)
    solver, energy = bsc.SolverImplicit(model, report=["worlds"]), ElasticEnergy(model)
    state, end = model.state(), model.state()
    world, mass = model.particle_world.numpy(), model.particle_mass.numpy()
    box_mass, box_inertia = model.body_mass.numpy()[6], model.body_inertia.numpy()[6]
    named, held, total = np.zeros(3, dtype=bool), np.zeros(3), np.zeros(3)
    for step, closed in enumerate(CLOSED):
        plates, q = poses(closed, angle), state.body_q.numpy()
        q[:6] = np.tile(plates, (3, 1))
        state.body_q.assign(q)
        solver.step(state, end, None, None, DT)
        state, end = end, state
        report = solver.report.worlds.numpy()
        certified = report["certified"]
        assert report["newton_steps"].max() <= 32 and not (report["converged"] & ~certified).any()
        listed = np.bincount(world[solver.report.uncertified_vertices], minlength=3)
        listed += np.bincount(model.body_world.numpy()[solver.report.uncertified_bodies], minlength=3)
        assert (listed > 0).tolist() == (~certified).tolist()
        named |= ~certified
        assert not (vertices_inside(state, plates) & ~named).any()
        v, qd = state.particle_qd.numpy().astype(np.float64), state.body_qd.numpy()[6].astype(np.float64)
        total = energy.of(state.particle_q.numpy()) + np.bincount(world, 0.5 * mass * (v * v).sum(axis=1), minlength=3)
        turns = np.array(wp.quat_to_matrix(wp.quat(*state.body_q.numpy()[6, 3:].tolist()))).reshape(3, 3).T @ qd[3:]
        total[2] += 0.5 * box_mass * (qd[:3] ** 2).sum() + 0.5 * turns @ box_inertia @ turns
        if step < RELEASED:
            held = total
        else:  # the outer border of a plate is the fastest of what does work
            fastest = 0.25 * (2.0 * PLATE[0] * angle or HEIGHT) / DT
            assert max(np.linalg.norm(v, axis=1).max(), np.linalg.norm(qd[:3])) < 2.0 * fastest
    assert (total <= held + 0.02).all()
    assert named.all()
