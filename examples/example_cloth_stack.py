"""Example Cloth Stack: eight sheets fall on a sphere, on each other and on the ground, where they should rest.

    python examples/example_cloth_stack.py
    python examples/example_cloth_stack.py --no-ccd  # the sheets fall through everything

Only the collision stage holds the sheets up and apart: the inner solver has no contacts. At the end all of them lie
on each other, at rest.
"""

import newton
import newton.examples
import numpy as np
import warp as wp
from common import ExampleBase, main

SHEETS = 8
CELLS = 16
SIZE = 0.8  # m, of a sheet
RADIUS = 0.2  # m, of the sphere, whose lower half is in the ground
DENSITY = 0.3  # kg/m^2


class Example(ExampleBase):
    """The scene, in the format of Newton's examples."""

    num_frames = 300

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
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
        model = builder.finalize()

        solver = newton.solvers.SolverVBD(model, iterations=10, particle_enable_self_contact=False)
        self.start(model, solver, camera=(wp.vec3(1.1, -1.1, 0.7), -22.0, 135.0))

    def speed(self):
        """Returns the mean speed of the particles [m/s]."""
        return float(np.linalg.norm(self.state_0.particle_qd.numpy(), axis=1).mean())

    def heights(self):
        """Returns the heights of the particles [m], shape [SHEETS, CELLS + 1, CELLS + 1]."""
        return self.state_0.particle_q.numpy()[:, 2].reshape(SHEETS, CELLS + 1, CELLS + 1)

    def test_final(self):
        """Checks that all steps are certified, and that the sheets lie at rest on each other and on the sphere."""
        super().test_final()
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
        """Prints what the stage did, and how the sheets lie."""
        super().print_report()
        print(f"mean speed {self.speed():.4f} m/s, tops of the sheets {self.heights().max(axis=(1, 2)).round(4)} m")


if __name__ == "__main__":
    main(Example)
