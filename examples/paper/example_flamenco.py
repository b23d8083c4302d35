"""Example Flamenco: a long dress with four layers of ruffles swings around a dancer.

    python examples/paper/example_flamenco.py
    python examples/paper/example_flamenco.py --triangles 49000  # as in the paper, better on a GPU
    python examples/paper/example_flamenco.py --no-ccd           # the layers pass through each other and the dancer

The benchmark of the paper with a flamenco dancer. The skirt is fastened at the waist, each ruffle is sewn to it at
every second vertex of its upper border, and lies over the next one below. Only the collision stage keeps all of them
apart.
"""

import math
from itertools import pairwise

import numpy as np
import warp as wp
from mannequin import FLATNESS, WAIST_HEIGHT, WAIST_RADIUS, add_mannequin, dance
from paper_scene import PaperScene, add_cloth, grid_faces, main

SKIRT = [(0.2, 0.42), (0.45, 0.31), (0.7, 0.23), (0.93, 0.182), (WAIST_HEIGHT, WAIST_RADIUS)]  # height and radius [m]
SEAMS = [0.7, 0.56, 0.42, 0.28]  # m, heights of the upper borders of the ruffles
RUFFLE = 0.165  # m, height of a ruffle
GAP, BULGE, WAVE = 0.006, 0.025, 0.028  # m, of a ruffle off the skirt at the seam, more at its hem, and waves there
WAVES = 16  # around
COLUMNS, CELL = 64, 0.0375  # around the skirt, and height of its cells [m], of a dress of COARSE_TRIANGLES
COARSE_TRIANGLES = 7168


class Example(PaperScene):
    """The scene, in the format of Newton's examples."""

    triangles = 8500
    num_frames = 90
    motion = dance
    motion_inputs = (1.3, 1.1, 0.15, 0.0)  # rate, turn, sway and stride
    camera = (wp.vec3(1.6, -2.2, 1.1), -8.0, 126.0)

    def build(self, builder, triangles):
        """Adds the dancer, the skirt and its ruffles."""
        add_mannequin(builder, 0.3, "petticoat")
        finer = math.sqrt(triangles / COARSE_TRIANGLES)
        columns, cell = max(round(COLUMNS * finer), 12), CELL / finer
        levels = [WAIST_HEIGHT, *SEAMS, SKIRT[0][0]]
        cells = [max(round((upper - lower) / cell), 1) for upper, lower in pairwise(levels)]
        rows = np.concatenate([[0], np.cumsum(cells)])
        height = np.interp(np.arange(rows[-1] + 1), rows, levels)
        vertices = [revolve(height, 0.0, columns)]
        faces = [grid_faces(len(height), columns, around=True)]
        count = vertices[0].size // 3

        around = 2 * columns
        ruffle_rows = max(round(RUFFLE / cell), 2)
        part = np.arange(ruffle_rows + 1)[:, None] / ruffle_rows
        waves = 1.0 + np.sin(2.0 * np.pi * WAVES * np.arange(around) / around)
        self.hems = []
        for seam, row in zip(SEAMS, rows[1:], strict=False):
            ruffle = revolve(seam - RUFFLE * part[:, 0], GAP + part * (BULGE + WAVE * waves), around)
            # the sewn vertices are those of the skirt, all others its own
            vertex = np.zeros((ruffle_rows + 1, around), dtype=int)
            sewn = np.zeros(vertex.shape, dtype=bool)
            sewn[0, ::2] = True
            vertex[sewn] = row * columns + np.arange(columns)
            vertex[~sewn] = count + np.arange((~sewn).sum())
            count += (~sewn).sum()
            vertices.append(ruffle[~sewn])
            faces.append(vertex.reshape(-1)[grid_faces(ruffle_rows + 1, around, around=True)])
            self.hems.append(vertex[-1])
        add_cloth(
            builder, np.concatenate([sheet.reshape(-1, 3) for sheet in vertices]), np.concatenate(faces), bending=5.0e-2
        )
        self.carried = range(columns)

    def measure(self):
        """Returns how the ruffles hang and swing."""
        q = self.positions()
        lengths = []
        for hem in self.hems:
            ring = q[hem]
            length = np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1).sum()
            lengths.append(length / np.linalg.norm(np.ptp(ring[:, :2], axis=0)) * math.sqrt(2.0) / math.pi)
        heights = [q[hem, 2].mean() for hem in self.hems]
        return {
            "length of the shortest hem over that of a circle of its width": min(lengths),
            "smallest distance between the heights of two hems [m]": -np.diff(heights).max(),
            "lowest particle [m]": q[:, 2].min(),
            "mean speed [m/s]": np.linalg.norm(self.state_0.particle_qd.numpy(), axis=1).mean(),
        }

    def test_scene(self, measured):
        """Checks that the ruffles hang in layers, all wavy, and swing."""
        length, distance, lowest, speed = measured.values()
        assert length > 1.2, f"a hem is {length} times as long as a circle of its width"
        assert distance > 0.05, f"two hems are {distance} m from each other in height"
        assert lowest > -0.1, f"the dress hangs down to {lowest} m"
        assert speed > 0.3, f"the dress moves with {speed} m/s"


def revolve(height, offset, columns):
    """Returns vertices around the z axis, ``offset`` [m] outside the skirt, shape [rows, columns, 3]."""
    angle = 2.0 * np.pi * np.arange(columns) / columns
    radius = np.interp(height, *np.transpose(SKIRT))[:, None] + offset
    x, y = radius * np.cos(angle), FLATNESS * radius * np.sin(angle)
    return np.stack([x, y, np.broadcast_to(height[:, None], x.shape)], axis=-1)


if __name__ == "__main__":
    main(Example)
