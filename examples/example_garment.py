"""Example Garment: a shirt is worn by a mannequin that turns to and fro.

    python examples/example_garment.py
    python examples/example_garment.py --no-ccd  # the shirt falls through the mannequin

The solver knows of no contact at all, neither of the shirt with itself nor with the mannequin: what keeps the shirt on
is the stage alone, friction included.
"""

import argparse
import math

import newton
import newton.examples
import newton.usd
import numpy as np
import warp as wp
from common import main
from pxr import Usd

import warp_bsc as bsc

FRAMES_PER_CAPTURE = 6
ANGULAR_FREQUENCY = 0.5 * math.pi  # 1/s, a turn to and fro takes four seconds
CAPSULES = [  # ends and radius [m], fitted into the shirt with some millimetres to spare
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
    """VBD that also turns the body, so that its motion is a part of the step, which the stage sees as a whole."""

    def __init__(self, model, amplitude, angular_frequency, **options):
        super().__init__(model, **options)
        self.motion = amplitude, angular_frequency
        self.time = wp.zeros(1, dtype=float, device=model.device)

    def step(self, state_in, state_out, control, contacts, dt, **options):
        """Steps the shirt, and turns the body."""
        super().step(state_in, state_out, control, contacts, dt, **options)
        wp.launch(turn_body, 1, inputs=[*self.motion, dt, self.time], outputs=[state_out.body_q])


class Example:
    """The scene, in the format of Newton's examples."""

    def __init__(self, viewer, args):
        self.viewer = viewer
        self.angle = args.angle
        self.ccd = args.ccd
        self.fps = 60
        self.frame_dt = 1.0 / self.fps
        self.sim_substeps = 4  # even, so that a CUDA graph ends with the states that it began with
        self.sim_dt = self.frame_dt / self.sim_substeps
        self.sim_time = 0.0
        self.frame = 0

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
        self.model = builder.finalize()

        self.solver = SolverTurningVBD(
            self.model, self.angle, ANGULAR_FREQUENCY, iterations=10, particle_enable_self_contact=False
        )
        if self.ccd:
            self.solver = bsc.SolverCCD(self.solver)
        self.state_0, self.state_1 = self.model.state(), self.model.state()
        self.control = self.model.control()

        self.viewer.set_model(self.model)
        self.viewer.set_camera(pos=wp.vec3(0.0, -1.7, 1.3), pitch=-5.0, yaw=90.0)

    def capture(self):
        """Captures a frame on a GPU."""
        self.graph = None
        if self.model.device.is_cuda:
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
        """Simulates a frame, on a GPU from the graph.

        In a graph the stage's queues cannot grow. Contacts become more from frame to frame, so every few frames one is
        simulated without, which leaves a quarter of room to spare, and captured anew.
        """
        if self.frame % FRAMES_PER_CAPTURE == 0:
            self.simulate()
            self.capture()
        elif self.graph:
            wp.capture_launch(self.graph)
        else:
            self.simulate()
        self.frame += 1
        self.sim_time += self.frame_dt

    def render(self):
        """Shows the frame."""
        self.viewer.begin_frame(self.sim_time)
        self.viewer.log_state(self.state_0)
        self.viewer.end_frame()

    def find_angle(self, time):
        """By which angle the mannequin is turned at a time [rad]."""
        return 0.5 * self.angle * (1.0 - math.cos(ANGULAR_FREQUENCY * time))

    def measure_slip(self):
        """How far the sleeves, on average, are from where they were on the arms at the start [m]."""
        rest, q = (state.particle_q.numpy().astype(np.float64) for state in (self.model, self.state_0))
        sleeves = np.abs(rest[:, 0]) > 0.25
        angle = self.find_angle(self.sim_time)
        cos, sin = np.cos(angle), np.sin(angle)
        turned = rest @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return np.linalg.norm((q - turned)[sleeves], axis=1).mean()

    def test_final(self):
        """The mannequin has turned, the shirt hangs on it still, and the stage kept its promise."""
        if self.ccd:
            report = self.solver.report
            assert report.uncertified_steps == 0, f"{report.uncertified_steps} steps are not certified"
            assert len(report.intersections) == 0, f"{len(report.intersections)} edges cross faces"
        *_, z, w = self.state_0.body_q.numpy()[0]
        angle = 2.0 * math.atan2(z, w)
        assert abs(angle - self.find_angle(self.sim_time)) < 1.0e-3, f"the mannequin has turned by {angle} rad"
        slip, lowest = self.measure_slip(), self.state_0.particle_q.numpy()[:, 2].min()
        assert slip < 0.1, f"the sleeves have slipped by {slip} m"
        assert lowest > 0.7, f"the shirt hangs down to {lowest} m"
        speed = np.linalg.norm(self.state_0.particle_qd.numpy(), axis=1).max()
        assert speed < 2.0, f"the shirt moves at {speed} m/s"

    def print_report(self):
        """Prints what the stage did."""
        if self.ccd:
            print(self.solver.report)
        slip, lowest = self.measure_slip(), self.state_0.particle_q.numpy()[:, 2].min()
        print(f"the sleeves have moved by {slip:.3f} m on the arms, the lowest point of the shirt is at {lowest:.3f} m")

    @staticmethod
    def create_parser():
        """The options."""
        parser = newton.examples.create_parser()
        parser.set_defaults(num_frames=120)
        parser.add_argument("--angle", type=float, default=1.0, help="How far the mannequin turns [rad].")
        parser.add_argument(
            "--ccd", action=argparse.BooleanOptionalAction, default=True, help="Put the collision stage behind it."
        )
        return parser


if __name__ == "__main__":
    main(Example)
