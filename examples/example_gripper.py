"""Example Gripper: two fingers pinch a folded cloth and lift it; with a tenth of the friction, it slips out.

    python examples/example_gripper.py
    python examples/example_gripper.py --friction 0.05
    python examples/example_gripper.py --robot mujoco  # after: pip install "newton[sim]"
    python examples/example_gripper.py --no-ccd  # the fingers close through the cloth

Featherstone or MuJoCo moves the robot in reduced coordinates, VBD the cloth. Newton's proxy coupling shows the fingers
to the cloth's solver as bodies of their mass, and the collision stage behind that solver pushes cloth and fingers
apart. The impulses on the fingers come back to the robot's solver as forces, a step late, so that the fingers end
elsewhere than that stage has pushed them: a second stage, around the coupled solver, keeps cloth and fingers apart
where both are in the end, and certifies that. No solver has contacts of its own.
"""

import newton
import newton.examples
import numpy as np
import warp as wp
from common import ExampleBase, main
from newton.solvers.experimental.coupled import SolverCoupled, SolverCoupledProxy

import warp_bsc as bsc

FINGER = (0.01, 0.05, 0.02)  # m, half the lengths of the sides
OPENING = 0.0155  # m, of a finger from the middle at the start
HEIGHT = 0.098  # m, of the fingers at the start
CARRIAGE_MASS, FINGER_MASS = 1.0, 0.2  # kg
FORCE, DAMPING = 0.3, 2.0  # N and N s/m, of a finger
LIFT = 0.1  # m
MARGIN = 3.0e-4  # m, that the cloth's solver keeps cloth and fingers apart, for what fingers move before they feel it
GRIP_TIME, LIFT_TIME = 0.1, 0.4  # s
SIDE, WIDTH, CELLS = 0.12, 0.1, (8, 6)  # m and cells, of one side of the folded cloth
DENSITY = 0.5  # kg/m^2
WEIGHT = 9.81 * DENSITY * 2.0 * SIDE * WIDTH  # N
TILT = np.radians(1.5)  # of both sides, from the vertical
ROBOTS = {
    "featherstone": (newton.solvers.SolverFeatherstone, 1.0),
    "mujoco": (lambda model: newton.solvers.SolverMuJoCo(model, disable_contacts=True), 0.38),
}
"""Solvers of the robot, each with the share of the mass by that solver that the cloth's solver sees. MuJoCo gives a
finger 0.525 kg, an average over directions, most of it the carriage's: what stops that mass throws the finger back."""


@wp.kernel
def drive(
    dt: float,
    weight: float,
    joint_qd: wp.array[float],
    time: wp.array[float],
    joint_target_q: wp.array[float],
    joint_f: wp.array[float],
):
    """Sets the height that the carriage is driven to, and the forces that close the fingers."""
    t = time[0] + dt
    time[0] = t
    joint_target_q[0] = LIFT * wp.clamp((t - GRIP_TIME) / LIFT_TIME, 0.0, 1.0)
    joint_f[0] = weight
    for finger in range(1, 3):
        joint_f[finger] = FORCE - DAMPING * joint_qd[finger]


def box_inertia(mass, half):
    """Returns the inertia of a box."""
    squares = np.square(half)
    return wp.mat33(*(mass / 3.0 * np.diag(squares.sum() - squares)).ravel().tolist())


def folded_cloth():
    """Returns positions and faces of a cloth that is folded over a ridge along y."""
    u = np.linspace(-1.0, 1.0, 2 * CELLS[0] + 1)
    y = np.linspace(-0.5 * WIDTH, 0.5 * WIDTH, CELLS[1] + 1)
    x, z = SIDE * np.sin(TILT) * u, 0.002 + SIDE * np.cos(TILT) * (1.0 - np.abs(u))
    positions = np.stack([np.repeat(x, len(y)), np.tile(y, len(u)), np.repeat(z, len(y))], axis=1)
    a = (np.arange(len(u) - 1)[:, None] * len(y) + np.arange(CELLS[1])).ravel()
    b, c, d = a + len(y), a + len(y) + 1, a + 1
    return positions, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


class Example(ExampleBase):
    """The scene, in the format of Newton's examples."""

    num_frames = 60

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        self.friction = args.friction
        builder = newton.ModelBuilder()
        builder.add_ground_plane()
        fingers = self.add_robot(builder)
        positions, faces = folded_cloth()
        builder.add_cloth_mesh(
            pos=wp.vec3(),
            rot=wp.quat_identity(),
            scale=1.0,
            vel=wp.vec3(),
            vertices=[wp.vec3(*position) for position in positions.tolist()],
            indices=faces.ravel().tolist(),
            density=DENSITY,
            tri_ke=1.0e3,
            tri_ka=1.0e3,
            tri_kd=1.0,
            edge_ke=1.0e-3,
            edge_kd=1.0e-4,
            particle_radius=0.002,
        )
        builder.color()
        model = builder.finalize()
        model.particle_mu = self.friction

        bodies, joints = list(range(model.body_count)), list(range(model.joint_count))
        robot_solver, mass_scale = ROBOTS[args.robot]
        robot = SolverCoupled.Entry(name="robot", solver=robot_solver, bodies=bodies, joints=joints)
        cloth = SolverCoupled.Entry(
            name="cloth", solver=self.make_cloth_solver, particles=list(range(model.particle_count))
        )
        ends = {"source": "robot", "destination": "cloth"}
        proxy = SolverCoupledProxy.Proxy(**ends, bodies=fingers, mode="staggered", mass_scale=mass_scale)
        self.coupled = SolverCoupledProxy(model, [robot, cloth], SolverCoupledProxy.Config(proxies=[proxy]))
        self.time = wp.zeros(1, dtype=float)  # on the device, so that a CUDA graph finds it advanced
        self.weight = 9.81 * (CARRIAGE_MASS + 2.0 * FINGER_MASS)
        self.start(model, self.coupled, camera=(wp.vec3(0.35, -0.35, 0.25), -18.0, 135.0))
        newton.eval_fk(model, model.joint_q, model.joint_qd, self.state_0)
        self.most_crossings = 0

    def make_cloth_solver(self, model):
        """Returns the solver of the cloth, with a stage behind it."""
        solver = newton.solvers.SolverVBD(model, iterations=5, particle_enable_self_contact=False)
        return bsc.SolverCCD(solver, min_distance=MARGIN) if self.ccd else solver

    def add_robot(self, builder):
        """Adds a carriage that moves up and down, and two fingers on it; returns the fingers."""
        middle = wp.transform(wp.vec3(0.0, 0.0, 0.2), wp.quat_identity())
        inertia = box_inertia(CARRIAGE_MASS, (0.05, 0.05, 0.05))
        carriage = builder.add_link(xform=middle, mass=CARRIAGE_MASS, inertia=inertia, lock_inertia=True)
        drive_up = {"axis": (0.0, 0.0, 1.0), "target_ke": 4.0e3, "target_kd": 2.0e2}
        joints = [builder.add_joint_prismatic(-1, carriage, parent_xform=middle, **drive_up)]
        fingers = []
        for side in (-1.0, 1.0):
            at = wp.transform(wp.vec3(side * OPENING, 0.0, HEIGHT), wp.quat_identity())
            inertia = box_inertia(FINGER_MASS, FINGER)
            finger = builder.add_link(xform=at, mass=FINGER_MASS, inertia=inertia, lock_inertia=True)
            material = newton.ModelBuilder.ShapeConfig(mu=self.friction, density=0.0)
            builder.add_shape_box(finger, hx=FINGER[0], hy=FINGER[1], hz=FINGER[2], cfg=material)
            on_carriage = wp.transform(wp.vec3(side * OPENING, 0.0, HEIGHT - 0.2), wp.quat_identity())
            closed = OPENING - FINGER[0] - 2.0e-4  # where the fingers stop if nothing is between them
            limits = {"limit_lower": -0.05, "limit_upper": closed, "limit_ke": 1.0e4, "limit_kd": 1.0e1}
            options = {"axis": (-side, 0.0, 0.0), "target_ke": 0.0, "target_kd": 0.0}
            joints.append(builder.add_joint_prismatic(carriage, finger, parent_xform=on_carriage, **options, **limits))
            fingers.append(finger)
        builder.add_articulation(joints)
        return fingers

    def simulate(self):
        """Simulates a frame."""
        for _ in range(self.sim_substeps):
            self.state_0.clear_forces()
            self.viewer.apply_forces(self.state_0)
            outputs = [self.time, self.control.joint_target_q, self.control.joint_f]
            wp.launch(drive, 1, inputs=[self.sim_dt, self.weight, self.state_0.joint_qd], outputs=outputs)
            self.solver.step(self.state_0, self.state_1, self.control, None, self.sim_dt)
            self.state_0, self.state_1 = self.state_1, self.state_0

    def step(self):
        """Simulates a frame, and notes how many edges and faces of cloth and fingers cross in its state."""
        super().step()
        if self.ccd:
            self.most_crossings = max(self.most_crossings, len(self.find_intersections()))

    def heights(self):
        """Returns the heights of the lowest and the highest particle, and of the fingers [m]."""
        z = self.state_0.particle_q.numpy()[:, 2]
        return float(z.min()), float(z.max()), float(self.state_0.body_q.numpy()[1:, 2].mean())

    def test_final(self):
        """Checks that nothing crossed, and that the cloth is lifted, or slips out if friction does not carry it."""
        super().test_final()
        assert self.most_crossings == 0, f"{self.most_crossings} edges crossed faces"
        lowest, highest, fingers = self.heights()
        assert abs(fingers - HEIGHT - LIFT) < 0.01, f"the fingers are {fingers:.3f} m high"
        if 2.0 * FORCE * self.friction > WEIGHT:
            assert lowest > 0.02 and highest > fingers - FINGER[2], f"the cloth is from {lowest:.3f} to {highest:.3f} m"
        else:
            assert lowest < 0.01 and highest < fingers - FINGER[2], f"the cloth is from {lowest:.3f} to {highest:.3f} m"

    def print_report(self):
        """Prints what the stage did, and where the cloth is."""
        super().print_report()
        lowest, highest, fingers = self.heights()
        print(f"cloth from {lowest:.4f} to {highest:.4f} m, fingers at {fingers:.4f} m")

    @classmethod
    def create_parser(cls):
        """Returns the options."""
        parser = super().create_parser()
        parser.add_argument("--friction", type=float, default=0.5, help="Coefficient between cloth and fingers.")
        parser.add_argument("--robot", choices=ROBOTS, default="featherstone", help="Solver of the robot.")
        return parser


if __name__ == "__main__":
    main(Example)
