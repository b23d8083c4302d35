"""Example FEM Press: two soft blocks on top of each other are pressed to half their height, and recover.

    python examples/example_fem_press.py
    python examples/example_fem_press.py --no-ccd  # the plates pass through the blocks, which fall

The plates are kinematic rigid bodies, the blocks tetrahedra of foam rubber. Nothing but the collision stage holds the
blocks up, off the plates and off each other: the inner solver knows no contacts.
"""

import argparse

import newton
import newton.examples
import numpy as np
import warp as wp
from common import main

import warp_bsc as bsc

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
    """From 0 to 1, without a jump of the velocity."""
    t = wp.clamp(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@wp.kernel
def move_plates(dt: float, time: wp.array[float], body_q: wp.array[wp.transform]):
    """Writes where the plates are at the end of the step: they close, hold, and open again."""
    t = time[0] + dt
    time[0] = t
    closed = ease(t / CLOSING_TIME) - ease((t - CLOSING_TIME - HOLDING_TIME) / CLOSING_TIME)
    way = 0.5 * closed * (OPENING - 0.5 * HEIGHT)
    body_q[0] = wp.transform(wp.vec3(0.0, 0.0, way - THICKNESS), wp.quat_identity())
    body_q[1] = wp.transform(wp.vec3(0.0, 0.0, OPENING - way + THICKNESS), wp.quat_identity())


class Example:
    """The scene, in the format of Newton's examples."""

    def __init__(self, viewer, args):
        self.viewer = viewer
        self.ccd = args.ccd
        self.fps = 60
        self.frame_dt = 1.0 / self.fps
        # Even, so that a CUDA graph ends with the states that it began with. And many: the stage sets contacts right
        # only after the inner solver, so that a step should not be longer than sound takes through a cell.
        self.sim_substeps = 8
        self.sim_dt = self.frame_dt / self.sim_substeps
        self.sim_time = 0.0

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
        self.model = builder.finalize()

        # The solver leaves rigid bodies to others, so that both states keep the poses that they are given.
        self.solver = newton.solvers.SolverVBD(
            self.model, iterations=10, particle_enable_self_contact=False, integrate_with_external_rigid_solver=True
        )
        if self.ccd:
            self.solver = bsc.SolverCCD(self.solver)
        self.state_0, self.state_1 = self.model.state(), self.model.state()
        self.control = self.model.control()
        self.time = wp.zeros(1, dtype=float)  # on the device, so that a CUDA graph finds it advanced
        self.lowest_height = self.height()

        self.viewer.set_model(self.model)
        self.viewer.set_camera(pos=wp.vec3(1.1, -1.1, 0.5), pitch=-12.0, yaw=135.0)
        self.capture()

    def capture(self):
        """Captures a frame on a GPU, after the plates have closed once to make the stage's queues large enough."""
        self.graph = None
        if not self.model.device.is_cuda:
            return
        for _ in range(round(self.fps * (CLOSING_TIME + HOLDING_TIME))):
            self.simulate()
        for state in (self.state_0, self.state_1):
            state.assign(self.model.state())
        self.time.zero_()
        with wp.ScopedCapture() as capture:
            self.simulate()
        self.graph = capture.graph

    def simulate(self):
        """Simulates a frame."""
        for _ in range(self.sim_substeps):
            self.state_0.clear_forces()
            self.viewer.apply_forces(self.state_0)
            wp.launch(move_plates, 1, inputs=[self.sim_dt], outputs=[self.time, self.state_1.body_q])
            self.solver.step(self.state_0, self.state_1, self.control, None, self.sim_dt)
            self.state_0, self.state_1 = self.state_1, self.state_0

    def step(self):
        """Simulates a frame, on a GPU from the graph."""
        if self.graph:
            wp.capture_launch(self.graph)
        else:
            self.simulate()
        self.sim_time += self.frame_dt
        self.lowest_height = min(self.lowest_height, self.height())

    def render(self):
        """Shows the frame."""
        self.viewer.begin_frame(self.sim_time)
        self.viewer.log_state(self.state_0)
        self.viewer.end_frame()

    def height(self):
        """From the lowest particle to the highest [m]."""
        z = self.state_0.particle_q.numpy()[:, 2]
        return float(z.max() - z.min())

    def volume_ratios(self):
        """Of the tetrahedra, now to at rest; negative where one is inverted."""

        def volumes(particle_q):
            corners = particle_q.numpy().astype(np.float64)[self.model.tet_indices.numpy()]
            return np.linalg.det(corners[:, 1:] - corners[:, :1])

        return volumes(self.state_0.particle_q) / volumes(self.model.particle_q)

    def test_final(self):
        """The blocks were pressed and recovered, and the stage kept its promise."""
        if self.ccd:
            report = self.solver.report
            assert report.uncertified_steps == 0, f"{report.uncertified_steps} steps are not certified"
            assert len(report.intersections) == 0, f"{len(report.intersections)} edges cross faces"
        # Both blocks between the plates can be no higher than the opening, so that lower means that they were in it.
        pressed, recovered = self.lowest_height / HEIGHT, self.height() / HEIGHT
        assert 0.48 < pressed <= 0.5, f"the blocks were pressed to {pressed:.1%} of their height"
        assert 0.95 <= recovered <= 1.0, f"the blocks are {recovered:.1%} as high as at rest"
        lower, upper = np.split(self.state_0.particle_q.numpy()[:, 2], 2)
        assert lower.min() > 0.0, "the lower block is not on the lower plate"
        assert upper.mean() - lower.mean() > 0.45 * HEIGHT, "the upper block is not on the lower one"
        inverted = int((self.volume_ratios() <= 0.0).sum())
        assert inverted == 0, f"{inverted} tetrahedra are inverted"

    def print_report(self):
        """Prints what the stage did, and what came of it."""
        if self.ccd:
            print(self.solver.report)
        print(
            f"pressed to {self.lowest_height / HEIGHT:.1%} of their height, recovered to {self.height() / HEIGHT:.1%}, "
            f"smallest tetrahedron at {self.volume_ratios().min():.1%} of its volume"
        )

    @staticmethod
    def create_parser():
        """The options."""
        parser = newton.examples.create_parser()
        parser.set_defaults(num_frames=180)
        parser.add_argument(
            "--ccd", action=argparse.BooleanOptionalAction, default=True, help="Put the collision stage behind it."
        )
        return parser


if __name__ == "__main__":
    main(Example)
