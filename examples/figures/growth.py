"""Draws how the time of a detection grows with the number of triangles, one line per device.

    warp-bsc bench detector crash:5000 crash:10000 crash:20000 crash:40000 --json > cpu.json
    python examples/figures/growth.py cpu.json growth.png

Several files of times, each of one device, make one picture. For a GPU it shows the times of the CUDA graph.
Needs matplotlib (``pip install matplotlib``).
"""

import argparse
import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import NullLocator

_COLORS = ["#1f77b4", "#76b900", "#d62728", "#9467bd"]
_FITTED = 10.0
"""The fit leaves out meshes this many times smaller than the largest, because small meshes do not fill a GPU."""


class Growth:
    """Times of detections on one device.

    Attributes:
        device: Name of the device.
        triangles: Sizes of the meshes, ascending, shape [n].
        milliseconds: Time of a detection with each mesh [ms], shape [n].
        fitted: Which meshes the fit includes, bool, shape [n].
        exponent: Power of the number of triangles that times grow with, by least squares of the logarithms.
        fit: Times of the fit for the meshes that it includes [ms].
    """

    def __init__(self, benchmark):
        """Reads the output of ``warp-bsc bench detector --json``."""
        cpu = benchmark["device"] == "cpu"
        threads = benchmark["threads"]
        self.device = f"CPU, {threads} core{'s' if threads > 1 else ''}" if cpu else benchmark["device_name"]
        times = sorted(
            (scene["triangles"], scene["milliseconds"]["detect" if cpu else "cuda_graph"])
            for scene in benchmark["scenes"]
        )
        self.triangles, self.milliseconds = np.array(times, dtype=float).T
        self.fitted = self.triangles >= self.triangles[-1] / _FITTED
        x = np.log(self.triangles[self.fitted])
        line = np.polyfit(x, np.log(self.milliseconds[self.fitted]), 1)
        self.exponent = line[0]
        self.fit = np.exp(np.polyval(line, x))


def describe(benchmarks):
    """Returns a title with the scene and the ranges of candidates and hits per triangle."""
    scenes = [scene for benchmark in benchmarks for scene in benchmark["scenes"]]
    parts = []
    for name, digits in (("candidates", 0), ("hits", 2)):
        shares = [scene[name] / scene["triangles"] for scene in scenes]
        parts.append(f"{min(shares):.{digits}f} to {max(shares):.{digits}f} {name}")
    return f"{scenes[0]['scene'].partition(':')[0]}: {' and '.join(parts)} a triangle"


def draw(benchmarks, path):
    """Writes the picture of benchmarks to a file.

    Returns:
        The :class:`Growth` of each benchmark.
    """
    growths = [Growth(benchmark) for benchmark in benchmarks]
    figure, axes = plt.subplots(figsize=(8.0, 4.8), layout="constrained")
    for growth, color in zip(growths, _COLORS, strict=False):
        x, y = growth.triangles, growth.milliseconds
        axes.plot(x, y, "-", color=color, linewidth=1.0, alpha=0.5)
        first = x[growth.fitted][0]
        label = f"{growth.device}: time $\\propto$ triangles$^{{\\,{growth.exponent:.2f}}}$ from {first:,.0f} on"
        axes.plot(x[growth.fitted], growth.fit, color=color, linewidth=2.4, label=label)
        axes.plot(x, y, "o", color=color, markersize=6)
        for i, shift, side in ((0, -9, "right"), (-1, 9, "left")):
            text = f"{y[i]:.3g} ms" if y[i] < 1000.0 else f"{y[i] / 1000.0:.3g} s"
            options = {"textcoords": "offset points", "ha": side, "va": "center", "color": color}
            axes.annotate(text, (x[i], y[i]), (shift, 0), **options)
    axes.set(xscale="log", yscale="log", xlabel="triangles", ylabel="time of a detection [ms]")
    axes.set_xticks(sorted({size for growth in growths for size in growth.triangles}))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(lambda size, _: f"{size / 1e6:.3g} M" if size >= 1e6 else f"{size / 1e3:.3g} K")
    axes.yaxis.set_major_formatter(lambda time, _: f"{time:,g}")
    axes.margins(x=0.16, y=0.12)
    axes.grid(color="#e4e4e4", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(describe(benchmarks), fontsize=11, loc="left")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=120)
    return growths


def main():
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("times", nargs="+", type=Path, help="JSON of warp-bsc bench detector, a file for each device")
    parser.add_argument("picture", help="file to write, .png, .svg or .pdf")
    arguments = parser.parse_args()
    for growth in draw([json.loads(path.read_text()) for path in arguments.times], arguments.picture):
        first, *_, last = growth.triangles[growth.fitted]
        print(f"{growth.device}: exponent {growth.exponent:.3f}, fitted from {first:,.0f} to {last:,.0f} triangles")


if __name__ == "__main__":
    main()
