"""Shows what simulators made of the same scenes: a table for each scene for people, plain data for programs."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import warp as wp
from rich.console import Console
from rich.text import Text

from ..bench.penetration import SCENES, SIMULATORS, WARM_UP, PenetrationMeasurement, PenetrationRun
from .tables import count, make_table, say

__all__ = ["penetration_runs_to_dict", "print_penetration_runs"]

_HEADERS = (
    "Cross-\nings\nworst",
    "\n\nsum",
    "Met\non the\nway",
    "In-\nver-\nted",
    "Speed\nkept\n[%]",
    "Stretch\n\n[%]",
    "Step\n\n[ms]",
)


def print_penetration_runs(
    console: Console, runs: Sequence[PenetrationRun], *, device: wp.Device, partial: bool
) -> None:
    """Prints a table for each scene, a row a simulator, and below them versions and claims.

    Args:
        console: The terminal or file to print to.
        runs: The runs, those of a scene one after another.
        device: The Warp device of Newton's solvers.
        partial: Whether the command was interrupted before all runs were complete.
    """
    say(
        console,
        f"Penetration, Newton's solvers on {device}, {device.name}; medians of a step without the first {WARM_UP}",
    )
    for scene in dict.fromkeys(run.scene for run in runs):
        console.print()
        _print_scene(console, scene, [run for run in runs if run.scene == scene])
    console.print()
    say(console, "Crossings: edges through faces at frame ends, in the worst frame and in all together.")
    say(console, "Met on the way: pairs that meet on the straight way from a state to the next, in all steps.")
    say(console, "Inverted: tetrahedra in the worst frame. Speed kept: of a free flight before anything is met.")
    for name in dict.fromkeys(run.simulator for run in runs if run.measured):
        simulator = SIMULATORS[name]
        claims = f"claims: {simulator.claims}" if simulator.claims else "claims nothing of penetration"
        version = next(run.measured.version for run in runs if run.simulator == name and run.measured)
        say(console, f"{simulator.title}: {simulator.package} {version}; {simulator.settings}; {claims}.")
    if partial:
        say(console, "Interrupted: the other runs are missing.")


def penetration_runs_to_dict(runs: Sequence[PenetrationRun], *, device: wp.Device, partial: bool) -> dict[str, Any]:
    """Returns the measurements as plain data for JSON. Arguments: as of :func:`print_penetration_runs`."""
    return {
        "benchmark": "penetration",
        "device": str(device),
        "device_name": device.name,
        "steps_left_out": WARM_UP,
        "partial": partial,
        "scenes": {name: SCENES[name] for name in dict.fromkeys(run.scene for run in runs)},
        "simulators": {name: asdict(SIMULATORS[name]) for name in dict.fromkeys(run.simulator for run in runs)},
        "runs": [
            {
                "scene": run.scene,
                "simulator": run.simulator,
                "problem": run.problem,
                "measured": None if run.measured is None else _measurement_to_dict(run.measured),
            }
            for run in runs
        ],
    }


def _print_scene(console: Console, scene: str, runs: Sequence[PenetrationRun]) -> None:
    """Prints the table of one scene, and the lines below it."""
    table = make_table(scene, *_HEADERS)
    table.columns[0].width = 20
    for column, width in zip(table.columns[1:], (6, 9, 10, 5, 5, 9, 8), strict=True):
        column.width = width
    notes = []
    for run in runs:
        title = SIMULATORS[run.simulator].title
        table.add_row(*map(Text, (title, *_make_cells(run.measured))))
        took = run.measured
        if took is None:
            notes.append(f"{title}: not run: {run.problem}")
        elif took.uncertified_steps:
            notes.append(f"{title}: {count(took.uncertified_steps, 'step')} of {took.steps:,} not certified")
    console.print(table)
    sizes = next((run.measured for run in runs if run.measured), None)
    if sizes:
        parts = count(sizes.particles, "particle"), count(sizes.triangles, "triangle"), count(sizes.frames, "frame")
        say(console, f"{SCENES[scene].capitalize()}: {', '.join(parts)}")
    for note in notes:
        say(console, note)


def _make_cells(took: PenetrationMeasurement | None) -> list[str]:
    """Returns the cells of a row; empty without a measurement, and where a quantity has no meaning."""
    if took is None:
        return [""] * len(_HEADERS)
    return [
        f"{max(took.crossings):,}",
        f"{sum(took.crossings):,}",
        f"{took.collisions:,}",
        f"{max(took.inverted):,}",
        "" if took.speed_kept is None else f"{100.0 * took.speed_kept:.1f}",
        f"{took.stretch:,.1f}",
        f"{took.milliseconds[0]:,.2f}",
    ]


def _measurement_to_dict(took: PenetrationMeasurement) -> dict[str, Any]:
    median, mean = took.milliseconds
    return asdict(took) | {"milliseconds": {"median": median, "mean": mean}}
