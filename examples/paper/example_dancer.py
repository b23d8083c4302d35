"""Example Dancer: a wide skirt swings around a dancer who turns to and fro and steps.

    python examples/paper/example_dancer.py
    python examples/paper/example_dancer.py --triangles 10000  # the largest of the paper
    python examples/paper/example_dancer.py --no-ccd           # the skirt passes through the dancer and itself

The third benchmark of the paper. The waist of the skirt is fastened to the dancer; only the collision stage keeps the
rest off the body, and its folds apart.
"""

import math

import numpy as np
import warp as wp
from mannequin import FLATNESS, WAIST_HEIGHT, WAIST_RADIUS, add_mannequin, dance
from paper_scene import PaperScene, add_cloth, grid_faces, main

LENGTH = 0.58  # m, of the skirt
FLARE = math.radians(72.0)  # between the axis and the skirt at rest, a wide cone
COLUMNS_PER_ROW = 4.0


class Example(PaperScene):
    """The scene, in the format of Newton's examples."""

    triangles = 5000
    num_frames = 120
    motion = dance
    motion_inputs = (0.9, 1.3, 0.08, 0.45)  # rate, turn, sway and stride
    camera = (wp.vec3(1.5, -1.9, 1.2), -8.0, 128.0)

    def build(self, builder, triangles):
        """Adds the dancer and the skirt."""
        add_mannequin(builder, 0.3, "legs")
        rows = max(round(math.sqrt(0.5 * triangles / COLUMNS_PER_ROW)), 5)
        columns = round(0.5 * triangles / rows)
        along = np.linspace(0.0, LENGTH, rows + 1)[:, None]
        angle = 2.0 * np.pi * np.arange(columns) / columns
        radius = WAIST_RADIUS + math.sin(FLARE) * along
        height = np.broadcast_to(WAIST_HEIGHT - math.cos(FLARE) * along, (rows + 1, columns))
        skirt = np.stack([radius * np.cos(angle), FLATNESS * radius * np.sin(angle), height], axis=-1)
        add_cloth(builder, skirt, grid_faces(rows + 1, columns, around=True))
        self.hem = np.arange(rows * columns, (rows + 1) * columns)
        self.carried = range(columns)

    def measure(self):
        """Returns how low the skirt hangs, and how much its hem is folded."""
        q = self.positions()
        hem = q[self.hem]
        angle = np.unwrap(np.arctan2(hem[:, 1], hem[:, 0]))
        step = np.diff(angle)
        return {
            "mean height of the hem [m]": hem[:, 2].mean(),
            "lowest particle [m]": q[:, 2].min(),
            "share of the hem that runs back over itself": (step < 0.0).mean(),
        }

    def test_scene(self, measured):
        """Checks that the skirt hangs from the waist, around the legs, in folds."""
        hem, lowest, back = measured.values()
        assert lowest > WAIST_HEIGHT - LENGTH - 0.05, f"the skirt hangs down to {lowest} m"
        assert hem < WAIST_HEIGHT - 0.2, f"the hem is at {hem} m"
        assert back > 0.1, f"only {back:.1%} of the hem is folded over"


if __name__ == "__main__":
    main(Example)
