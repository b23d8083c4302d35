"""Example Funnel: a cloth falls into a funnel and has to fold to fit, until all of it is in the pipe.

    python examples/paper/example_funnel.py
    python examples/paper/example_funnel.py --triangles 42000  # the largest of the paper, better on a GPU
    python examples/paper/example_funnel.py --no-ccd           # the cloth falls through the funnel

The fourth benchmark of the paper. Only the collision stage keeps the cloth in the funnel and its folds apart.
"""

import numpy as np
import warp as wp
from paper_scene import PaperScene, add_collider, add_square_cloth, grid_faces, main

SIZE = 1.0  # m, of the cloth
RIM, THROAT = 0.76, 0.1  # m, radii of the funnel at the top and of its pipe
DEPTH, PIPE = 0.75, 0.7  # m, of the cone and of the pipe below it; they meet at a height of 0


class Example(PaperScene):
    """The scene, in the format of Newton's examples."""

    triangles = 5000
    num_frames = 55
    camera = (wp.vec3(1.2, -1.2, 1.4), -35.0, 135.0)

    def build(self, builder, triangles):
        """Adds the funnel and the cloth."""
        height = np.concatenate([np.linspace(-PIPE, 0.0, 13)[:-1], np.linspace(0.0, DEPTH, 17)])
        radius = np.maximum(THROAT, THROAT + (RIM - THROAT) * height / DEPTH)
        angle = 2.0 * np.pi * np.arange(64) / 64
        x, y = radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)
        funnel = np.stack([x, y, np.broadcast_to(height[:, None], x.shape)], axis=-1).reshape(-1, 3)
        add_collider(builder, -1, funnel, grid_faces(len(height), len(angle), around=True), 0.1)

        add_square_cloth(builder, triangles, SIZE, DEPTH)

    def measure(self):
        """Returns where the cloth is, and how much it is folded."""
        q = self.positions()
        radius = np.linalg.norm(q[:, :2], axis=1)
        wall = np.maximum(THROAT, THROAT + (RIM - THROAT) * q[:, 2] / DEPTH)
        inside = (q[:, 2] < DEPTH) & (radius < wall + 1.0e-3)
        return {
            "share of the particles in the funnel": inside.mean(),
            "share of the particles in its pipe": (inside & (q[:, 2] < 0.0)).mean(),
            "mean distance from the axis [m]": radius.mean(),
            "lowest particle [m]": q[:, 2].min(),
        }

    def test_scene(self, measured):
        """Checks that the cloth is in the funnel, folded."""
        inside, _, distance, lowest = measured.values()
        assert inside == 1.0, f"only {inside:.1%} of the particles are in the funnel"
        # a flat square has a mean distance of 0.38 of its side
        assert distance < 0.15 * SIZE, f"the particles are {distance} m from the axis"
        assert -PIPE < lowest < 0.0, f"the lowest particle is at {lowest} m"


if __name__ == "__main__":
    main(Example)
