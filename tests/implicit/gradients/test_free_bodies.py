"""Gradients through free bodies that the solver moves, against central differences of its own steps."""

import itertools

import newton
import numpy as np
import pytest
import warp as wp
from gradient_scenes import DT

import warp_bsc as bsc

CLOTH = {"dim_x": 6, "dim_y": 6, "cell_x": 0.05, "cell_y": 0.05, "mass": 0.003, "fix_left": True, "fix_right": True}
CLOTH |= {"tri_ke": 200.0, "tri_ka": 200.0, "tri_kd": 1e-3, "edge_ke": 1e-2, "edge_kd": 1e-4}
VELOCITY = np.array([0.1, -0.05, -1.0, 0.5, -0.3, 0.2])
SEED = np.array([0.2, 0.1, 0.5, 0.1, 0.05, 0.02, 0.03])
SPEED_SEED = np.array([0.01, 0.02, 0.02, 0.005, 0.01, 0.01])


class Box:
    """A box above a cloth that is held at two sides, and the loss of where it ends."""

    def __init__(self, device, height, steps):
        builder = newton.ModelBuilder()
        builder.add_cloth_grid(pos=wp.vec3(-0.15, -0.15, 0.0), rot=wp.quat_identity(), vel=wp.vec3(), **CLOTH)
        turn = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.3, 0.2)), 0.3)
        body = builder.add_body(xform=wp.transform(wp.vec3(0.01, 0.02, height), turn))
        cfg = newton.ModelBuilder.ShapeConfig(density=200.0, mu=0.0)
        builder.add_shape_box(body, hx=0.04, hy=0.03, hz=0.03, cfg=cfg)
        self.model = model = builder.finalize(device=device, requires_grad=True)
        self.solver = bsc.SolverImplicit(model, friction=0.0)
        self.states = [model.state() for _ in range(steps + 1)]
        self.pose = model.body_q.numpy().copy()

    def run(self, velocity=VELOCITY, shift=(0.0, 0.0, 0.0)):
        """Steps from a velocity and a shifted pose, and returns the loss."""
        first, last = self.states[0], self.states[-1]
        pose = self.pose.copy()
        pose[0, :3] += shift
        first.body_q.assign(pose)
        first.body_qd.assign(np.float32(velocity)[None])
        self.solver.reset(first)
        for start, end in itertools.pairwise(self.states):
            self.solver.step(start, end, None, None, DT)
        assert self.solver.report.converged
        return last.body_q.numpy()[0].astype(float) @ SEED + last.body_qd.numpy()[0].astype(float) @ SPEED_SEED

    def gradients(self):
        """Returns the gradients with respect to the velocity and the place at the start."""
        with wp.Tape() as tape:
            self.run()
        last, device = self.states[-1], self.model.device
        seeds = {last.body_q: wp.array(SEED[None], dtype=wp.transform, device=device)}
        seeds[last.body_qd] = wp.array(SPEED_SEED[None], dtype=wp.spatial_vector, device=device)
        tape.backward(grads=seeds)
        return self.states[0].body_qd.grad.numpy()[0], self.states[0].body_q.grad.numpy()[0, :3]


def differences(run, count, step):
    return np.array([(run(step * unit) - run(-step * unit)) / (2.0 * step) for unit in np.eye(count)])


def test_a_body_that_flies(device):
    """It turns by its inertia, which its turn changes."""
    box = Box(device, 0.5, 3)
    of_velocity, of_place = box.gradients()
    np.testing.assert_allclose(of_velocity, differences(lambda d: box.run(VELOCITY + d), 6, 0.02), rtol=2e-3, atol=1e-5)
    np.testing.assert_allclose(of_place, SEED[:3], rtol=1e-5)


def test_a_body_that_hits_a_cloth(device):
    """By how much barriers are stiffer where the cloth is taut counts as constant, which takes little here."""
    box = Box(device, 0.055, 2)
    of_velocity, of_place = box.gradients()
    free = Box(device, 0.5, 2).gradients()[0]
    expected = differences(lambda d: box.run(VELOCITY + d), 6, 0.003)
    assert np.abs(free - expected).max() > 0.2 * np.abs(expected).max()  # contact matters
    assert np.abs(of_velocity - expected).max() < 0.005 * np.abs(expected).max()
    expected = differences(lambda d: box.run(shift=d), 3, 5e-5)
    assert np.abs(of_place - expected).max() < 0.005 * np.abs(expected).max()


def test_a_model_without_particles_is_refused_on_a_tape(device):
    builder = newton.ModelBuilder()
    builder.add_shape_box(builder.add_body(), hx=0.1, hy=0.1, hz=0.1)
    model = builder.finalize(device=device, requires_grad=True)
    solver = bsc.SolverImplicit(model)
    with pytest.raises(NotImplementedError, match="without particles carry no gradients"), wp.Tape():
        solver.step(model.state(), model.state(), None, None, DT)
