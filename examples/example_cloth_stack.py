"""Example Cloth Stack: eight sheets fall on a sphere, on each other and on the ground, where they should rest.

    python examples/example_cloth_stack.py
    python examples/example_cloth_stack.py --no-ccd  # the sheets fall through everything

Nothing but the collision stage holds the sheets up and apart: the inner solver knows no contacts. At the end all
of them lie on each other, at rest.
"""

import argparse

import newton
import newton.examples
import numpy as np
import warp as wp
from common import main

import warp_bsc as bsc

SHEETS = 8
CELLS = 16
SIZE = 0.8  # m, of a sheet
RADIUS = 0.2  # m, of the sphere, half of which is in the ground
DENSITY = 0.3  # kg/m^2


class Example:
    """The scene, in the format of Newton's examples."""

    def __init__(self, viewer, args):
        self.viewer = viewer
        self.ccd = args.ccd
        self.fps = 60
        self.frame_dt = 1.0 / self.fps
        self.sim_substeps = 4  # even, so that a CUDA graph ends with the states that it began with
        self.sim_dt = self.frame_dt / self.sim_substeps
        self.sim_time = 0.0

        builder = newton.ModelBuilder()
        builder.add_ground_plane()
        builder.add_shape_sphere(body=-1, radius=RADIUS)
        cell = SIZE / CELLS
        rng = np.random.default_rng(1)
        for sheet in range(SHEETS):
            rotation = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), rng.uniform(0.0, 0.5 * np.pi))
            centre = wp.vec3(*rng.uniform(-0.03, 0.03, size=2), RADIUS + 0.05 * (sheet + 1))
            builder.add_cloth_grid(
                pos=centre - wp.quat_rotate(rotation, wp.vec3(0.5 * SIZE, 0.5 * SIZE, 0.0)),
                rot=rotation,
                vel=wp.vec3(),
                dim_x=CELLS,
                dim_y=CELLS,
                cell_x=cell,
                cell_y=cell,
                mass=DENSITY * cell**2,
                tri_ke=1.0e3,
                tri_ka=1.0e3,
                tri_kd=1.0e1,
                edge_ke=1.0e-3,
                edge_kd=1.0e-3,
                particle_radius=0.002,
            )
        builder.color()
        self.model = builder.finalize()

        self.solver = newton.solvers.SolverVBD(self.model, iterations=10, particle_enable_self_contact=False)
        if self.ccd:
            self.solver = bsc.SolverCCD(self.solver)
        self.state_0, self.state_1 = self.model.state(), self.model.state()
        self.control = self.model.control()

        self.viewer.set_model(self.model)
        self.viewer.set_camera(pos=wp.vec3(1.1, -1.1, 0.7), pitch=-22.0, yaw=135.0)
        self.capture()

    def capture(self):
        """Captures a frame on a GPU, after the fall has been simulated to make the stage's queues large enough."""
        self.graph = None
        if not self.model.device.is_cuda:
            return
        for _ in range(self.fps):
            self.simulate()
        for state in (self.state_0, self.state_1):
            state.assign(self.model.state())
        with wp.ScopedCapture() as capture:
            self.simulate()
        self.graph = capture.graph

    def simulate(self):
        """Simulates a frame."""
        for _ in range(self.sim_substeps):
            self.state_0.clear_forces()
            self.viewer.apply_forces(self.state_0)
            self.solver.step(self.state_0, self.state_1, self.control, None, self.sim_dt)
            self.state_0, self.state_1 = self.state_1, self.state_0

    def step(self):
        """Simulates a frame, on a GPU from the graph."""
        if self.graph:
            wp.capture_launch(self.graph)
        else:
            self.simulate()
        self.sim_time += self.frame_dt

    def render(self):
        """Shows the frame."""
        self.viewer.begin_frame(self.sim_time)
        self.viewer.log_state(self.state_0)
        self.viewer.end_frame()

    def speed(self):
        """Mean speed of the particles [m/s]."""
        return float(np.linalg.norm(self.state_0.particle_qd.numpy(), axis=1).mean())

    def heights(self):
        """Heights of the particles [m], shape [SHEETS, CELLS + 1, CELLS + 1]."""
        return self.state_0.particle_q.numpy()[:, 2].reshape(SHEETS, CELLS + 1, CELLS + 1)

    def test_final(self):
        """The sheets lie at rest on what is below them, and the stage kept its promise."""
        if self.ccd:
            report = self.solver.report
            assert report.uncertified_steps == 0, f"{report.uncertified_steps} steps are not certified"
            assert len(report.intersections) == 0, f"{len(report.intersections)} edges cross faces"
        assert self.speed() < 0.02, f"the particles still move with {self.speed():.3f} m/s"
        z = self.heights()
        assert z.min() > 0.0, "a particle is under the ground"
        # A sheet at rest is on the sphere in the middle, on the ground all around, and not far from the one below.
        tops = z.max(axis=(1, 2))
        assert (tops > 0.95 * RADIUS).all(), f"a sheet is under the top of the sphere, at heights of {tops} m"
        assert (np.diff(np.sort(tops), prepend=RADIUS) < 0.01).all(), f"a sheet is in the air, at heights of {tops} m"
        lowest = z.min(axis=(1, 2))
        assert (lowest < 0.01).all(), f"the border of a sheet is in the air, at heights of {lowest} m"

    def print_report(self):
        """Prints what the stage did, and what came of it."""
        if self.ccd:
            print(self.solver.report)
        print(f"mean speed {self.speed():.4f} m/s, tops of the sheets {self.heights().max(axis=(1, 2)).round(4)} m")

    @staticmethod
    def create_parser():
        """The options."""
        parser = newton.examples.create_parser()
        parser.set_defaults(num_frames=300)
        parser.add_argument(
            "--ccd", action=argparse.BooleanOptionalAction, default=True, help="Put the collision stage behind it."
        )
        return parser


if __name__ == "__main__":
    main(Example)
