"""Draws who penetrates, where: a grid of simulators and scenes, from what ``warp-bsc bench penetration`` wrote.

    warp-bsc bench penetration --json penetration.json
    python examples/figures/penetration.py penetration.json penetration.png

Several files, each of some scenes, make one picture. A cell of the left grid has the crossings of the worst frame, one
of the right grid the pairs that meet between states. Needs matplotlib (``pip install matplotlib``).
"""

import argparse
import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm

_FREE, _NOT_RUN = "#d9f0d3", "#ececec"
"""Colours of cells without a penetration, and of those that were not run."""


def count(found, quantity):
    """Returns a quantity of each run, shape [simulators, scenes]: NaN where there is no measurement."""
    numbers = np.full((len(found["simulators"]), len(found["scenes"])), np.nan)
    rows, columns = list(found["simulators"]), list(found["scenes"])
    for run in found["runs"]:
        if run["measured"]:
            numbers[rows.index(run["simulator"]), columns.index(run["scene"])] = quantity(run["measured"])
    return numbers


def draw_grid(axes, numbers, title):
    """Draws a grid of numbers, coloured by their logarithm."""
    colors = plt.get_cmap("OrRd")
    norm = LogNorm(0.3, max(10.0, np.nanmax(numbers, initial=1.0)))
    for (row, column), number in np.ndenumerate(numbers):
        missing = np.isnan(number)
        color = _NOT_RUN if missing else _FREE if number == 0.0 else colors(0.85 * norm(number))
        axes.add_patch(plt.Rectangle((column - 0.5, row - 0.5), 1.0, 1.0, facecolor=color, edgecolor="white", lw=2.0))
        dark = not missing and number > 0.0 and norm(number) > 0.8
        text = "not run" if missing else f"{number:,.0f}"
        axes.text(column, row, text, ha="center", va="center", fontsize=9, color="white" if dark else "black")
    axes.set(xlim=(-0.5, numbers.shape[1] - 0.5), ylim=(numbers.shape[0] - 0.5, -0.5))
    axes.set_title(title, fontsize=11, loc="left")
    axes.tick_params(length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)


def join(measurements):
    """Returns measurements of different scenes as one."""
    joined = {"scenes": {}, "simulators": {}, "runs": []}
    for found in measurements:
        joined["scenes"] |= found["scenes"]
        joined["simulators"] |= found["simulators"]
        joined["runs"] += found["runs"]
    return joined


def draw(found, path):
    """Writes the picture of a measurement to a file."""
    titles = [simulator["title"] for simulator in found["simulators"].values()]
    scenes = list(found["scenes"])
    size = 3.2 + 1.8 * len(scenes), 1.2 + 0.36 * len(titles)
    figure, (left, right) = plt.subplots(1, 2, figsize=size, layout="constrained", sharey=True)
    draw_grid(left, count(found, lambda took: max(took["crossings"])), "edges in faces, worst frame")
    draw_grid(right, count(found, lambda took: took["collisions"]), "pairs that meet between states")
    left.set_yticks(range(len(titles)), titles)
    for axes in (left, right):
        axes.set_xticks(range(len(scenes)), scenes)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main():
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("measurements", nargs="+", type=Path, help="JSON of warp-bsc bench penetration")
    parser.add_argument("picture", help="file to write, .png, .svg or .pdf")
    arguments = parser.parse_args()
    draw(join(json.loads(path.read_text()) for path in arguments.measurements), arguments.picture)


if __name__ == "__main__":
    main()
