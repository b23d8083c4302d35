"""Draws what a camera recorded of a cloth, with what the search of friction and stiffness begins and ends with.

    python examples/figures/real_to_sim.py real_to_sim.png

Takes as long as the example, a minute on two cores. Needs matplotlib (``pip install matplotlib``).
"""

import argparse
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import newton.viewer
import numpy as np
import trimesh
from matplotlib.colors import to_rgb
from rich.progress import track

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1])]  # for the other figures and the examples
from example_diffsim_real_to_sim import EVERY, EYE, NAMES, NOISE, POINTS, RADIUS, TRUTH, Example
from scenes import PIXELS, View, axes_of, project, shade

_FIRST, _FOUND, _RIGID, _CLOUD = "#e07a2f", "#2f6fb3", "#b9b4ae", "#151515"
_COLORS = "#2f6fb3", "#c22f3d", "#3a9a5b"
_FRAMES = 3, 9, 14, 19
"""Frames of the recording that are drawn."""
_WORLD = 4
_ANGLES = np.degrees([np.arcsin(EYE[2] / np.linalg.norm(EYE)), np.arctan2(EYE[1], EYE[0])])
_VIEW = View(0, "", *_ANGLES, (0.0, 0.0, -0.25), 1.08)
"""From where the camera is."""


def learn():
    """Runs the example; returns it, and the positions of its first evaluation."""
    args = Example.create_parser().parse_args(["--viewer", "null"])
    example = Example(newton.viewer.ViewerNull(), args)
    for evaluation in track(range(example.num_frames), "real to sim"):
        example.step()
        if evaluation == 0:
            first = example.positions()
    return example, first


def picture_of(x, faces, color):
    """Returns the picture of a cloth on the bar."""
    turn = trimesh.transformations.rotation_matrix(0.5 * np.pi, [1.0, 0.0, 0.0])
    bar = trimesh.creation.cylinder(RADIUS, 1.0, sections=64).apply_transform(turn)
    both = np.concatenate([x, bar.vertices]).astype(float), np.concatenate([faces, bar.faces + len(x)])
    colors = [np.tile(to_rgb(c), (count, 1)) for c, count in ((color, len(faces)), (_RIGID, len(bar.faces)))]
    return shade(*both, np.concatenate(colors), _VIEW)


def pixels_of(points):
    """Returns where points are in these pictures, shape [n, 2]."""
    drawn = project(axes_of(_VIEW.elevation, _VIEW.azimuth), points, _VIEW, _VIEW.extent, 2 * PIXELS)
    return 0.5 * drawn[:, :2]


def draw(example, first):
    """Returns the figure."""
    figure, rows = plt.subplots(2, 5, figsize=(13.0, 5.4), dpi=90, width_ratios=[1.0] * 4 + [1.5])
    faces, clouds = example.faces.numpy(), example.points.numpy()[:, _WORLD]
    for row, (motion, color) in zip(rows, ((first, _FIRST), (example.motion, _FOUND)), strict=True):
        for axes, frame in zip(row, _FRAMES, strict=False):
            step = (frame + 1) * EVERY
            axes.imshow(picture_of(motion[step, _WORLD], faces, color))
            axes.scatter(*pixels_of(clouds[frame]).T, s=1.5, color=_CLOUD, linewidths=0)
            axes.set_title(f"{step / 60.0:.2f} s", fontsize=8, pad=2)
            axes.set_axis_off()
            axes.set(xlim=(0, PIXELS), ylim=(PIXELS, 0))
    errors = np.abs(example.errors)
    evaluations = 1 + np.arange(len(errors))
    for k, color in enumerate(_COLORS):
        rows[0, 4].plot(evaluations, errors[:, _WORLD, k], color=color, linewidth=1.5, label=NAMES[k])
    rows[0, 4].legend(fontsize=7, frameon=False)
    rows[1, 4].plot(evaluations, errors.max(axis=2), color=_FOUND, linewidth=1.0)
    titles = "relative errors in the world that is drawn", f"largest error in each of {example.worlds} worlds"
    for axes, title in zip(rows[:, 4], titles, strict=True):
        axes.axhline(0.02, color="#888888", linewidth=0.8, linestyle=":")
        axes.set(yscale="log", ylim=(1e-4, 6.0), xticks=range(4, len(errors) + 1, 4))
        axes.set_title(title, fontsize=8)
        axes.tick_params(labelsize=7, which="both")
    rows[1, 4].set_xlabel("evaluations of the loss and its gradient; dotted: 2%", fontsize=8)
    figure.tight_layout(pad=0.4, w_pad=0.3, rect=(0.0, 0.0, 1.0, 0.95))
    off = ", ".join(f"{name} x {a / b:.2g}" for name, a, b in zip(NAMES, example.starts[_WORLD], TRUTH, strict=True))
    figure.text(0.01, 0.985, f"above: the first guess, {off}", color=_FIRST, fontsize=10, va="top")
    figure.text(0.4, 0.985, "below: what gradients found", color=_FOUND, fontsize=10, va="top")
    cloud = f"points: the recording, {POINTS} a frame, noise {NOISE * 1e3:g} mm"
    figure.text(0.61, 0.985, cloud, color=_CLOUD, fontsize=10, va="top")
    return figure


def main():
    """Reads the command line, and draws the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("picture", help="File to write, .png or another format of matplotlib.")
    picture = parser.parse_args().picture
    draw(*learn()).savefig(picture)


if __name__ == "__main__":
    main()
