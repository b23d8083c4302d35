"""Example FEM Press: two soft blocks on top of each other are pressed to half their height, and recover.

    python examples/example_fem_press.py
    python examples/example_fem_press.py --no-ccd  # the plates pass through the blocks, which fall

The plates are kinematic rigid bodies, the blocks are tetrahedra of foam rubber. Only the collision stage keeps the
blocks apart from the plates and from each other: the inner solver has no contacts.
"""

import newton
import newton.examples
import numpy as np
import warp as wp
from common import ExampleBase, main

CELLS = 6, 6, 4  # of a block
CELL = 0.05  # m
HEIGHT = 2 * CELLS[2] * CELL  # m, of both blocks
GAP = 0.002  # m, between blocks and plates at the start
PLATE = 0.3  # m, half the width of a plate
THICKNESS = 0.02  # m, half of it
OPENING = HEIGHT + 3 * GAP  # m, between the plates at the start
CLOSING_TIME, HOLDING_TIME = 1.0, 0.5  # s


@wp.func
def ease(t: float) -> float:
    """Returns a ramp from 0 to 1 without a jump of the velocity."""
    t = wp.clamp(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@wp.kernel
def move_plates(dt: float, time: wp.array[float], body_q: wp.array[wp.transform]):
    """Writes the poses of the plates at the end of the step: they close, hold, and open again."""
    t = time[0] + dt
    time[0] = t
    closed = ease(t / CLOSING_TIME) - ease((t - CLOSING_TIME - HOLDING_TIME) / CLOSING_TIME)
    way = 0.5 * closed * (OPENING - 0.5 * HEIGHT)
    body_q[0] = wp.transform(wp.vec3(0.0, 0.0, way - THICKNESS), wp.quat_identity())
    body_q[1] = wp.transform(wp.vec3(0.0, 0.0, OPENING - way + THICKNESS), wp.quat_identity())


class Example(ExampleBase):
    """The scene, in the format of Newton's examples."""

    num_frames = 180
    # The stage resolves contacts after the inner solver, so that a step should not be longer than sound takes through
    # a cell.
    sim_substeps = 8

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        builder = newton.ModelBuilder()
        for z in (-THICKNESS, OPENING + THICKNESS):
            plate = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, z), wp.quat_identity()), is_kinematic=True)
            builder.add_shape_box(plate, hx=PLATE, hy=PLATE, hz=THICKNESS)
        for z in (GAP, 0.5 * HEIGHT + 2 * GAP):
            builder.add_soft_grid(
                pos=wp.vec3(-0.5 * CELLS[0] * CELL, -0.5 * CELLS[1] * CELL, z),
                rot=wp.quat_identity(),
                vel=wp.vec3(),
                dim_x=CELLS[0],
                dim_y=CELLS[1],
                dim_z=CELLS[2],
                cell_x=CELL,
                cell_y=CELL,
                cell_z=CELL,
                density=100.0,
                k_mu=1.0e4,
                k_lambda=1.0e4,
                k_damp=20.0,
                particle_radius=0.002,
            )
        builder.color()
        model = builder.finalize()

        # The solver does not move rigid bodies: both states keep the poses that move_plates writes.
        solver = newton.solvers.SolverVBD(
            model, iterations=10, particle_enable_self_contact=False, integrate_with_external_rigid_solver=True
        )
        self.time = wp.zeros(1, dtype=float)  # on the device, so that a CUDA graph finds it advanced
        self.start(model, solver, camera=(wp.vec3(1.1, -1.1, 0.5), -12.0, 135.0))
        self.lowest_height = self.height()

    def simulate(self):
        """Simulates a frame."""
        for _ in range(self.sim_substeps):
            self.state_0.clear_forces()
            self.viewer.apply_forces(self.state_0)
            wp.launch(move_plates, 1, inputs=[self.sim_dt], outputs=[self.time, self.state_1.body_q])
            self.solver.step(self.state_0, self.state_1, self.control, None, self.sim_dt)
            self.state_0, self.state_1 = self.state_1, self.state_0

    def step(self):
        """Simulates a frame, and notes how high the blocks are."""
        super().step()
        self.lowest_height = min(self.lowest_height, self.height())

    def height(self):
        """Returns the distance from the lowest particle to the highest along z [m]."""
        z = self.state_0.particle_q.numpy()[:, 2]
        return float(z.max() - z.min())

    def volume_ratios(self):
        """Returns the volume of each tetrahedron over that at rest; negative where it is inverted."""

        def volumes(particle_q):
            corners = particle_q.numpy().astype(np.float64)[self.model.tet_indices.numpy()]
            return np.linalg.det(corners[:, 1:] - corners[:, :1])

        return volumes(self.state_0.particle_q) / volumes(self.model.particle_q)

    def test_final(self):
        """Checks that all steps are certified, and that the blocks were pressed and recovered."""
        super().test_final()
        # Blocks between the plates are no higher than the opening, so that a small height shows that they stayed there.
        pressed, recovered = self.lowest_height / HEIGHT, self.height() / HEIGHT
        assert 0.48 < pressed <= 0.5, f"the blocks were pressed to {pressed:.1%} of their height"
        assert 0.95 <= recovered <= 1.0, f"the blocks are {recovered:.1%} as high as at rest"
        lower, upper = np.split(self.state_0.particle_q.numpy()[:, 2], 2)
        assert lower.min() > 0.0, "the lower block is not on the lower plate"
        assert upper.mean() - lower.mean() > 0.45 * HEIGHT, "the upper block is not on the lower one"
        inverted = int((self.volume_ratios() <= 0.0).sum())
        assert inverted == 0, f"{inverted} tetrahedra are inverted"

    def print_report(self):
        """Prints what the stage did, and the heights of the blocks."""
        super().print_report()
        print(
            f"pressed to {self.lowest_height / HEIGHT:.1%} of their height, recovered to {self.height() / HEIGHT:.1%}, "
            f"smallest tetrahedron at {self.volume_ratios().min():.1%} of its volume"
        )


if __name__ == "__main__":
    main(Example)
