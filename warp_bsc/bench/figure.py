"""Draws the paper's benchmarks in the layout of its Figure 7: bars for each scene, one for each method."""

import os
from typing import Any

import numpy as np

_METHODS = {
    "exact": ("exact", "#1b6ca8"),
    "conservative": ("conservative", "#58a4d4"),
    "float": ("float", "#76b900"),
    "reduced": ("float, the paper's inside tests", "#c9d98f"),
    "cubic": ("cubic solver", "#d6604d"),
}
_IPC_METHODS = {"additive": ("Additive CCD", "#b2abd2"), "tight inclusion": ("Tight Inclusion", "#7b6ca8")}
_WIDTH = 0.84
_ABOVE_BAR = {"textcoords": "offset points", "ha": "center", "va": "bottom", "rotation": 90, "fontsize": 7}


def draw_paper_benchmarks(benchmarks: list[dict[str, Any]], path: str | os.PathLike) -> None:
    """Writes a figure of the mean times of a query, one panel for each place at which methods were timed.

    Args:
        benchmarks: The JSON of runs of ``warp-bsc bench --json``, such as one on the CPU and one on a GPU.
        path: The file to write, .png, .svg or .pdf.

    Raises:
        ValueError: If the JSON is that of another benchmark, or the format of the file is unknown.
    """
    import matplotlib  # noqa: PLC0415 (optional)

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt  # noqa: PLC0415

    panels = {}
    for benchmark in benchmarks:
        if benchmark.get("benchmark") != "paper":
            raise ValueError("a figure needs the JSON of warp-bsc bench paper, not of another benchmark")
        for scene in benchmark["scenes"]:
            for timing in scene["timings"]:
                bars = dict(timing["nanoseconds"])
                if timing["cores"] == 1:
                    bars |= {method: took["nanoseconds"] for method, took in scene["ipc_toolkit"].items()}
                panels.setdefault(timing["place"], {})[scene["name"]] = bars
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(6.4 * columns, 3.9 * rows), layout="constrained", squeeze=False)
    shown = {}
    for place_axes, (place, scenes) in zip(axes.flat, panels.items(), strict=False):
        shown |= _draw_panel(place_axes, place, scenes)
    for unused in axes.flat[len(panels) :]:
        unused.set_visible(False)
    named = {name: shown[name] for name, _ in (*_METHODS.values(), *_IPC_METHODS.values()) if name in shown}
    figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _draw_panel(axes, place, scenes):
    """Draws the bars of one place; returns those of each method by its name."""
    from matplotlib.ticker import NullFormatter  # noqa: PLC0415 (optional)

    methods = {
        key: style for key, style in (_METHODS | _IPC_METHODS).items() if any(key in bars for bars in scenes.values())
    }
    width = _WIDTH / len(methods)
    shown = {}
    for number, (key, (name, color)) in enumerate(methods.items()):
        x = np.arange(len(scenes)) + (number - 0.5 * (len(methods) - 1)) * width
        times = np.array([bars.get(key, np.nan) for bars in scenes.values()])
        shown[name] = axes.bar(x, times, 0.9 * width, color=color)
        for at, took in zip(x, times, strict=True):
            if np.isfinite(took) and took > 0.0:
                text = f"{took:,.0f}" if took >= 10.0 else f"{took:.2g}"
                axes.annotate(text, (at, took), (0, 2), **_ABOVE_BAR)
    axes.set(yscale="log", ylabel="time a query [ns]")
    axes.set_xticks(range(len(scenes)), scenes.keys())
    times = [took for bars in scenes.values() for took in bars.values() if took > 0.0]
    axes.set_ylim(10.0 ** np.floor(np.log10(0.8 * min(times))), 10.0 ** np.ceil(np.log10(2.0 * max(times))))
    axes.yaxis.set_major_formatter(lambda time, _: f"{time:,.0f}" if time >= 1.0 else f"{time:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(axis="y", color="#e4e4e4", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(place, fontsize=11, loc="left")
    return shown
