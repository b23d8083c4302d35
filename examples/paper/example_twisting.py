"""Example Twisting: a cloth lies on a ball, which turns and winds it up, while the floor holds its corners back.

    python examples/paper/example_twisting.py
    python examples/paper/example_twisting.py --triangles 50000  # the largest of the paper, better on a GPU
    python examples/paper/example_twisting.py --no-ccd           # the cloth falls through ball and floor

The first benchmark of the paper. Only friction carries the cloth, all of it from the collision stage: the
inner solver has no contacts.
"""

import math

import numpy as np
import warp as wp
from paper_scene import PaperScene, add_collider, add_square_cloth, lathe, main

SIZE = 2.3  # m, of the cloth
RADIUS = 0.3  # m, of the ball
HEIGHT = 0.38  # m, of its centre above the floor
START, RAMP = 0.5, 0.5  # s, when the ball begins to turn, and how long it takes to reach its speed
SPEED = wp.constant(4.0)  # rad/s
START_TIME, RAMP_TIME = wp.constant(START), wp.constant(RAMP)
CENTRE = wp.constant(wp.vec3(0.0, 0.0, HEIGHT))


@wp.kernel(enable_backward=False)
def turn_ball(
    # in
    time: wp.array[float],
    # out
    body_q: wp.array[wp.transform],
):
    """Turns the ball about the upright axis."""
    t = wp.max(time[0] - START_TIME, 0.0)
    # the speed grows linearly, then is constant
    angle = SPEED * wp.where(t < RAMP_TIME, 0.5 * t * t / RAMP_TIME, t - 0.5 * RAMP_TIME)
    body_q[0] = wp.transform(CENTRE, wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), angle))


class Example(PaperScene):
    """The scene, in the format of Newton's examples."""

    triangles = 5000
    num_frames = 150
    motion = turn_ball
    camera = (wp.vec3(1.5, -1.5, 1.1), -25.0, 135.0)

    def build(self, builder, triangles):
        """Adds the ball, the floor and the cloth."""
        ball = builder.add_body(xform=wp.transform(CENTRE, wp.quat_identity()), is_kinematic=True)
        angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 33)
        profile = RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        profile[[0, -1], 0] = 0.0
        add_collider(builder, ball, *lathe(profile, 64), 4.0)
        corners = 1.7 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
        add_collider(builder, -1, corners, [[0, 1, 2], [0, 2, 3]], 25.0)

        self.cells = add_square_cloth(builder, triangles, SIZE, HEIGHT + RADIUS + 0.01)

    def measure(self):
        """Returns how far the cloth is twisted, and how high and low it reaches."""
        q = self.positions()
        grid = q.reshape(self.cells + 1, self.cells + 1, 3)
        middle, corners = self.cells // 2, []
        first = round(0.15 * self.cells)  # closer to the pole the angle is too inaccurate
        for i in (-1, 1):
            for j in (-1, 1):
                steps = np.arange(first, min(middle, self.cells - middle) + 1)
                ray = grid[middle + i * steps, middle + j * steps]
                angle = np.unwrap(np.arctan2(ray[:, 1], ray[:, 0]))
                corners.append(angle[0] - angle[-1])
        return {
            "twist from the top to the corners [degrees]": math.degrees(np.mean(corners)),
            "top of the cloth [m]": q[:, 2].max(),
            "lowest particle [m]": q[:, 2].min(),
        }

    def test_scene(self, measured):
        """Checks that the cloth is on the ball and above the floor, and twisted."""
        twist, top, lowest = measured.values()
        assert HEIGHT + RADIUS - 0.01 < top < HEIGHT + RADIUS + 0.1, f"the top of the cloth is at {top} m"
        assert lowest > 0.0, f"the cloth is at {lowest} m, below the floor"
        assert twist > 90.0, f"the cloth is twisted by {twist} degrees"


if __name__ == "__main__":
    main(Example)
