"""Example Cloth Bullet: a patch of cloth is shot at a sheet, a quarter of a metre a step, and is stopped by it.

    python examples/example_cloth_bullet.py
    python examples/example_cloth_bullet.py --no-ccd  # the patch passes through the sheet

Between two steps the patch is before the sheet and behind it, so that only continuous collision detection sees the
sheet in its way.
"""

import newton
import newton.examples
import numpy as np
import warp as wp
from common import ExampleBase, main

SHEET_CELLS = 40
PATCH_CELLS = 20


class Example(ExampleBase):
    """The scene, in the format of Newton's examples."""

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        self.xpbd = args.solver == "xpbd"

        builder = newton.ModelBuilder()
        fixed = {"fix_left": True, "fix_right": True, "fix_top": True, "fix_bottom": True}
        self.add_cloth(builder, SHEET_CELLS, 0.025, wp.vec3(-0.5, -0.5, 0.0), wp.vec3(), **fixed)
        self.sheet_particles, self.sheet_triangles = builder.particle_count, builder.tri_count
        self.add_cloth(builder, PATCH_CELLS, 0.0123, wp.vec3(-0.13, -0.11, 0.3), wp.vec3(0.0, 0.0, -args.speed))
        builder.color()
        model = builder.finalize()

        if self.xpbd:
            solver = newton.solvers.SolverXPBD(model, iterations=10)
        else:
            solver = newton.solvers.SolverVBD(model, iterations=10, particle_enable_self_contact=False)
        self.start(model, solver, camera=(wp.vec3(1.6, -1.6, 0.6), -15.0, 135.0))

    def add_cloth(self, builder, cells, cell, pos, vel, **fixed):
        """Adds a square of cloth with ``cells`` cells of width ``cell`` [m] along each side."""
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
            # For XPBD, which ignores triangles. It solves all springs at once, which diverges where they are stiffer.
            add_springs=self.xpbd,
            spring_ke=0.1 * mass / self.sim_dt**2,
            spring_kd=0.0,
            particle_radius=0.002,
            **fixed,
        )

    def count_passed(self):
        """Returns the number of particles of the patch that are behind the sheet.

        The sheet and walls that rise from its pinned border bound the space before it. A ray upwards does not meet
        the walls, so that the number of triangles above a particle decides: odd is behind, if the particle is
        between the walls. A particle outside them came past the walls from above or through a bulge of the sheet.
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
        """Checks that all steps are certified, and that the patch did not pass through the sheet."""
        super().test_final()
        passed = self.count_passed()
        assert passed == 0, f"{passed} particles of the patch passed through the sheet"

    def print_report(self):
        """Prints what the stage did, and how much of the patch passed."""
        super().print_report()
        print(f"{self.count_passed()} particles of the patch are behind the sheet")

    @classmethod
    def create_parser(cls):
        """Returns the options."""
        parser = super().create_parser()
        parser.add_argument("--speed", type=float, default=60.0, help="Speed of the patch [m/s].")
        parser.add_argument("--solver", choices=["vbd", "xpbd"], default="vbd", help="Inner solver.")
        return parser


if __name__ == "__main__":
    main(Example)
