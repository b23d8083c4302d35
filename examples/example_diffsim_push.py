"""Example Diffsim Push: finds the path of a paddle that lifts and pushes a cloth so that it ends on a mark.

    python examples/example_diffsim_push.py
    python examples/example_diffsim_push.py --no-ccd  # the paddle passes through the cloth, and the gradient is zero

A search by gradients improves three paths, each in a world of its own: how far the paddle goes, and how far it turns.
The gradient of the loss goes back through the fall of the cloth onto the paddle and its contacts with it, with
friction, to the poses of the paddle in all steps, which are those of ``SolverImplicit``. Without contacts the cloth
falls through the paddle, whatever its path.
"""

import copy
import itertools

import newton
import numpy as np
import warp as wp
from common import main
from diffsim import MarkExample, add_cloth, build_worlds

MARK = wp.vec3(0.15, 0.08, 0.25)  # [m]
# first paths: how far the paddle goes [m], and how far it turns, as axis times angle [rad]
STARTS = [
    ((0.0, 0.0, 0.2), (0.0, 0.0, 0.0)),
    ((0.05, -0.05, 0.3), (-0.3, 0.2, 0.0)),
    ((-0.05, 0.05, 0.15), (0.3, 0.3, 0.2)),
]
FALL = wp.vec3(0.0, 0.0, -0.3)  # velocity of the cloth at the start [m/s]
STEPS = 24


@wp.kernel
def swing(shifts: wp.array[wp.vec3], turns: wp.array[wp.vec3], share: float, body_q: wp.array[wp.transform]):
    """Places each paddle on its path, after a share of the time, in which it accelerates from rest."""
    paddle = wp.tid()
    way = share * share
    half = 0.5 * way * turns[paddle]
    body_q[paddle] = wp.transform(way * shifts[paddle], wp.normalize(wp.quat(half, 1.0)))


class Example(MarkExample):
    """The scene, in the format of Newton's examples; a frame is an evaluation of the loss and its gradient."""

    num_frames = 10

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        self.sim_dt = 1.0 / 240.0
        world = newton.ModelBuilder()
        add_cloth(world, 3, 0.04, wp.vec3(0.01, -0.01, 0.025), wp.vec3(1.0, 0.6, 0.0), 0.2, vel=FALL)
        paddle = world.add_body(is_kinematic=True)
        world.add_shape_box(paddle, hx=0.15, hy=0.15, hz=0.005, cfg=newton.ModelBuilder.ShapeConfig(mu=0.6))
        model = build_worlds(world, len(STARTS))
        model.particle_mu = 0.6
        self.start_solver(model, (wp.vec3(0.2, -1.8, 0.4), -5.0, 90.0))
        starts = np.array(STARTS).transpose(1, 0, 2)
        paths = [wp.array(start, dtype=wp.vec3, device=model.device, requires_grad=True) for start in starts]
        self.prepare_descent(paths, STEPS, count=world.particle_count, mark=MARK)
        self.search_from(starts, first=0.1, longest=0.3)

    def forward(self):
        """Simulates the pushes, and computes their losses."""
        for step, (start, end) in enumerate(itertools.pairwise(self.states)):
            self.solver.step(self.move_paddles(start, step), end, self.control, None, self.sim_dt)
        self.loss.zero_()
        self.add_losses()

    def move_paddles(self, state, step):
        """Returns a state in which the paddles, which are all bodies, are where a step is to bring them."""
        moved = copy.copy(state)
        moved.body_q = wp.empty_like(state.body_q)
        wp.launch(swing, self.worlds, inputs=[*self.parameters, (step + 1) / STEPS], outputs=[moved.body_q])
        return moved

    def test_final(self):
        """Checks that all cloths end on the mark; without contacts, that no path is better than the first."""
        super().test_final()
        if not self.ccd:
            assert (self.best() == np.reshape(STARTS, (len(STARTS), -1))).all(), self.best()
            assert self.distance.min() > 0.2, self.distance


if __name__ == "__main__":
    main(Example)
