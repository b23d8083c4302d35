"""Shows the measurements of the paper's benchmarks: tables for people, plain data for programs."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from ..bench import ipc_toolkit
from ..bench.methods import METHODS, STAGES
from ..bench.paper import Place, SceneBenchmark, Timing
from ..bench.provenance import shorten_path
from ..bench.worst_case import WorstQuery
from .tables import count, make_table, say

__all__ = ["paper_benchmarks_to_dict", "print_paper_benchmarks"]

_HEADERS = {
    "float": "float",
    "conservative": "conserv.",
    "exact": "exact",
    "cubic": "cubic",
    "reduced": "reduced",
}
"""Short names of the methods, for the headers of tables."""

_STAGE_NAMES = ("Axis\nboxes", "Bern-\nstein", "Direc-\ntion", "Classi-\nfied", "Subdi-\nvided", "\nExact")


_Rows = list[tuple[str, SceneBenchmark]]
"""Measurements of the scenes with their short names."""


def print_paper_benchmarks(
    console: Console, benchmarks: list[SceneBenchmark], adversarial: list[tuple[Place, dict[str, WorstQuery]]]
) -> None:
    """Prints the measurements, a row a scene.

    Args:
        console: The terminal or file to print to.
        benchmarks: The measurements of each scene.
        adversarial: The slowest adversarial queries at each place, by method.
    """
    rows = [(_short(found.name), found) for found in benchmarks]
    _print_queries(console, rows)
    _print_stages(console, rows)
    for number in range(len(benchmarks[0].timings)):
        _print_times(console, [(name, found.timings[number]) for name, found in rows])
    _print_worst(console, rows, adversarial)
    _print_errors(console, rows)
    _print_frames(console, rows)
    if any(found.ipc_toolkit for found in benchmarks):
        _print_ipc_toolkit(console, rows)
    say(
        console,
        "float, conservative, exact: this project's methods; all that is not certified free is a collision.",
    )
    say(console, "cubic: a floating-point cubic solver, as in Provot 1997, Bridson et al. 2002 and El Topo.")
    say(console, "reduced: float with the inside tests of the paper's Sec. 3.5; like the paper, it does not subdivide.")


def _short(name: str) -> str:
    """Returns the name of a scene without folder and ending."""
    return ",".join(Path(path).stem if "/" in path or path.endswith(".usd") else path for path in name.split(","))


def _print_queries(console: Console, rows: _Rows) -> None:
    table = make_table(
        "Scene",
        "Triangles",
        "Intervals",
        "Overlapping",
        "Queries",
        "Collisions",
        "Unsure",
        caption="Overlapping: pairs whose swept boxes overlap. Queries: a random part of them, measured below.",
    )
    for name, found in rows:
        numbers = [found.triangles, len(found.intervals), found.overlapping, sum(found.queries.values())]
        table.add_row(name, *(f"{number:,}" for number in [*numbers, found.collisions, found.unsure]))
    console.print(table)
    console.print()


def _print_stages(console: Console, rows: _Rows) -> None:
    table = make_table("Decided by", *_STAGE_NAMES, caption="Shares of the queries, with method exact.")
    for name, found in rows:
        total = sum(found.stages.values())
        table.add_row(name, *(f"{found.stages[stage] / total:.2%}" for stage in STAGES))
    console.print(table)
    console.print()


def _print_times(console: Console, rows: list[tuple[str, Timing]]) -> None:
    place = rows[0][1].place
    table = make_table(f"ns a query, {place.name}", *_HEADERS.values(), "cubic /\nfloat", "reduced\n/ float")
    for name, timing in rows:
        took = timing.nanoseconds
        ratios = (f"{took[method] / took['float']:.2f}" for method in ("cubic", "reduced"))
        table.add_row(name, *(f"{took[method]:,.2f}" for method in METHODS), *ratios)
    console.print(table)
    console.print()


def _few_digits(number: float) -> str:
    """Returns a number without fraction, or with two digits if it is small, as times on a GPU are."""
    return f"{number:,.0f}" if number >= 10.0 else f"{number:.2g}"


def _print_worst(console: Console, rows: _Rows, adversarial: list[tuple[Place, dict[str, WorstQuery]]]) -> None:
    for place, adversarial_worst in adversarial:
        found = [(name, timing.worst) for name, scene in rows for timing in scene.timings if timing.place == place]
        found.append(("adversarial", adversarial_worst))
        table = make_table(
            f"Slowest query, ns, {place.name}",
            *_HEADERS.values(),
            "cubic /\nfloat",
            caption="The slowest query of each method. In the paper: float 105, exact 876, El Topo's solver 953.",
        )
        for name, worst in found:
            took = {method: query.nanoseconds[method] for method, query in worst.items()}
            ratio = f"{took['cubic'] / took['float']:.2f}"
            table.add_row(name, *(_few_digits(took[method]) for method in METHODS), ratio)
        console.print(table)
        console.print()
        table = make_table("Slowest of all", "Kind", "Number", *_HEADERS.values())
        for method in METHODS:
            name, query = max(
                ((name, worst[method]) for name, worst in found),
                key=lambda named, method=method: named[1].nanoseconds[method],
            )
            took = (_few_digits(query.nanoseconds[other]) for other in METHODS)
            table.add_row(f"{method}: {name}", query.kind.display_name, str(query.index), *took)
        console.print(table)
        console.print()


def _print_errors(console: Console, rows: _Rows) -> None:
    table = make_table(
        "Wrong results",
        "Checked",
        *_HEADERS.values(),
        caption="False positives + false negatives, of all collisions by any method and a random sample.",
    )
    for name, found in rows:
        wrong = (f"{e.false_positives:,} + {e.false_negatives:,}" for e in (found.errors[m] for m in METHODS))
        table.add_row(name, f"{found.checked:,}", *wrong)
    console.print(table)
    for name, found in rows:
        if found.disagreeing:
            say(console, f"{name}: {count(found.disagreeing, 'result')} depended on the device.")
    console.print()


def _print_frames(console: Console, rows: _Rows) -> None:
    stages = list(rows[0][1].stage_milliseconds)
    place = rows[0][1].timings[-1].place
    headers = ["\n".join(stage.rsplit(" ", 1)) for stage in stages]
    table = make_table(f"ms a frame, {place.name}", *headers, "All", caption="The detector, with method exact.")
    for name, found in rows:
        numbers = [*(found.stage_milliseconds[stage] for stage in stages), found.frame_milliseconds]
        table.add_row(name, *(f"{number:,.2f}" for number in numbers))
    console.print(table)
    console.print()


def _print_ipc_toolkit(console: Console, rows: _Rows) -> None:
    table = make_table(
        f"IPC Toolkit {ipc_toolkit.version()}, 1 core",
        "ns a\nquery",
        "Call,\nns",
        "Checked",
        "False\npos.",
        "False\nneg.",
        caption="Called query by query from Python; the time of a call for features far apart is subtracted.",
    )
    for name, found in rows:
        for method, took in found.ipc_toolkit.items():
            numbers = (took.nanoseconds, took.call_nanoseconds)
            counts = (took.checked, took.false_positives, took.false_negatives)
            table.add_row(f"{name}, {method}", *(f"{number:,.0f}" for number in numbers), *(f"{n:,}" for n in counts))
    console.print(table)
    console.print()


def paper_benchmarks_to_dict(
    benchmarks: list[SceneBenchmark], adversarial: list[tuple[Place, dict[str, WorstQuery]]], *, quick: bool
) -> dict[str, Any]:
    """Returns the measurements as plain data for JSON.

    Args:
        benchmarks: The measurements of each scene.
        adversarial: The slowest adversarial queries at each place, by method.
        quick: Whether only a first look was taken.
    """
    return {
        "benchmark": "paper",
        "quick": quick,
        "methods": list(METHODS),
        "ipc_toolkit": ipc_toolkit.version() if any(found.ipc_toolkit for found in benchmarks) else None,
        "scenes": [_scene_to_dict(found) for found in benchmarks],
        "adversarial": [{"place": place.name, "worst": _worst_to_dict(worst)} for place, worst in adversarial],
    }


def _scene_to_dict(found: SceneBenchmark) -> dict[str, Any]:
    return {
        "scene": shorten_path(found.name),
        "name": _short(found.name),
        "triangles": found.triangles,
        "precision": found.precision,
        "intervals": found.intervals,
        "overlapping": found.overlapping,
        "queries": {kind.label: number for kind, number in found.queries.items()},
        "collisions": found.collisions,
        "unsure": found.unsure,
        "checked": found.checked,
        "sample": found.sample,
        "errors": {method: asdict(errors) for method, errors in found.errors.items()},
        "disagreeing": found.disagreeing,
        "decided_by": found.stages,
        "timings": [_timing_to_dict(timing) for timing in found.timings],
        "stage_milliseconds": found.stage_milliseconds,
        "frame_milliseconds": found.frame_milliseconds,
        "ipc_toolkit": {method: asdict(took) for method, took in found.ipc_toolkit.items()},
    }


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
