"""Example Garment: a shirt is worn by a mannequin that turns to and fro.

    python examples/example_garment.py
    python examples/example_garment.py --no-ccd  # the shirt falls through the mannequin

The inner solver has no contacts, neither of the shirt with itself nor with the mannequin: the collision stage alone,
with its friction, keeps the shirt on.
"""

import math

import newton
import newton.examples
import newton.usd
import numpy as np
import warp as wp
from common import ExampleBase, main
from pxr import Usd

ANGULAR_FREQUENCY = 0.5 * math.pi  # 1/s, a turn to and fro takes four seconds
CAPSULES = [  # ends and radius [m], which fit into the shirt with some millimetres to spare
    ((0.0, 0.06, 0.70), (0.0, 0.06, 1.32), 0.095),  # torso
    ((-0.05, 0.06, 0.70), (-0.05, 0.06, 1.30), 0.075),
    ((0.05, 0.06, 0.70), (0.05, 0.06, 1.30), 0.075),
    ((-0.13, 0.06, 1.38), (0.13, 0.06, 1.38), 0.06),  # shoulders
    ((-0.166, 0.05, 1.40), (-0.379, 0.047, 1.096), 0.042),  # arms
    ((0.166, 0.05, 1.40), (0.379, 0.047, 1.096), 0.042),
    ((0.0, 0.045, 1.40), (0.0, 0.03, 1.60), 0.04),  # neck
    ((0.0, 0.02, 1.68), (0.0, 0.02, 1.72), 0.08),  # head
]


@wp.kernel(enable_backward=False)
def turn_body(
    amplitude: float,
    angular_frequency: float,
    dt: float,
    time: wp.array[float],
    body_q: wp.array[wp.transform],
):
    """Turns the body about its upright axis, from rest, and advances the clock, on the device for the CUDA graph."""
    time[0] = time[0] + dt
    angle = 0.5 * amplitude * (1.0 - wp.cos(angular_frequency * time[0]))
    body_q[0] = wp.transform(wp.vec3(), wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), angle))


class SolverTurningVBD(newton.solvers.SolverVBD):
    """VBD that also turns the body, so that the stage detects collisions of its motion, too."""

    def __init__(self, model, amplitude, angular_frequency, **options):
        super().__init__(model, **options)
        self.motion = amplitude, angular_frequency
        self.time = wp.zeros(1, dtype=float, device=model.device)

    def step(self, state_in, state_out, control, contacts, dt, **options):
        """Steps the shirt, and turns the body."""
        super().step(state_in, state_out, control, contacts, dt, **options)
        wp.launch(turn_body, 1, inputs=[*self.motion, dt, self.time], outputs=[state_out.body_q])


class Example(ExampleBase):
    """The scene, in the format of Newton's examples."""

    num_frames = 120

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        self.angle = args.angle

        builder = newton.ModelBuilder()
        body = builder.add_body(is_kinematic=True)
        config = newton.ModelBuilder.ShapeConfig(density=0.0, mu=0.5)
        for start, end, radius in CAPSULES:
            center, axis = 0.5 * (wp.vec3(start) + wp.vec3(end)), wp.vec3(end) - wp.vec3(start)
            pose = wp.transform(center, wp.quat_between_vectors(wp.vec3(0.0, 0.0, 1.0), wp.normalize(axis)))
            half_height = 0.5 * wp.length(axis)
            builder.add_shape_capsule(body, xform=pose, radius=radius, half_height=half_height, cfg=config)
        stage = Usd.Stage.Open(newton.examples.get_asset("unisex_shirt.usd"))
        shirt = newton.usd.get_mesh(stage.GetPrimAtPath("/root/shirt"))
        builder.add_cloth_mesh(
            pos=wp.vec3(),
            rot=wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.5 * math.pi),  # the asset has y up
            scale=0.01,  # and is in centimetres
            vertices=[wp.vec3(*vertex) for vertex in shirt.vertices],
            indices=shirt.indices,
            vel=wp.vec3(),
            density=0.15,
            tri_ke=1.0e3,
            tri_ka=1.0e3,
            tri_kd=2.0e-3,
            edge_ke=1.0e-4,
            edge_kd=1.0e-3,
            particle_radius=0.002,
        )
        builder.color()
        model = builder.finalize()

        solver = SolverTurningVBD(
            model, self.angle, ANGULAR_FREQUENCY, iterations=10, particle_enable_self_contact=False
        )
        self.start(model, solver, camera=(wp.vec3(0.0, -1.7, 1.3), -5.0, 90.0))

    def find_angle(self, time):
        """Returns the angle by which the mannequin is turned at a time [s], in rad."""
        return 0.5 * self.angle * (1.0 - math.cos(ANGULAR_FREQUENCY * time))

    def measure_slip(self):
        """Returns the mean distance of the sleeves from where they were on the arms at the start [m]."""
        rest, q = (state.particle_q.numpy().astype(np.float64) for state in (self.model, self.state_0))
        sleeves = np.abs(rest[:, 0]) > 0.25
        angle = self.find_angle(self.sim_time)
        cos, sin = np.cos(angle), np.sin(angle)
        turned = rest @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return np.linalg.norm((q - turned)[sleeves], axis=1).mean()

    def test_final(self):
        """Checks that all steps are certified, the mannequin has turned, and the shirt still hangs on it."""
        super().test_final()
        *_, z, w = self.state_0.body_q.numpy()[0]
        angle = 2.0 * math.atan2(z, w)
        assert abs(angle - self.find_angle(self.sim_time)) < 1.0e-3, f"the mannequin has turned by {angle} rad"
        slip, lowest = self.measure_slip(), self.state_0.particle_q.numpy()[:, 2].min()
        assert slip < 0.1, f"the sleeves have slipped by {slip} m"
        assert lowest > 0.7, f"the shirt hangs down to {lowest} m"
        speed = np.linalg.norm(self.state_0.particle_qd.numpy(), axis=1).max()
        assert speed < 2.0, f"the shirt moves at {speed} m/s"

    def print_report(self):
        """Prints what the stage did, and how far the shirt slipped."""
        super().print_report()
        slip, lowest = self.measure_slip(), self.state_0.particle_q.numpy()[:, 2].min()
        print(f"the sleeves have moved by {slip:.3f} m on the arms, the lowest point of the shirt is at {lowest:.3f} m")

    @classmethod
    def create_parser(cls):
        """Returns the options."""
        parser = super().create_parser()
        parser.add_argument("--angle", type=float, default=1.0, help="How far the mannequin turns [rad].")
        return parser


if __name__ == "__main__":
    main(Example)
