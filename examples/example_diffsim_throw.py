"""Example Diffsim Throw: finds the throw for which a small cloth bounces off a thin tilted sheet onto a mark.

    python examples/example_diffsim_throw.py
    python examples/example_diffsim_throw.py --no-ccd  # the cloth flies through the sheet, and the gradient is zero

Gradient descent improves three throws, each in a world of its own. The gradient of the loss goes back through the
flight, the bounce off the sheet, with friction and restitution, and the throw. The cloth flies two centimetres a step,
so that without continuous collision detection it never meets the sheet. It then lands far from the mark, where the loss
is flat and its gradient zero.
"""

import newton
import numpy as np
import warp as wp
from common import main
from diffsim import MarkExample, add_cloth, build_worlds

MARK = wp.vec3(-0.55, 0.1, 0.75)  # [m]
STARTS = [(13.5, 0.0, -1.0), (9.5, 1.6, 1.0), (12.5, -1.2, 1.6)]  # first throws [m/s]
PATCH_CELLS = 4
STEPS = 160
FIRST_RATE = 0.3  # learning rate of the first iteration [m/s]


@wp.kernel
def throw(
    throws: wp.array[wp.vec3], shares: wp.array[float], particle_world: wp.array[int], particle_qd: wp.array[wp.vec3]
):
    """Sets the velocity of the particles of the thrown cloth to the throw of their world."""
    particle = wp.tid()
    velocity = wp.vec3()
    if shares[particle] > 0.0:
        velocity = throws[particle_world[particle]]
    particle_qd[particle] = velocity


class Example(MarkExample):
    """The scene, in the format of Newton's examples; a frame is an iteration of the optimisation."""

    num_frames = 60

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        world = newton.ModelBuilder()
        add_cloth(world, PATCH_CELLS, 0.03, wp.vec3(-0.9, 0.0, 0.1), wp.vec3(0.2, 1.0, 0.1), -1.35)
        patch = world.particle_count
        fixed = dict.fromkeys(["fix_left", "fix_right", "fix_top", "fix_bottom"], True)
        # a sheet of two triangles; the cloth meets one of them
        add_cloth(world, 1, 1.4, wp.vec3(0.0, -0.35, 0.0), wp.vec3(0.0, 1.0, 0.0), -1.05, **fixed)
        model = build_worlds(world, len(STARTS))
        model.soft_contact_restitution = 0.6
        model.particle_mu = 0.2
        solver = newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
        # no layer: the cloth flies farther in a step than a layer may be thick
        self.start(model, solver, (wp.vec3(-0.3, -3.2, 0.5), -5.0, 90.0), contact_layer=False)
        self.throws = wp.array(STARTS, dtype=wp.vec3, device=model.device, requires_grad=True)
        self.prepare_descent([self.throws], FIRST_RATE, STEPS, cloth_count=patch, mark=MARK)

    def forward(self):
        """Simulates the throws, and computes their losses."""
        inputs, outputs = [self.throws, self.shares, self.model.particle_world], [self.states[0].particle_qd]
        wp.launch(throw, self.model.particle_count, inputs=inputs, outputs=outputs)
        super().forward()

    def test_final(self):
        """Checks that all throws land within two centimetres of the mark; without the stage, that none has changed."""
        super().test_final()
        if not self.ccd:
            assert np.abs(self.throws.numpy() - STARTS).max() < 1e-3, self.throws
            assert self.distance.min() > 1.0, self.distance
            assert np.ptp(self.loss_history, axis=0).max() < 1e-6, self.loss_history


if __name__ == "__main__":
    main(Example)
