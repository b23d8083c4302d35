"""Draws the throws that the example Diffsim Throw finds with contacts and without them.

    python examples/figures/throw.py throw.png

Needs matplotlib (``pip install matplotlib``).
"""

import argparse
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import newton.viewer
import numpy as np
from rich.progress import track

sys.path.append(str(Path(__file__).parents[1]))  # for the example
from example_diffsim_throw import MARK, STARTS, Example

_COLORS = "#2f6fb3", "#e07a2f", "#3a9a5b"


def learn(ccd):
    """Returns the example after all evaluations, and the paths of the first one."""
    args = Example.create_parser().parse_args(["--viewer", "null", "--ccd" if ccd else "--no-ccd"])
    example = Example(newton.viewer.ViewerNull(), args)
    for evaluation in track(range(Example.num_frames), "with contacts" if ccd else "without"):
        example.step()
        if evaluation == 0:
            first = example.path()
    return example, first


def draw_paths(axes, example, first):
    """Draws the sheet, the mark and the paths from the side."""
    rest = example.model.particle_q.numpy()
    sheet = rest[example.shares.numpy() == 0]
    low, high = sheet[sheet[:, 2].argmin()], sheet[sheet[:, 2].argmax()]
    axes.plot([low[0], high[0]], [low[2], high[2]], color="#555555", linewidth=3.0, label="sheet")
    found = example.path()
    for world, color in enumerate(_COLORS):
        axes.plot(first[:, world, 0], first[:, world, 2], color=color, linestyle=":", linewidth=1.3)
        axes.plot(found[:, world, 0], found[:, world, 2], color=color, linewidth=1.8)
        axes.plot(*found[-1, world, [0, 2]], "o", color=color, markersize=4)
    axes.plot(MARK[0], MARK[2], "*", color="#c22f3d", markersize=15, label="mark", zorder=5)
    right, bottom = (0.6, -0.7) if example.ccd else (1.6, -1.3)
    axes.set(xlabel="x [m]", ylabel="z [m]", xlim=(-1.1, right), ylim=(bottom, 0.75))
    axes.set_aspect("equal")
    axes.legend(loc="lower left", fontsize=8, frameon=False)


def main():
    """Reads the command line, and draws the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("picture", help="File to write, .png or another format of matplotlib.")
    picture = parser.parse_args().picture
    figure, axes = plt.subplots(1, 3, figsize=(12.0, 3.7), dpi=110, width_ratios=(3.0, 2.6, 2.9))
    for column, ccd in enumerate((False, True)):
        example, first = learn(ccd)
        draw_paths(axes[column], example, first)
        axes[column].set_title(
            "with them: a bounce" if ccd else "without contacts: the cube flies through the sheet", fontsize=10
        )
        losses = np.array(example.loss_history)
        losses[losses == 0.0] = np.nan  # nothing is left in float32
        for world, color in enumerate(_COLORS):
            start = ", ".join(f"{v:g}" for v in STARTS[world])
            label = f"begins at ({start}) m/s" if ccd else None
            line = {"color": color, "linestyle": "-" if ccd else "--", "linewidth": 1.5, "label": label}
            axes[2].plot(1 + np.arange(len(losses)), losses[:, world], **line)
    axes[2].plot([], [], color="#555555", linestyle="--", label="without contacts")
    axes[2].set(xlabel="evaluation", ylabel="loss", yscale="log", ylim=(1e-9, 4.0))
    axes[2].legend(fontsize=7, frameon=False, loc="lower left")
    axes[2].set_title("loss: 0 on the mark, 1 far from it", fontsize=10)
    figure.tight_layout()
    figure.savefig(picture)


if __name__ == "__main__":
    main()
