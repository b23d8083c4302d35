"""Shows the measurements of scenes in contact: a table for each scene for people, plain data for programs."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import warp as wp
from rich.console import Console
from rich.text import Text

from ..bench.response import CONVERGED, EARLY_STEPS, WARM_UP, ResponseMeasurement, ResponseRun
from .tables import count, make_table, say

__all__ = ["print_response_runs", "response_runs_to_dict"]

_HEADERS = (
    "Stretch\nat end\n[%]",
    "at\nmost\n[%]",
    "Speed\nat end\n[mm/s]",
    "Energy\ngained\n[J]",
    "Cross-\nings",
    "Pairs\nmeet",
    "A step:\nmedian\n[ms]",
    "\nmean\n[ms]",
)
_WIDTHS = 14, 7, 7, 6, 7, 6, 6, 7, 6


def print_response_runs(console: Console, runs: Sequence[ResponseRun], *, device: wp.Device, partial: bool) -> None:
    """Prints a table for each scene, a row a run, and below it why runs are missing.

    Args:
        console: The terminal or file to print to.
        runs: The runs, those of a scene one after another.
        device: The Warp device.
        partial: Whether the command was interrupted before all runs were complete.
    """
    say(console, f"Contact on {device}, {device.name}; times of a step without the first {WARM_UP}")
    for scene in dict.fromkeys(run.scene for run in runs):
        console.print()
        _print_scene(console, [run for run in runs if run.scene == scene])
    if partial:
        say(console, "Interrupted: the other runs are missing.")


def response_runs_to_dict(runs: Sequence[ResponseRun], *, device: wp.Device, partial: bool) -> dict[str, Any]:
    """Returns the measurements as plain data for JSON. Arguments: as of :func:`print_response_runs`."""
    return {
        "benchmark": "response",
        "device": str(device),
        "device_name": device.name,
        "steps_left_out": WARM_UP,
        "partial": partial,
        "runs": [
            {
                "scene": run.scene,
                "solver": run.solver,
                "configuration": run.configuration,
                "problem": run.problem,
                "measured": None if run.measured is None else _measurement_to_dict(run.measured),
                "from_converged": _distance_from_converged(run, runs),
            }
            for run in runs
        ],
    }


def _print_scene(console: Console, runs: Sequence[ResponseRun]) -> None:
    """Prints the table of one scene, and the lines below it."""
    table = make_table(f"{runs[0].scene}\n{runs[0].solver}", *_HEADERS)
    for column, width in zip(table.columns, _WIDTHS, strict=True):
        column.min_width = width
    notes = []
    for run in runs:
        table.add_row(*map(Text, (run.configuration, *_make_cells(run.measured))))
        if run.measured is None:
            notes.append(f"{run.configuration}: not run: {run.problem}")
            continue
        if run.measured.uncertified_steps:
            notes.append(f"{run.configuration}: {count(run.measured.uncertified_steps, 'step')} not certified")
        if run.measured.spread:
            spread = run.measured.spread
            notes.append(
                f"{run.configuration}, moved by {spread.distance:g} m: stretch differs by "
                f"{spread.stretch_at_end:.2f} at the end, {spread.stretch_at_most:.2f} at most"
            )
    console.print(table)
    distances = {run.configuration: _distance_from_converged(run, runs) for run in runs}
    shown = [f"{name} {mm:.2f}" for name, mm in distances.items() if mm is not None and name != CONVERGED]
    if shown:
        notes.append(f"Mean distance from {CONVERGED} after {EARLY_STEPS} steps [mm]: {', '.join(shown)}")
    for note in [*_describe_sizes(runs), *notes]:
        say(console, note)


def _make_cells(took: ResponseMeasurement | None) -> list[str]:
    """Returns the cells of a row; empty without a measurement, and where a quantity has no meaning."""
    if took is None:
        return [""] * len(_HEADERS)

    def show(value: float | None, form: str) -> str:
        return "" if value is None else format(value, form)

    def show_digits(value: float, decimals: int) -> str:
        return f"{value:,.{decimals if value < 1000.0 else 0}f}"

    return [
        show_digits(took.stretch_at_end, 2),
        show_digits(took.stretch_at_most, 2),
        show_digits(took.rest_speed, 1),
        show(took.energy_gained, ",.4f"),
        f"{took.crossings:,}",
        show(took.collisions, ","),
        show_digits(took.median, 2),
        show_digits(took.mean, 2),
    ]


def _describe_sizes(runs: Sequence[ResponseRun]) -> list[str]:
    """Returns a line with the size of a scene and the lengths of steps; none if nothing was measured."""
    measured = [run.measured for run in runs if run.measured]
    if not measured:
        return []
    steps = dict.fromkeys(f"{count(took.steps, 'step')} of 1/{took.rate} s" for took in measured)
    sizes = count(measured[0].particles, "particle"), count(measured[0].triangles, "triangle")
    return [", ".join([*sizes, " or ".join(steps)])]


def _distance_from_converged(run: ResponseRun, runs: Sequence[ResponseRun]) -> float | None:
    """Returns how far particles are from those of the converged run of the scene in the mean [mm]; None without it."""
    converged = next((o.measured for o in runs if (o.scene, o.configuration) == (run.scene, CONVERGED)), None)
    return run.measured.distance_from(converged) if run.measured and converged else None


def _measurement_to_dict(took: ResponseMeasurement) -> dict[str, Any]:
    values = asdict(took)
    del values["early"]
    return values | {"milliseconds": {"median": took.median, "mean": took.mean, "worst": max(took.milliseconds)}}
