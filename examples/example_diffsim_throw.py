"""Example Diffsim Throw: finds the throw for which a soft cube bounces off a thin tilted sheet onto a mark.

    python examples/example_diffsim_throw.py
    python examples/example_diffsim_throw.py --no-ccd  # the cube flies through the sheet, and the loss is flat

A search by gradients improves three throws, each in a world of its own. The gradient of the loss goes back through the
flight, the bounce off the sheet, with friction, and the throw, in steps of ``SolverImplicit``. The cube bounces as it
is elastic; steps of 1/240 s are short enough for that. The sheet has no thickness, and the cube flies two centimetres a
step. Without contacts it flies through the sheet, and ends far from the mark, where the loss is flat.
"""

import newton
import warp as wp
from common import main
from diffsim import MarkExample, add_cloth, add_cube, build_worlds

MARK = wp.vec3(-0.45, 0.15, -0.05)  # [m]
STARTS = [(3.8, 0.0, 0.8), (3.3, 0.6, 2.2), (3.6, -0.2, 2.1)]  # first throws [m/s]
STEPS = 144


@wp.kernel
def throw(
    throws: wp.array[wp.vec3], shares: wp.array[float], particle_world: wp.array[int], particle_qd: wp.array[wp.vec3]
):
    """Sets the velocity of the particles of the thrown cube to the throw of their world."""
    particle = wp.tid()
    velocity = wp.vec3()
    if shares[particle] > 0.0:
        velocity = throws[particle_world[particle]]
    particle_qd[particle] = velocity


class Example(MarkExample):
    """The scene, in the format of Newton's examples; a frame is an evaluation of the loss and its gradient."""

    num_frames = 12

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        self.sim_dt = 1.0 / 240.0
        world = newton.ModelBuilder()
        add_cube(world, 2, 0.06, wp.vec3(-0.9, 0.0, 0.1), wp.vec3(0.2, 1.0, 0.1), -0.6, stiffness=1.0e4)
        count = world.particle_count
        fixed = dict.fromkeys(["fix_left", "fix_right", "fix_top", "fix_bottom"], True)
        # a sheet of two triangles; the cube meets one of them
        add_cloth(world, 1, 1.4, wp.vec3(0.0, -0.35, 0.0), wp.vec3(0.0, 1.0, 0.0), -1.05, **fixed)
        model = build_worlds(world, len(STARTS))
        model.particle_mu = 0.3
        self.start_solver(model, (wp.vec3(-0.3, -3.2, 0.5), -5.0, 90.0))
        self.throws = wp.array(STARTS, dtype=wp.vec3, device=model.device, requires_grad=True)
        self.prepare_descent([self.throws], STEPS, count=count, mark=MARK)
        self.search_from([STARTS], first=0.3, longest=1.0)

    def forward(self):
        """Simulates the throws, and computes their losses."""
        inputs, outputs = [self.throws, self.shares, self.model.particle_world], [self.states[0].particle_qd]
        wp.launch(throw, self.model.particle_count, inputs=inputs, outputs=outputs)
        super().forward()

    def test_final(self):
        """Checks that all cubes end on the mark; without contacts, that no throw is better than the first."""
        super().test_final()
        if not self.ccd:
            assert (self.best() == STARTS).all(), self.best()
            assert self.distance.min() > 1.0, self.distance


if __name__ == "__main__":
    main(Example)
