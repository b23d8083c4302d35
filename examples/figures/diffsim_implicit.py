"""Draws what examples with gradients of SolverImplicit begin with and what they find, as film strips, and distances.

    python examples/figures/diffsim_implicit.py diffsim_implicit.png

Takes as long as the three examples. Needs matplotlib (``pip install matplotlib``).
"""

import argparse
import importlib
import sys
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import newton.viewer
import numpy as np
import trimesh
from matplotlib.colors import to_rgb
from rich.progress import track

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1])]  # for the other figures and the examples
from scenes import View, shade

_FIRST, _FOUND, _RIGID = "#e07a2f", "#2f6fb3", "#b9b4ae"
_COLORS = "#2f6fb3", "#c22f3d", "#3a9a5b"


class Strip(NamedTuple):
    """How an example is drawn.

    Attributes:
        title: What it does.
        world: The start that is drawn.
        frames: The frames that are drawn.
        behind: How far the first motion is behind the found one [m].
        view: The view.
    """

    title: str
    world: int
    frames: tuple[int, ...]
    behind: float
    view: View


_STRIPS = {
    "identify": Strip(
        "how stiff a cloth is", 1, (0, 10, 20, 30, 120), 0.75, View(0, "", 14.0, -72.0, (0.12, 0.62, -0.17), 0.92, 1.3)
    ),
    "towel": Strip(
        "a throw over a bar", 2, (0, 12, 22, 30, 48), 0.7, View(0, "", 12.0, -80.0, (-0.28, 0.35, 0.02), 1.08, 1.3)
    ),
    "fold": Strip(
        "a path that folds a cloth", 0, (0, 10, 18, 25, 40), 0.6, View(0, "", 28.0, -76.0, (0.0, 0.3, 0.06), 0.84, 1.3)
    ),
}


class Learnt(NamedTuple):
    """What is drawn of an example: positions [steps + 1, worlds, particles, 3], distances [evaluations, worlds]."""

    first: np.ndarray
    found: np.ndarray
    distances: np.ndarray
    faces: np.ndarray


def learn(name):
    """Runs an example."""
    example_class = importlib.import_module(f"example_diffsim_{name}").Example
    args = example_class.create_parser().parse_args(["--viewer", "null"])
    example = example_class(newton.viewer.ViewerNull(), args)
    for evaluation in track(range(example.num_frames), name):
        example.step()
        if evaluation == 0:
            first = example.positions()
    faces = example.model.tri_indices.numpy()[: example.model.tri_count // example.worlds]
    return Learnt(first, example.motion, np.sqrt(example.loss_history), faces)


def rigid_parts(name, behind):
    """Returns the meshes that cloths touch: a bar, or the ground."""
    if name == "identify":
        return []
    if name == "fold":
        ground = trimesh.creation.box((0.9, 0.5 + behind, 0.01)).apply_translation([0.0, 0.5 * behind, -0.005])
        return [ground.subdivide().subdivide().subdivide()]
    bar = trimesh.creation.cylinder(0.03, 0.56).apply_transform(
        trimesh.transformations.rotation_matrix(0.5 * np.pi, [1.0, 0.0, 0.0])
    )
    return [bar, bar.copy().apply_translation([0.0, behind, 0.0])]


def picture_of(name, learnt, strip, frame):
    """Returns the picture of a frame: the found motion in front, the first one behind it."""
    cloths = (learnt.found, _FOUND, 0.0), (learnt.first, _FIRST, strip.behind)
    parts = [(motion[frame, strip.world] + [0.0, behind, 0.0], learnt.faces, color) for motion, color, behind in cloths]
    parts += [(np.asarray(mesh.vertices), mesh.faces, _RIGID) for mesh in rigid_parts(name, strip.behind)]
    offsets = np.cumsum([0, *(len(x) for x, _, _ in parts)])
    x = np.concatenate([x for x, _, _ in parts]).astype(float)
    faces = np.concatenate([faces + offset for (_, faces, _), offset in zip(parts, offsets, strict=False)])
    colors = np.concatenate([np.tile(to_rgb(color), (len(faces), 1)) for _, faces, color in parts])
    return shade(x, faces, colors, strip.view)


def draw(learnt):
    """Returns the figure of what was learnt, by the names of the examples."""
    figure, rows = plt.subplots(3, 6, figsize=(13.0, 6.6), dpi=90, width_ratios=[1.3] * 5 + [1.5])
    for row, (name, strip) in zip(rows, _STRIPS.items(), strict=True):
        for axes, frame in zip(row, strip.frames, strict=False):
            axes.imshow(picture_of(name, learnt[name], strip, frame))
            axes.set_title(f"{frame / 60.0:.2f} s", fontsize=8, pad=2)
            axes.set_axis_off()
        row[0].text(0.0, 1.16, strip.title, transform=row[0].transAxes, fontsize=11)
        distances = np.minimum.accumulate(learnt[name].distances)
        for world, color in enumerate(_COLORS):
            row[-1].plot(1 + np.arange(len(distances)), distances[:, world], color=color, linewidth=1.5)
        row[-1].set_yscale("log")
        row[-1].set_title("least distance from the target [m]", fontsize=8)
        row[-1].tick_params(labelsize=7, which="both")
    rows[-1, -1].set_xlabel("evaluations, from three starts", fontsize=8)
    figure.tight_layout(pad=0.4, w_pad=0.3)
    figure.text(0.34, 0.985, "front, blue: what gradients found", color=_FOUND, fontsize=10, va="top")
    figure.text(0.56, 0.985, "behind, orange: the first guess", color=_FIRST, fontsize=10, va="top")
    return figure


def main():
    """Reads the command line, and draws the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("picture", help="File to write, .png or another format of matplotlib.")
    picture = parser.parse_args().picture
    draw({name: learn(name) for name in _STRIPS}).savefig(picture)


if __name__ == "__main__":
    main()
