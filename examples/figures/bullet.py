"""Draws the example Cloth Bullet without the collision stage and with it, at the same times.

    python examples/figures/bullet.py bullet.png

Needs matplotlib (``pip install matplotlib``).
"""

import argparse
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import newton.viewer
import numpy as np
from matplotlib.colors import to_rgb
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

sys.path.append(str(Path(__file__).parents[1]))  # for the example
from example_cloth_bullet import Example

FRAMES = (0, 1, 2, 6)
_SHEET, _PATCH = to_rgb("#9db8d9"), to_rgb("#e07a2f")
_LIFT = 0.012
"""Distance by which the patch is drawn above its position [m], because whole triangles are sorted by depth."""
_LIGHT = np.array([0.3, -0.5, 0.81])


def positions(ccd):
    """Returns the example after a run, and its positions at the frames, shape [len(FRAMES), particles, 3]."""
    args = Example.create_parser().parse_args(["--viewer", "null", "--speed", "30", "--ccd" if ccd else "--no-ccd"])
    example = Example(newton.viewer.ViewerNull(), args)
    taken = []
    for frame in range(max(FRAMES) + 1):
        if frame in FRAMES:
            taken.append(example.state_0.particle_q.numpy().copy())
        example.step()
    return example, np.array(taken)


def draw(axes, example, x):
    """Draws the sheet and the patch."""
    triangles = example.model.tri_indices.numpy()
    corners = x[triangles].astype(float)
    corners[example.sheet_triangles :, :, 2] += _LIFT
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    shade = 0.35 + 0.65 * np.abs(normals @ _LIGHT)
    colors = np.repeat([_SHEET, _PATCH], [example.sheet_triangles, len(triangles) - example.sheet_triangles], axis=0)
    colors = np.minimum(shade[:, None] * colors, 1.0)
    # one collection, which sorts all triangles by depth
    axes.add_collection3d(Poly3DCollection(corners, facecolors=colors, edgecolors=colors, linewidths=0.3))
    axes.set(xlim=(-0.5, 0.5), ylim=(-0.5, 0.5), zlim=(-0.5, 0.5))
    axes.set_box_aspect((1, 1, 1), zoom=1.2)
    axes.view_init(elev=18, azim=-60)
    axes.set_axis_off()


def main():
    """Reads the command line, and draws the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("picture", help="File to write, .png or another format of matplotlib.")
    picture = parser.parse_args().picture
    figure = plt.figure(figsize=(10.0, 5.0), dpi=110)
    for row, ccd in enumerate((False, True)):
        example, x = positions(ccd)
        for column, frame in enumerate(FRAMES):
            axes = figure.add_subplot(2, len(FRAMES), 1 + row * len(FRAMES) + column, projection="3d")
            draw(axes, example, x[column])
            axes.set_title(f"{1e3 * frame * example.frame_dt:.0f} ms", fontsize=9, y=0.9)
        figure.text(0.015, 0.72 - 0.48 * row, "with" if ccd else "without", rotation=90, va="center", fontsize=12)
    figure.subplots_adjust(left=0.03, right=1.0, bottom=0.0, top=0.98, wspace=0.0, hspace=0.0)
    figure.savefig(picture)


if __name__ == "__main__":
    main()
