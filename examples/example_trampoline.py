"""Example Trampoline: a ball and a box fall on a pinned sheet, are thrown back, caught, and come to rest on it.

    python examples/example_trampoline.py
    python examples/example_trampoline.py --no-ccd  # they fall through the sheet

Only the collision stage keeps the bodies apart from the sheet and from each other, and pushes them: the inner solver
has no contacts.
"""

import newton
import newton.examples
import numpy as np
import warp as wp
from common import ExampleBase, main

CELLS = 12
SIZE = 0.6  # m, of the sheet
DENSITY = 0.5  # kg/m^2
RADIUS, BALL_MASS = 0.06, 0.3  # m, kg
HALF, BOX_MASS = (0.06, 0.05, 0.04), 0.3  # m, half the lengths of the sides; kg
START = ((-0.09, 0.02, 0.2), (0.09, -0.02, 0.25))  # m, of ball and box


class Example(ExampleBase):
    """The scene, in the format of Newton's examples."""

    num_frames = 150
    sim_substeps = 2

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        builder = newton.ModelBuilder()
        cell = SIZE / CELLS
        builder.add_cloth_grid(
            pos=wp.vec3(-0.5 * SIZE, -0.5 * SIZE, 0.0),
            rot=wp.quat_identity(),
            vel=wp.vec3(),
            dim_x=CELLS,
            dim_y=CELLS,
            cell_x=cell,
            cell_y=cell,
            mass=DENSITY * cell**2,
            fix_left=True,
            fix_right=True,
            fix_top=True,
            fix_bottom=True,
            tri_ke=2.0e3,
            tri_ka=2.0e3,
            tri_kd=1.0e1,
            edge_ke=1.0e-2,
            edge_kd=1.0e-2,
            particle_radius=0.002,
        )
        tilt = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.5, 0.0)), 0.4)
        material = newton.ModelBuilder.ShapeConfig(mu=0.5, density=0.0)
        inertia = 0.4 * BALL_MASS * RADIUS**2 * np.eye(3)
        ball = self.add_body(builder, START[0], wp.quat_identity(), BALL_MASS, inertia)
        builder.add_shape_sphere(ball, radius=RADIUS, cfg=material)
        squares = np.square(HALF)
        box = self.add_body(builder, START[1], tilt, BOX_MASS, BOX_MASS / 3.0 * np.diag(squares.sum() - squares))
        builder.add_shape_box(box, hx=HALF[0], hy=HALF[1], hz=HALF[2], cfg=material)
        builder.color()
        model = builder.finalize()
        model.particle_mu = 0.5

        solver = newton.solvers.SolverVBD(model, iterations=5, particle_enable_self_contact=False)
        self.start(model, solver, camera=(wp.vec3(0.8, -0.8, 0.4), -22.0, 135.0), bodies="separated", substeps=4)
        self.lowest, self.thrown = self.heights(), np.zeros(2)

    @staticmethod
    def add_body(builder, position, rotation, mass, inertia):
        """Adds a body of this mass and inertia."""
        pose = wp.transform(wp.vec3(*position), rotation)
        return builder.add_body(xform=pose, mass=mass, inertia=wp.mat33(*inertia.ravel().tolist()), lock_inertia=True)

    def step(self):
        """Simulates a frame, and notes how low the bodies have been, and how far up they were thrown from there."""
        super().step()
        heights = self.heights()
        self.lowest = np.minimum(self.lowest, heights)
        self.thrown = np.maximum(self.thrown, heights - self.lowest)

    def heights(self):
        """Returns the heights of the bodies [m]."""
        return self.state_0.body_q.numpy()[:, 2].astype(float)

    def speeds(self):
        """Returns the speeds of the bodies [m/s]."""
        return np.linalg.norm(self.state_0.body_qd.numpy()[:, :3], axis=1)

    def test_final(self):
        """Checks that all steps are certified, and that the bodies were thrown up and lie at rest on the sheet."""
        super().test_final()
        assert (self.thrown > 0.1).all(), f"the bodies were thrown up by {self.thrown} m only"
        assert (self.speeds() < 0.05).all(), f"the bodies still move with {self.speeds()} m/s"
        positions = self.state_0.body_q.numpy()[:, :3]
        assert (np.abs(positions[:, :2]) < 0.5 * SIZE).all(), f"a body has left the sheet: {positions}"
        sheet = self.state_0.particle_q.numpy()
        for position in positions:
            below = sheet[np.argmin(np.linalg.norm(sheet[:, :2] - position[:2], axis=1))]
            assert 0.0 < position[2] - below[2] < 0.1, f"a body is {position[2] - below[2]:.3f} m above the sheet"

    def print_report(self):
        """Prints what the stage did, and how far the bodies were thrown."""
        super().print_report()
        print(f"thrown up by {self.thrown.round(3)} m, speeds at the end {self.speeds().round(4)} m/s")


if __name__ == "__main__":
    main(Example)
