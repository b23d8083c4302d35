"""Shows the measurements of Newton's examples: tables for people, plain data for programs."""

from dataclasses import asdict
from typing import Any

import warp as wp
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ..bench.newton_examples import WARM_UP, ExampleMeasurement, ExampleRun, NewtonExample, describe_needs
from .tables import make_table, say

__all__ = ["example_runs_to_dict", "print_example_runs", "print_examples"]


def print_examples(console: Console, examples: list[NewtonExample]) -> None:
    """Prints the names of examples, their folders, and what they need.

    Args:
        console: The terminal or file to print to.
        examples: The examples.
    """
    table = make_table("Example")
    _add_text_column(table, "Folder")
    _add_text_column(table, "Needs")
    for example in examples:
        needs = "; ".join(describe_needs(example))
        table.add_row(*map(Text, (example.title, example.module.split(".")[2], needs)))
    console.print(table)


def print_example_runs(console: Console, runs: list[ExampleRun], *, device: wp.Device, partial: bool) -> None:
    """Prints the times, the crossings and the tests of examples, a row a run, and the reports of stages.

    Args:
        console: The terminal or file to print to.
        runs: The runs.
        device: The Warp device.
        partial: Whether the command was interrupted before all runs were complete.
    """
    say(console, f"Newton's examples on {device}, {device.name}; times of a frame without the first {WARM_UP}")
    caption = "Crossings of cloth and soft bodies: at the start, and the most at a checked frame end."
    table = make_table("Example", caption=caption)
    _add_text_column(table, "Mode", no_wrap=True)
    for header in ("Median\n[ms]", "95%\n[ms]", "Worst\n[ms]", "Cross-\nings at\nstart", "At\nmost"):
        table.add_column(Text(header), justify="right", no_wrap=True)
    _add_text_column(table, "Its tests", no_wrap=True)
    notes = []
    for run in runs:
        took = run.measured
        if took is None:
            cells, result, remarks = [""] * 5, "not run", [run.problem or ""]
        else:
            cells = [f"{milliseconds:,.1f}" for milliseconds in (took.median, took.percentile_95, took.worst)]
            cells += [f"{number:,}" for number in (took.crossings_at_start, took.most_crossings)]
            remarks = _find_failures(took)
            result = "fail" if remarks else took.test_final or "none"
        table.add_row(*map(Text, (run.example, run.mode, *cells, result)))
        notes += [f"{run.example}, {run.mode}: {remark}" for remark in remarks]
    console.print(table)
    for note in notes:
        say(console, note)

    sizes: dict[str, ExampleMeasurement] = {}
    for run in runs:
        name = f"{run.example}, implicit" if run.mode == "implicit" else run.example
        if run.measured and (run.measured.stage or name not in sizes):
            sizes[name] = run.measured
    if sizes:
        console.print()
        stage = ("Steps", "Uncer-\ntified", "Trun-\ncated", "Frozen")
        caption = "Steps: all, not certified, with paths truncated, with vertices frozen."
        table = make_table("Example", "Partic-\nles", "Trian-\ngles", "Frames", *stage, caption=caption)
        for name, took in sizes.items():
            counts = [took.particles, took.triangles, took.frames, *(asdict(took.stage).values() if took.stage else ())]
            table.add_row(Text(name), *(f"{number:,}" for number in counts))
        console.print(table)
    if partial:
        say(console, "Interrupted: the other runs are missing.")


def example_runs_to_dict(runs: list[ExampleRun], *, device: wp.Device, partial: bool) -> dict[str, Any]:
    """Returns the measurements as plain data for JSON. Arguments: as of :func:`print_example_runs`."""
    return {
        "benchmark": "newton",
        "device": str(device),
        "device_name": device.name,
        "frames_left_out": WARM_UP,
        "partial": partial,
        "runs": [
            {
                "example": run.example,
                "mode": run.mode,
                "problem": run.problem,
                "measured": None if run.measured is None else _measurement_to_dict(run.measured),
            }
            for run in runs
        ],
    }


def _measurement_to_dict(took: ExampleMeasurement) -> dict[str, Any]:
    values = asdict(took)
    milliseconds = {
        "median": took.median,
        "percentile_95": took.percentile_95,
        "worst": took.worst,
        "frames": values.pop("frame_milliseconds"),
    }
    return values | {"milliseconds": milliseconds}


def _find_failures(took: ExampleMeasurement) -> list[str]:
    """Returns the messages of an example's tests that failed, and the frame at which positions were not finite."""
    failures = [f"test_post_step: {took.test_post_step}"] if took.test_post_step not in (None, "ok") else []
    failures += [f"test_final: {took.test_final}"] if took.test_final not in (None, "ok") else []
    if took.first_frame_not_finite is not None:
        failures.append(f"positions are not finite at the end of frame {took.first_frame_not_finite}")
    return failures


def _add_text_column(table: Table, header: str, *, no_wrap: bool = False) -> None:
    table.add_column(header, no_wrap=no_wrap, overflow="fold")
