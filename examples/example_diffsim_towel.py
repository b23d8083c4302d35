"""Example Diffsim Towel: finds the throw after which a towel hangs over a bar.

    python examples/example_diffsim_towel.py

Gradient descent improves three throws, each in a world of its own. The loss is the mean squared distance of the
particles, 0.8 s after the throw, from a towel that hangs over the bar with both halves. Its gradient goes back through
contacts of the towel with the bar and with itself, flight and throw, in steps of ``SolverImplicit``. At the end the
best throws go on for a second, to see that the towels stay on the bar.
"""

import newton
import numpy as np
import warp as wp
from common import main
from diffsim import build_worlds
from diffsim_targets import TargetExample
from searches import FittedNewton

CELLS = 10, 5
CELL = 0.06  # [m]
RADIUS = 0.03  # of the bar, which lies along y through the origin [m]
START = wp.vec3(-0.55, 0.0, 0.15)  # centre of the towel [m]
STARTS = [(1.0, 0.0, 2.0), (2.2, 0.4, 0.5), (0.6, -0.4, 1.0)]  # first throws [m/s]
STEPS = 48
LAST = 12  # steps at the end of which the towel should hang
STAYS = 60  # further steps in which it should stay


@wp.kernel
def throw(throws: wp.array[wp.vec3], particle_world: wp.array[int], particle_qd: wp.array[wp.vec3]):
    """Sets the velocity of each particle to the throw of its world."""
    particle = wp.tid()
    particle_qd[particle] = throws[particle_world[particle]]


def hang(rest, thickness):
    """Returns where particles are if the towel hangs over the bar, shape [n, 3].

    Args:
        rest: Their positions in the flat towel, relative to its centre [m], shape [n, 3].
        thickness: How far from the bar they are [m].
    """
    radius = RADIUS + thickness
    angle = np.clip(rest[:, 0] / radius, -0.5 * np.pi, 0.5 * np.pi)
    below = np.maximum(np.abs(rest[:, 0]) - 0.5 * np.pi * radius, 0.0)
    return np.stack([radius * np.sin(angle), rest[:, 1], radius * np.cos(angle) - below], axis=1)


class Example(TargetExample):
    """The scene, in the format of Newton's examples; a frame is an iteration of the optimisation."""

    num_frames = 16

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        world = newton.ModelBuilder()
        corner = START - 0.5 * CELL * wp.vec3(float(CELLS[0]), float(CELLS[1]), 0.0)
        cloth = {"dim_x": CELLS[0], "dim_y": CELLS[1], "cell_x": CELL, "cell_y": CELL, "mass": 0.002, "vel": wp.vec3()}
        cloth |= {"tri_ke": 100.0, "tri_ka": 100.0, "tri_kd": 1.0e-3, "edge_ke": 1.0e-2, "edge_kd": 1.0e-4}
        world.add_cloth_grid(pos=corner, rot=wp.quat_identity(), **cloth)
        along_y = wp.transform(wp.vec3(), wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.5 * wp.pi))
        material = newton.ModelBuilder.ShapeConfig(mu=0.8)
        world.add_shape_capsule(-1, xform=along_y, radius=RADIUS, half_height=0.25, cfg=material)
        model = build_worlds(world, len(STARTS))
        model.particle_mu = 0.8
        self.start_solver(model, (wp.vec3(0.0, -1.6, 0.1), -5.0, 90.0))
        self.throws = wp.array(np.zeros_like(STARTS), dtype=wp.vec3, device=model.device, requires_grad=True)
        self.rest = world.particle_q - np.array(START)
        self.prepare_descent([self.throws], STEPS, targets=[hang(self.rest, 0.05 * CELL)] * LAST)
        self.search_from([STARTS], first=0.3, longest=0.6, method=FittedNewton)

    def forward(self):
        """Simulates the throws, and computes their losses."""
        inputs, outputs = [self.throws, self.model.particle_world], [self.states[0].particle_qd]
        wp.launch(throw, self.model.particle_count, inputs=inputs, outputs=outputs)
        super().forward()

    def let_hang(self):
        """Goes on for a second; returns where particles are then [m], shape [worlds, particles, 3]."""
        start, end = self.states[-1], self.model.state()
        for _ in range(STAYS):
            start.clear_forces()
            self.solver.step(start, end, self.control, None, self.sim_dt)
            start, end = end, start
        return start.particle_q.numpy().reshape(self.worlds, -1, 3)

    def test_final(self):
        """Checks that the towels come within six centimetres of hanging, and then stay on the bar."""
        super().test_final()
        if self.ccd:
            assert self.distance.max() < 0.06, self.distance
            ends = self.let_hang()[:, self.rest[:, 0] ** 2 > (0.49 * CELLS[0] * CELL) ** 2]
            assert (ends[..., 2] < -RADIUS).all(), ends
            assert self.solver.report.totals.uncertified_steps == 0, self.solver.report


if __name__ == "__main__":
    main(Example)
