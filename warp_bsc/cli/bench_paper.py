"""The command ``warp-bsc bench paper``: measures the paper's benchmarks."""

import argparse
import importlib.util
import itertools
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import warp as wp

from .._atomic_file import STDOUT, OutputFile
from ..bench.figure import draw_paper_benchmarks
from ..bench.measure.methods import METHODS, STAGES
from ..bench.measure.paper import (
    Effort,
    Place,
    SceneBenchmark,
    Timing,
    benchmark_scene,
    find_adversarial_worst,
    find_places,
)
from ..bench.measure.worst_case import WorstQuery
from ..bench.peers import ipc_toolkit
from ..bench.record import shorten_path, with_record
from ..bench.scenes.detector import PAPER_SCENES, BenchmarkScene, is_scene_name, load_intervals, paper_scenes
from ..bench.timing import limited_threads
from .bench import JSON_FILE, Benchmark, check_json, open_json, show_progress, stage_columns
from .device import find_device
from .options import THREADS, flag, several
from .tables import Column, Console, count, print_table, say

__all__ = ["BENCHMARK"]

_DESCRIPTION = """\
Measure the paper's five benchmarks, on the candidate pairs of each scene: the
mean and the worst time of a query by this project's methods, by a
floating-point cubic solver, by the paper's own inside tests and, if installed,
by the IPC Toolkit's methods; the wrong results of each, found by exact
arithmetic; the stages that decide the queries; and the time of a detection by
stage. A scene is one of the five by name, or a scene of warp-bsc bench
detector. All five together need several minutes, with --quick one or two."""

_EXAMPLES = """\
  warp-bsc bench
  warp-bsc bench --quick
  warp-bsc bench paper twisting crash:100000 --json times.json
  warp-bsc bench paper cloth.usd --device cpu --figure times.png"""

_FIGURES = (".png", ".svg", ".pdf")

_Adversarial = list[tuple[Place, dict[str, WorstQuery]]]
"""The slowest adversarial queries at each place, by method."""


def _few_digits(number: float) -> str:
    """Returns a number without fraction, or with two digits if it is small, as times on a GPU are."""
    return f"{number:,.0f}" if number >= 10.0 else f"{number:.2g}"


def _method_columns(
    value: Callable[[Any, str], Any], format: str | Callable[[Any], str], *ratios: tuple[str, str]
) -> tuple[Column, ...]:
    """Returns a column for each method, and one for each ratio of two.

    Args:
        value: Returns what a column shows, given a row and a method.
        format: How it shows that.
        ratios: The methods whose values are divided by those of ``float``, with the headers.
    """
    columns = [
        Column(method.replace("conservative", "conserv."), lambda row, method=method: value(row, method), format)
        for method in METHODS
    ]
    columns += [
        Column(header, lambda row, method=method: value(row, method) / value(row, "float"), ".2f")
        for method, header in ratios
    ]
    return tuple(columns)


_QUERIES = (
    Column("Triangles", "triangles"),
    Column("Intervals", lambda found: len(found.intervals)),
    Column("Overlapping", "overlapping"),
    Column("Queries", lambda found: sum(found.queries.values())),
    Column("Collisions", "collisions"),
    Column("Unsure", "unsure"),
)
_STAGE_NAMES = ("Axis\nboxes", "Bern-\nstein", "Direc-\ntion", "Classi-\nfied", "Subdi-\nvided", "\nExact")
_SHARES = tuple(
    Column(header, lambda found, stage=stage: found.stages[stage] / sum(found.stages.values()), ".2%")
    for stage, header in zip(STAGES, _STAGE_NAMES, strict=True)
)
_TIMES = _method_columns(
    lambda timing, method: timing.nanoseconds[method],
    ",.2f",
    ("cubic", "cubic /\nfloat"),
    ("reduced", "reduced\n/ float"),
)
_SLOWEST = _method_columns(  # of the slowest query of each method
    lambda worst, method: worst[method].nanoseconds[method], _few_digits, ("cubic", "cubic /\nfloat")
)
_SLOWEST_OF_ALL = (
    Column("Kind", lambda query: query.kind.display_name, ""),
    Column("Number", "index", ""),
    *_method_columns(lambda query, method: query.nanoseconds[method], _few_digits),
)
_ERRORS = (
    Column("Checked", "checked"),
    *_method_columns(
        lambda found, method: found.errors[method], lambda e: f"{e.false_positives:,} + {e.false_negatives:,}"
    ),
)
_IPC_TOOLKIT = (
    Column("ns a\nquery", "nanoseconds", ",.0f"),
    Column("Call,\nns", "call_nanoseconds", ",.0f"),
    Column("Checked", "checked"),
    Column("False\npos.", "false_positives"),
    Column("False\nneg.", "false_negatives"),
)


def _run(arguments: argparse.Namespace) -> None:
    _check(arguments)
    effort = Effort.quick() if arguments.quick else Effort.full()
    known = dict(zip(PAPER_SCENES, paper_scenes(), strict=True)) if _needs_assets(arguments.scenes) else {}
    names = [known.get(name, name) for name in arguments.scenes or known]
    if arguments.device is None:
        find_device(None)
        devices = [wp.get_device("cpu"), *wp.get_cuda_devices()[:1]]
    else:
        devices = [find_device(arguments.device)]
    figure = OutputFile(arguments.figure) if arguments.figure else None  # fails before anything is measured
    try:
        with open_json(arguments.json) as write:
            scenes = [(name, load_intervals(name, most=effort.intervals)) for name in names]
            with limited_threads(arguments.threads):
                places = find_places(devices)
                benchmarks = _measure(scenes, places, effort)
                adversarial = find_adversarial_worst(places, effort)
            found = _to_dict(benchmarks, adversarial, quick=arguments.quick)
            found = with_record(found, arguments.command_line, devices)
            if arguments.json != STDOUT:
                _show(Console(), benchmarks, adversarial)
            write(found)
            if figure:
                draw_paper_benchmarks([found], arguments.figure)
    finally:
        if figure:
            figure.discard()


def _check(arguments: argparse.Namespace) -> None:
    """Raises ValueError for options that would fail only after everything has been measured."""
    if arguments.figure:
        if Path(arguments.figure).suffix not in _FIGURES:
            raise ValueError(f"--figure {arguments.figure}: its name must end in one of {', '.join(_FIGURES)}")
        if importlib.util.find_spec("matplotlib") is None:
            raise ValueError("--figure needs matplotlib: pip install 'warp-bsc[bench]'")
    check_json(arguments.json, is_scene_name, "a scene", "scenes")


def _needs_assets(names: list[str]) -> bool:
    return not names or any(name in PAPER_SCENES for name in names)


def _measure(
    scenes: list[tuple[str, list[tuple[int, BenchmarkScene]]]], places: list[Place], effort: Effort
) -> list[SceneBenchmark]:
    """Measures scene by scene, with a progress bar on standard error."""
    compare = ipc_toolkit.is_installed()
    parts = 4 + len({str(place.device) for place in places}) + len(places) + 2 * compare
    benchmarks = []
    with show_progress(parts * len(scenes)) as (_, show):
        for number, (name, intervals) in enumerate(scenes):
            done = itertools.count(parts * number)

            def show_part(part: str, name: str = name, done: Iterator[int] = done) -> None:
                show(next(done), f"{Path(name).stem}: {part}")

            benchmarks.append(benchmark_scene(name, intervals, places, effort, compare=compare, progress=show_part))
    return benchmarks


def _show(console: Console, benchmarks: list[SceneBenchmark], adversarial: _Adversarial) -> None:
    """Prints the measurements, a row a scene."""
    rows = [(_short(found.name), found) for found in benchmarks]
    caption = "Overlapping: pairs whose swept boxes overlap. Queries: a random part of them, measured below."
    print_table(console, "Scene", _QUERIES, rows, caption=caption)
    console.print()
    print_table(console, "Decided by", _SHARES, rows, caption="Shares of the queries, with method exact.")
    console.print()
    for number, timing in enumerate(benchmarks[0].timings):
        timings = [(name, found.timings[number]) for name, found in rows]
        print_table(console, f"ns a query, {timing.place.name}", _TIMES, timings)
        console.print()
    for place, worst in adversarial:
        slowest = [(name, timing.worst) for name, found in rows for timing in found.timings if timing.place == place]
        _show_slowest(console, place, [*slowest, ("adversarial", worst)])
    caption = "False positives + false negatives, of all collisions by any method and a random sample."
    print_table(console, "Wrong results", _ERRORS, rows, caption=caption)
    for name, found in rows:
        if found.disagreeing:
            say(console, f"{name}: {count(found.disagreeing, 'result')} depended on the device.")
    console.print()
    frames = [*stage_columns(benchmarks), Column("All", "frame_milliseconds", ",.2f")]
    place = benchmarks[0].timings[-1].place
    print_table(console, f"ms a frame, {place.name}", frames, rows, caption="The detector, with method exact.")
    console.print()
    if took := [(f"{name}, {method}", took) for name, found in rows for method, took in found.ipc_toolkit.items()]:
        caption = "Called query by query from Python; the time of a call for features far apart is subtracted."
        print_table(console, f"IPC Toolkit {ipc_toolkit.version()}, 1 core", _IPC_TOOLKIT, took, caption=caption)
        console.print()
    say(console, "float, conservative, exact: this project's methods; all that is not certified free is a collision.")
    say(console, "cubic: a floating-point cubic solver, as in Provot 1997, Bridson et al. 2002 and El Topo.")
    say(console, "reduced: float with the inside tests of the paper's Sec. 3.5; like the paper, it does not subdivide.")


def _show_slowest(console: Console, place: Place, slowest: list[tuple[str, dict[str, WorstQuery]]]) -> None:
    """Prints the slowest queries at a place, of each scene and of all."""
    caption = "The slowest query of each method. In the paper: float 105, exact 876, El Topo's solver 953."
    print_table(console, f"Slowest query, ns, {place.name}", _SLOWEST, slowest, caption=caption)
    console.print()
    rows = []
    for method in METHODS:
        name, worst = max(slowest, key=lambda named, method=method: named[1][method].nanoseconds[method])
        rows.append((f"{method}: {name}", worst[method]))
    print_table(console, "Slowest of all", _SLOWEST_OF_ALL, rows)
    console.print()


def _short(name: str) -> str:
    """Returns the name of a scene without folder and ending."""
    return ",".join(Path(path).stem if "/" in path or path.endswith(".usd") else path for path in name.split(","))


def _to_dict(benchmarks: list[SceneBenchmark], adversarial: _Adversarial, *, quick: bool) -> dict[str, Any]:
    """Returns the measurements as plain data for JSON."""
    return {
        "benchmark": "paper",
        "quick": quick,
        "methods": list(METHODS),
        "ipc_toolkit": ipc_toolkit.version() if any(found.ipc_toolkit for found in benchmarks) else None,
        "scenes": [_scene_to_dict(found) for found in benchmarks],
        "adversarial": [{"place": place.name, "worst": _worst_to_dict(worst)} for place, worst in adversarial],
    }


def _scene_to_dict(found: SceneBenchmark) -> dict[str, Any]:
    fields = vars(found) | {
        "scene": shorten_path(found.name),
        "name": _short(found.name),
        "queries": {kind.label: number for kind, number in found.queries.items()},
        "errors": {method: asdict(errors) for method, errors in found.errors.items()},
        "timings": [_timing_to_dict(timing) for timing in found.timings],
        "ipc_toolkit": {method: asdict(took) for method, took in found.ipc_toolkit.items()},
    }
    fields["decided_by"] = fields.pop("stages")
    return fields


def _timing_to_dict(timing: Timing) -> dict[str, Any]:
    return {
        "place": timing.place.name,
        "device": str(timing.place.device),
        "device_name": timing.place.device.name,
        "cores": timing.place.cores,
        "nanoseconds": timing.nanoseconds,
        "worst": _worst_to_dict(timing.worst),
    }


def _worst_to_dict(worst: dict[str, WorstQuery]) -> dict[str, Any]:
    return {
        method: {
            "kind": query.kind.label,
            "number": query.index,
            "points": query.points.tolist(),
            "nanoseconds": query.nanoseconds,
        }
        for method, query in worst.items()
    }


BENCHMARK = Benchmark(
    _run,
    _DESCRIPTION,
    _EXAMPLES,
    {
        "scenes": several("SCENE", "the scenes to measure (default: the paper's five)"),
        "--quick": flag("measure only a few intervals and queries"),
        "--device": {
            "help": "Warp device, such as cpu or cuda:0 (default: the CPU, and the first GPU if there is one)"
        },
        **JSON_FILE,
        "--figure": {"metavar": "FILE", "help": "draw the paper's Figure 7: .png, .svg or .pdf; needs matplotlib"},
        **THREADS,
    },
)
