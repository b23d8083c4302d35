"""Example Propeller: a cloth falls on a propeller that turns by 30 degrees in each step, and is thrown off.

    python examples/example_propeller.py
    python examples/example_propeller.py --turns 5
    python examples/example_propeller.py --no-ccd  # it falls through the blades

Between two steps a blade is where no straight path of its vertices comes: they would pass inside of its circle. The
collision stage certifies the arcs.
"""

import newton
import newton.examples
import numpy as np
import warp as wp
from common import ExampleBase, main

CELLS = 12
SIZE = 0.36  # m, of the cloth
DENSITY = 0.3  # kg/m^2
HEIGHT = 0.08  # m, of the cloth above the propeller at the start
SPEED = 2.0  # m/s, of its fall at the start
BLADES = 3
ROOT, TIP, CHORD, PITCH = 0.04, 0.26, 0.04, 0.35  # m, m, m, rad: of a blade


@wp.kernel
def turn(dt: float, rate: float, angle: wp.array[float], body_q: wp.array[wp.transform]):
    """Advances the angle of the propeller, and sets its pose."""
    angle[0] = wp.mod(angle[0] + rate * dt, 2.0 * wp.pi)
    body_q[0] = wp.transform(wp.vec3(), wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), angle[0]))


class Example(ExampleBase):
    """The scene, in the format of Newton's examples."""

    num_frames = 40
    sim_substeps = 2

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        self.rate = 2.0 * np.pi * args.turns
        builder = newton.ModelBuilder()
        propeller = builder.add_body(xform=wp.transform_identity(), is_kinematic=True)
        for number in range(BLADES):
            out = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), 2.0 * np.pi * number / BLADES)
            pitch = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), PITCH)
            middle = wp.quat_rotate(out, wp.vec3(0.5 * (ROOT + TIP), 0.0, 0.0))
            half = {"hx": 0.5 * (TIP - ROOT), "hy": 0.5 * CHORD, "hz": 0.003}
            builder.add_shape_box(propeller, xform=wp.transform(middle, out * pitch), **half)
        builder.add_shape_cylinder(propeller, radius=1.5 * ROOT, half_height=0.015)
        builder.add_cloth_grid(
            pos=wp.vec3(-0.35 * SIZE, -0.5 * SIZE, HEIGHT),
            rot=wp.quat_identity(),
            vel=wp.vec3(0.0, 0.0, -SPEED),
            dim_x=CELLS,
            dim_y=CELLS,
            cell_x=SIZE / CELLS,
            cell_y=SIZE / CELLS,
            mass=DENSITY * (SIZE / CELLS) ** 2,
            tri_ke=1.0e3,
            tri_ka=1.0e3,
            tri_kd=1.0,
            edge_ke=1.0e-3,
            edge_kd=1.0e-4,
            particle_radius=0.002,
        )
        builder.color()
        model = builder.finalize()
        model.particle_mu = 0.2

        solver = newton.solvers.SolverVBD(model, iterations=5, particle_enable_self_contact=False)
        self.angle = wp.zeros(1, dtype=float)  # on the device, so that a CUDA graph finds it advanced
        self.start(model, solver, camera=(wp.vec3(0.9, -0.9, 0.7), -28.0, 135.0))
        self.highest, self.fastest = -np.inf, 0.0

    def simulate(self):
        """Simulates a frame."""
        for _ in range(self.sim_substeps):
            self.state_0.clear_forces()
            self.viewer.apply_forces(self.state_0)
            wp.launch(turn, 1, inputs=[self.sim_dt, self.rate], outputs=[self.angle, self.state_0.body_q])
            self.solver.step(self.state_0, self.state_1, self.control, None, self.sim_dt)
            self.state_0, self.state_1 = self.state_1, self.state_0

    def step(self):
        """Simulates a frame, and notes how fast the cloth has been in the plane of the propeller."""
        super().step()
        self.fastest = max(self.fastest, float(np.linalg.norm(self.state_0.particle_qd.numpy()[:, :2], axis=1).max()))

    def test_final(self):
        """Checks that all steps are certified, and that the blades threw the cloth."""
        super().test_final()
        assert self.fastest > 3.0, f"the cloth was at most {self.fastest:.2f} m/s fast"

    def print_report(self):
        """Prints what the stage did, and how fast the cloth was."""
        super().print_report()
        angle = np.degrees(self.rate * self.sim_dt)
        print(f"the propeller turned by {angle:.0f} degrees a step; the cloth was thrown at {self.fastest:.1f} m/s")

    @classmethod
    def create_parser(cls):
        """Returns the options."""
        parser = super().create_parser()
        parser.add_argument("--turns", type=float, default=10.0, help="Turns of the propeller in a second.")
        return parser


if __name__ == "__main__":
    main(Example)
