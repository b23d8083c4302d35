"""Example Cloth Twist: a cloth is wrung by its two ends, layer over layer, and does not pass through itself.

    python examples/example_cloth_twist.py                   # two and a half seconds: each end turns by 150 degrees
    python examples/example_cloth_twist.py --num-frames 600  # ten seconds: by 600 degrees, better on a GPU
    python examples/example_cloth_twist.py --no-ccd          # the cloth passes through itself

The scene is that of Newton's example ``cloth_twist``. Self-contact of the solver is off: the stage alone keeps the
layers apart.
"""

import math
import os

import newton
import newton.examples
import newton.usd
import numpy as np
import warp as wp
import warp.examples
from common import ExampleBase, main
from pxr import Usd


@wp.kernel(enable_backward=False)
def turn_ends(
    ends: wp.array[int],
    rest: wp.array[wp.vec3],
    angular_velocity: float,
    dt: float,
    time: wp.array[float],
    particle_q: wp.array[wp.vec3],
):
    """Turns the particles at the ends about the y axis, each end its own way, to their positions after the step."""
    particle = ends[wp.tid()]
    p = rest[particle]
    angle = -wp.sign(p[1]) * angular_velocity * (time[0] + dt)
    particle_q[particle] = wp.quat_rotate(wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), angle), p)


@wp.kernel(enable_backward=False)
def advance(dt: float, time: wp.array[float]):
    """Advances the clock; it is on the device because a CUDA graph repeats the same launches."""
    time[0] = time[0] + dt


class SolverTurningVBD(newton.solvers.SolverVBD):
    """VBD that also moves the ends, so that the stage detects collisions of their motion, too."""

    def __init__(self, model, ends, angular_velocity, **options):
        super().__init__(model, **options)
        self.ends = wp.array(ends, dtype=int, device=model.device)
        self.angular_velocity = angular_velocity
        self.time = wp.zeros(1, dtype=float, device=model.device)

    def step(self, state_in, state_out, control, contacts, dt, **options):
        """Turns the ends, and steps the cloth between them."""
        inputs = [self.ends, self.model.particle_q, self.angular_velocity, dt, self.time]
        wp.launch(turn_ends, len(self.ends), inputs=inputs, outputs=[state_in.particle_q])
        wp.launch(advance, 1, inputs=[dt], outputs=[self.time])
        super().step(state_in, state_out, control, contacts, dt, **options)


class Example(ExampleBase):
    """The scene, in the format of Newton's examples."""

    num_frames = 150
    sim_substeps = 10

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        self.angular_velocity = math.pi / 3.0

        stage = Usd.Stage.Open(os.path.join(warp.examples.get_asset_directory(), "square_cloth.usd"))
        cloth = newton.usd.get_mesh(stage.GetPrimAtPath("/root/cloth/cloth"))
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        builder.add_cloth_mesh(
            pos=wp.vec3(),
            rot=wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), 0.5 * math.pi),
            scale=0.01,  # the asset is in centimetres
            vertices=[wp.vec3(*vertex) for vertex in cloth.vertices],
            indices=cloth.indices,
            vel=wp.vec3(),
            density=0.2,
            tri_ke=1.0e3,
            tri_ka=1.0e3,
            tri_kd=2.0e-4,
            edge_ke=1.0e-3,
            edge_kd=1.0e-2,
        )
        y = np.array(builder.particle_q)[:, 1]
        self.ends = np.flatnonzero(np.abs(y) > 0.999 * np.abs(y).max())
        for particle in self.ends:
            builder.particle_flags[particle] &= ~int(newton.ParticleFlags.ACTIVE)
        builder.color()
        model = builder.finalize()

        solver = SolverTurningVBD(
            model, self.ends, self.angular_velocity, iterations=4, particle_enable_self_contact=False
        )
        self.start(model, solver, camera=(wp.vec3(2.25, 0.0, 0.0), 0.0, -180.0))

    def measure_turns(self):
        """Returns the angles by which the particles of the ends have turned about the y axis [rad], in [0, 2 pi)."""
        rest, q = (
            array.numpy()[self.ends].astype(np.float64) for array in (self.model.particle_q, self.state_0.particle_q)
        )
        angles = np.arctan2(q[:, 0], q[:, 2]) - np.arctan2(rest[:, 0], rest[:, 2])
        return -np.sign(rest[:, 1]) * angles % (2.0 * np.pi)

    def test_final(self):
        """Checks that all steps are certified, the ends have turned, and the cloth has not passed through itself."""
        super().test_final()
        turned = self.measure_turns() - self.angular_velocity * self.sim_time
        error = np.abs((turned + np.pi) % (2.0 * np.pi) - np.pi).max()
        assert error < 1.0e-3, f"the ends are {error} rad from where they should be"
        intersections = self.find_intersections()
        assert len(intersections) == 0, f"{len(intersections)} edges of the cloth cross faces"

    def print_report(self):
        """Prints what the stage did, and how often the cloth crosses itself."""
        super().print_report()
        print(f"{len(self.find_intersections())} edges of the cloth cross faces")


if __name__ == "__main__":
    main(Example)
