"""Example Diffsim Push: finds the path of a paddle that lifts and pushes a cloth so that it ends on a mark.

    python examples/example_diffsim_push.py
    python examples/example_diffsim_push.py --no-ccd  # the paddle passes through the cloth, and the gradient is zero

Gradient descent improves three paths, each in a world of its own: how far the paddle goes, and how far it turns. The
gradient of the loss goes back through the flight of the cloth and its contacts with the paddle, with friction and
restitution, to the poses of the paddle in all steps.
"""

import newton
import numpy as np
import warp as wp
from common import main
from diffsim import MarkExample, add_cloth, build_worlds
from newton.solvers import SolverSemiImplicit

MARK = wp.vec3(0.15, 0.08, 0.25)  # [m]
# first paths: how far the paddle goes [m], and how far it turns, as axis times angle [rad]
STARTS = [
    ((0.0, 0.0, 0.2), (0.0, 0.0, 0.0)),
    ((0.05, -0.05, 0.3), (-0.3, 0.2, 0.0)),
    ((-0.05, 0.05, 0.15), (0.3, 0.3, 0.2)),
]
FALL = wp.vec3(0.0, 0.0, -0.3)  # velocity of the cloth at the start [m/s]
STEPS = 60
FIRST_RATE = 0.05  # learning rate of the first iteration [m, rad]


@wp.kernel
def swing(shifts: wp.array[wp.vec3], turns: wp.array[wp.vec3], share: float, body_q: wp.array[wp.transform]):
    """Places each paddle on its path, after a share of the time, in which it accelerates from rest."""
    paddle = wp.tid()
    way = share * share
    half = 0.5 * way * turns[paddle]
    body_q[paddle] = wp.transform(way * shifts[paddle], wp.normalize(wp.quat(half, 1.0)))


class PaddleSolver(SolverSemiImplicit):
    """Moves the paddles, which are all bodies, along their paths.

    The solver itself leaves kinematic bodies where they are. It writes them elsewhere: an array that is written twice
    in a step would get the gradients of both.
    """

    def __init__(self, model, shifts, turns, time):
        super().__init__(model, enable_tri_contact=False)
        self.shifts, self.turns, self.time, self.elapsed = shifts, turns, time, 0.0
        self.unmoved = model.state()

    def step(self, state_in, state_out, control, contacts, dt):
        """Steps the cloth, and moves the paddles."""
        self.unmoved.particle_q, self.unmoved.particle_qd = state_out.particle_q, state_out.particle_qd
        super().step(state_in, self.unmoved, control, contacts, dt)
        self.elapsed += dt
        inputs, outputs = [self.shifts, self.turns, self.elapsed / self.time], [state_out.body_q]
        wp.launch(swing, len(self.shifts), inputs=inputs, outputs=outputs, device=self.model.device)


class Example(MarkExample):
    """The scene, in the format of Newton's examples; a frame is an iteration of the optimisation."""

    num_frames = 40

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        world = newton.ModelBuilder()
        add_cloth(world, 3, 0.04, wp.vec3(0.01, -0.01, 0.025), wp.vec3(1.0, 0.6, 0.0), 0.2, vel=FALL)
        paddle = world.add_body(is_kinematic=True)
        world.add_shape_box(paddle, hx=0.15, hy=0.15, hz=0.005, cfg=newton.ModelBuilder.ShapeConfig(mu=0.6))
        model = build_worlds(world, len(STARTS))
        model.soft_contact_restitution = 0.0
        model.particle_mu = 0.6
        starts = zip(*STARTS, strict=True)
        paths = [wp.array(start, dtype=wp.vec3, device=model.device, requires_grad=True) for start in starts]
        self.paddles = PaddleSolver(model, *paths, STEPS * self.sim_dt)
        self.start(model, self.paddles, (wp.vec3(0.2, -1.8, 0.4), -5.0, 90.0))
        self.prepare_descent(paths, FIRST_RATE, STEPS, cloth_count=world.particle_count, mark=MARK)

    def forward(self):
        """Simulates the pushes, and computes their losses."""
        self.paddles.elapsed = 0.0
        super().forward()

    def test_final(self):
        """Checks that all cloths end within two centimetres of the mark; without the stage, that paths are the same."""
        super().test_final()
        if not self.ccd:
            changes = np.stack([array.numpy() for array in self.parameters], axis=1) - STARTS
            assert np.abs(changes).max() < 1e-6, changes
            assert self.distance.min() > 0.2, self.distance


if __name__ == "__main__":
    main(Example)
