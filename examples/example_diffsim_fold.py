"""Example Diffsim Fold: finds the path of a gripper that folds a cloth in half.

    python examples/example_diffsim_fold.py

A gripper holds one side of a cloth that lies on the ground, and moves it along a cubic Bezier curve. Gradient descent
improves the three control points after the first, from three starts, each in a world of its own. The loss is the mean
squared distance of the particles at the end from a cloth whose one half lies on the other. Its gradient goes back
through the contacts of the cloth with the ground, with friction, and with itself, to the path in all steps, which are
those of ``SolverImplicit``.
"""

import copy
import functools
import itertools

import newton
import numpy as np
import warp as wp
from common import main
from diffsim import build_worlds
from diffsim_targets import TargetExample
from searches import FittedNewton

CELLS = 8
CELL = 0.05  # [m]
SIDE = CELLS * CELL
HEIGHT = 0.004  # of the cloth above the ground at the start, and of its folded half above the other [m]
# second to last control points of the first paths, relative to the first [m]
STARTS = [
    ((0.0, 0.0, 0.2), (-0.1, 0.0, 0.3), (-0.1, 0.0, 0.25)),
    ((0.0, 0.05, 0.1), (-0.2, 0.05, 0.2), (-0.25, 0.1, 0.1)),
    ((0.0, -0.05, 0.2), (-0.2, -0.05, 0.3), (-0.35, -0.05, 0.15)),
]
STEPS = 40
MOVES = 34  # steps in which the gripper moves


@wp.kernel
def move_gripper(
    # in
    particle_q: wp.array[wp.vec3],
    particle_inv_mass: wp.array[float],
    particle_world: wp.array[int],
    rest: wp.array[wp.vec3],
    points_1: wp.array[wp.vec3],
    points_2: wp.array[wp.vec3],
    points_3: wp.array[wp.vec3],
    share: float,
    # out
    moved: wp.array[wp.vec3],
):
    """Copies positions; those of particles that the gripper holds are on its path after a share of the time."""
    particle = wp.tid()
    if particle_inv_mass[particle] > 0.0:
        moved[particle] = particle_q[particle]
    else:
        world = particle_world[particle]
        s = share * share * (3.0 - 2.0 * share)
        path = 3.0 * (1.0 - s) * s * ((1.0 - s) * points_1[world] + s * points_2[world]) + s * s * s * points_3[world]
        up = wp.max(path[2], 0.0)  # not into the ground
        moved[particle] = rest[particle] + wp.vec3(path[0], path[1], up)


class Example(TargetExample):
    """The scene, in the format of Newton's examples; a frame is an iteration of the optimisation."""

    num_frames = 8

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        world = newton.ModelBuilder()
        material = newton.ModelBuilder.ShapeConfig(mu=0.6)
        world.add_ground_plane(cfg=material)
        cloth = {"dim_x": CELLS, "dim_y": CELLS, "cell_x": CELL, "cell_y": CELL, "mass": 0.001, "vel": wp.vec3()}
        cloth |= {"tri_ke": 100.0, "tri_ka": 100.0, "tri_kd": 1.0e-3, "edge_ke": 2.0e-3, "edge_kd": 1.0e-4}
        corner = wp.vec3(-0.5 * SIDE, -0.5 * SIDE, HEIGHT)
        world.add_cloth_grid(pos=corner, rot=wp.quat_identity(), fix_right=True, **cloth)
        model = build_worlds(world, len(STARTS))
        model.particle_mu = 0.6
        starts = np.array(STARTS).transpose(1, 0, 2)
        points = [wp.array(p, dtype=wp.vec3, device=model.device, requires_grad=True) for p in starts]
        rest = np.array(world.particle_q)
        folded = np.where(rest[:, :1] > 0.0, rest * [-1.0, 1.0, 1.0] + [0.0, 0.0, HEIGHT], rest)
        self.start_solver(model, (wp.vec3(0.0, -1.2, 0.4), -15.0, 90.0))
        self.prepare_descent(points, STEPS, targets=[folded])
        self.search_from(starts, first=0.1, longest=0.2, method=functools.partial(FittedNewton, off=0.3))

    def forward(self):
        """Simulates the folds, and computes their losses."""
        for step, (start, end) in enumerate(itertools.pairwise(self.states)):
            self.solver.step(self.move_grippers(start, step), end, self.control, None, self.sim_dt)
        self.loss.zero_()
        self.add_losses()

    def move_grippers(self, state, step):
        """Returns a state in which the grippers are where a step is to bring them."""
        model, moved = self.model, copy.copy(state)
        moved.particle_q = wp.empty_like(state.particle_q)
        inputs = [state.particle_q, model.particle_inv_mass, model.particle_world, model.particle_q, *self.parameters]
        inputs.append(min((step + 1) / MOVES, 1.0))
        wp.launch(move_gripper, model.particle_count, inputs=inputs, outputs=[moved.particle_q])
        return moved

    def test_final(self):
        """Checks that the cloths are folded to within two centimetres, and that no gripper went into the ground."""
        super().test_final()
        if self.ccd:
            assert self.distance.max() < 0.02, self.distance
            assert self.motion[..., 2].min() > 0.0, self.motion[..., 2].min()


if __name__ == "__main__":
    main(Example)
