"""Example Cloth Bullet: a patch of cloth is shot at a sheet, a quarter of a metre a step, and is stopped by it.

    python examples/example_cloth_bullet.py
    python examples/example_cloth_bullet.py --no-ccd  # the patch passes through the sheet

Between two steps the patch is before the sheet and behind it, so that only continuous collision detection sees the
sheet in its way.
"""

import argparse

import newton
import newton.examples
import numpy as np
import warp as wp
from common import main

import warp_bsc as bsc

SHEET_CELLS = 40
PATCH_CELLS = 20


class Example:
    """The scene, in the format of Newton's examples."""

    def __init__(self, viewer, args):
        self.viewer = viewer
        self.ccd = args.ccd
        self.xpbd = args.solver == "xpbd"
        self.fps = 60
        self.frame_dt = 1.0 / self.fps
        self.sim_substeps = 4  # even, so that a CUDA graph ends with the states that it began with
        self.sim_dt = self.frame_dt / self.sim_substeps
        self.sim_time = 0.0

        builder = newton.ModelBuilder()
        fixed = {"fix_left": True, "fix_right": True, "fix_top": True, "fix_bottom": True}
        self.add_cloth(builder, SHEET_CELLS, 0.025, wp.vec3(-0.5, -0.5, 0.0), wp.vec3(), **fixed)
        self.sheet_particles, self.sheet_triangles = builder.particle_count, builder.tri_count
        self.add_cloth(builder, PATCH_CELLS, 0.0123, wp.vec3(-0.13, -0.11, 0.3), wp.vec3(0.0, 0.0, -args.speed))
        builder.color()
        self.model = builder.finalize()

        if self.xpbd:
            self.solver = newton.solvers.SolverXPBD(self.model, iterations=10)
        else:
            self.solver = newton.solvers.SolverVBD(self.model, iterations=10, particle_enable_self_contact=False)
        if self.ccd:
            self.solver = bsc.SolverCCD(self.solver)
        self.state_0, self.state_1 = self.model.state(), self.model.state()
        self.control = self.model.control()

        self.viewer.set_model(self.model)
        self.viewer.set_camera(pos=wp.vec3(1.6, -1.6, 0.6), pitch=-15.0, yaw=135.0)
        self.capture()

    def add_cloth(self, builder, cells, cell, pos, vel, **fixed):
        """Adds a square of cloth that has so many cells a side, of so many metres."""
        mass = 0.3 * cell**2  # of a particle, at 0.3 kg/m^2
        builder.add_cloth_grid(
            pos=pos,
            rot=wp.quat_identity(),
            vel=vel,
            dim_x=cells,
            dim_y=cells,
            cell_x=cell,
            cell_y=cell,
            mass=mass,
            tri_ke=1.0e4,
            tri_ka=1.0e4,
            tri_kd=1.0e-1,
            edge_ke=1.0e-3,
            edge_kd=1.0e-4,
            # Of XPBD, which knows no triangles; it solves all springs at once, which diverges where they are stiffer.
            add_springs=self.xpbd,
            spring_ke=0.1 * mass / self.sim_dt**2,
            spring_kd=0.0,
            particle_radius=0.002,
            **fixed,
        )

    def capture(self):
        """Captures a frame on a GPU, after the impact has been simulated to make the stage's queues large enough."""
        self.graph = None
        if not self.model.device.is_cuda:
            return
        for _ in range(self.fps // 4):
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

    def count_passed(self):
        """How many particles of the patch are behind the sheet.

        The sheet, with walls that rise from its pinned border, bounds what is before it. A ray upwards does not meet
        the walls, so it is enough to count the triangles above a particle: odd is behind, where the particle is
        between the walls. Where it is not, it came past the walls from above or through a bulge of the sheet.
        """
        q = self.state_0.particle_q.numpy().astype(np.float64)
        a, b, c = np.moveaxis(q[self.model.tri_indices.numpy()[: self.sheet_triangles]], 1, 0)
        p = q[self.sheet_particles :, None]

        def area(d, e, f):
            return (e[..., 0] - d[..., 0]) * (f[..., 1] - d[..., 1]) - (e[..., 1] - d[..., 1]) * (f[..., 0] - d[..., 0])

        with np.errstate(divide="ignore", invalid="ignore"):
            u, v, w = (area(*corners) / area(a, b, c) for corners in ((p, b, c), (a, p, c), (a, b, p)))
            above = u * a[:, 2] + v * b[:, 2] + w * c[:, 2] > p[..., 2]
            odd = ((u >= 0.0) & (v >= 0.0) & (w >= 0.0) & above).sum(axis=1) % 2 == 1
        between = np.abs(p[:, 0, :2]).max(axis=1) < 0.5
        return int(np.where(between, odd, ~odd & (p[:, 0, 2] < 0.0)).sum())

    def test_final(self):
        """The patch did not pass, and the stage kept its promise."""
        if self.ccd:
            report = self.solver.report
            assert report.uncertified_steps == 0, f"{report.uncertified_steps} steps are not certified"
            assert len(report.intersections) == 0, f"{len(report.intersections)} edges cross faces"
        passed = self.count_passed()
        assert passed == 0, f"{passed} particles of the patch passed through the sheet"

    def print_report(self):
        """Prints what the stage did."""
        if self.ccd:
            print(self.solver.report)
        print(f"{self.count_passed()} particles of the patch are behind the sheet")

    @staticmethod
    def create_parser():
        """The options."""
        parser = newton.examples.create_parser()
        parser.set_defaults(num_frames=60)
        parser.add_argument("--speed", type=float, default=60.0, help="Speed of the patch [m/s].")
        parser.add_argument("--solver", choices=["vbd", "xpbd"], default="vbd", help="Inner solver.")
        parser.add_argument(
            "--ccd", action=argparse.BooleanOptionalAction, default=True, help="Put the collision stage behind it."
        )
        return parser


if __name__ == "__main__":
    main(Example)
