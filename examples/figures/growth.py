"""Draws the time of a detection over the number of triangles, from what ``warp-bsc bench detector`` wrote.

    warp-bsc bench detector crash:275000 crash:1100000 crash:4400000 crash:17600000 --device cuda:0 --json growth.json
    python examples/figures/growth.py growth.json growth.png

Several files make one curve. Needs matplotlib (``pip install matplotlib``).
"""

import argparse
import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

_BLUE, _GREY = "#2f6fab", "#8a8f98"


def draw(scenes, device, path):
    """Draws the time of a CUDA graph of each scene, and a line in proportion to size through that of 1.1 million."""
    scenes = sorted(scenes, key=lambda scene: scene["triangles"])
    sizes = np.array([scene["triangles"] for scene in scenes]) / 1e6
    times = np.array([scene["milliseconds"]["cuda_graph"] for scene in scenes])
    first = int(np.argmin(np.abs(sizes - 1.1)))
    figure, axes = plt.subplots(figsize=(7.0, 3.6), layout="constrained")
    axes.loglog(
        sizes, times[first] * sizes / sizes[first], "--", color=_GREY, lw=1.2, label="in proportion to triangles"
    )
    axes.loglog(sizes, times, "o-", color=_BLUE, lw=2.0, label=f"all contacts of a crushed tube, {device}")
    for size, time in zip(sizes, times, strict=True):
        axes.annotate(
            f"{time:.3g} ms", (size, time), (-7, 5), textcoords="offset points", ha="right", fontsize=9, color=_BLUE
        )
    axes.set_xticks(sizes, [f"{size:.3g}" for size in sizes])
    axes.minorticks_off()
    axes.set(
        xlabel="million triangles",
        ylabel="one detection in a CUDA graph [ms]",
        xlim=(0.4 * sizes[0], 1.5 * sizes[-1]),
        ylim=(None, 2.0 * times[-1]),
    )
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)


def main():
    """Draws the curve."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("measurements", nargs="+", type=Path, help="what the benchmark wrote")
    parser.add_argument("picture", type=Path, help="file to write")
    arguments = parser.parse_args()
    found = [json.loads(path.read_text()) for path in arguments.measurements]
    draw([scene for one in found for scene in one["scenes"]], found[0]["device_name"], arguments.picture)


if __name__ == "__main__":
    main()
