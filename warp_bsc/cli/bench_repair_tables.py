"""Shows the measurements of repairs: tables for people, plain data for programs."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import warp as wp
from rich.console import Console
from rich.text import Text

from ..bench import ipc_toolkit
from ..bench.repair import CROSSING_RANGES, FILE, HINTS, KNOWN_MESH, STRAIN, Hint, RepairRun, summarize
from .tables import LONGEST, count, make_table, say

__all__ = ["print_repair_runs", "repair_runs_to_dict"]

_MESH_HEADERS = (
    "Ver-\ntices",
    "Crossings\nbefore",
    "\nafter",
    "Largest\nmove",
    "Mean\nmove",
    "Strain\n[%]",
    "Time\n[s]",
)
_FREED_HEADERS = ("Meshes", "Freed", "with\norder=", "with\nx_previous=", "Crossings")
_COST_HEADERS = (
    "Largest move,\nmedian",
    "at\nmost",
    "Strain,\nmedian\n[%]",
    "at\nmost\n[%]",
    f"more\nthan\n{100 * STRAIN:.0f}%",
    "Time,\nmedian\n[s]",
)


def print_repair_runs(console: Console, runs: Sequence[RepairRun], *, device: wp.Device, partial: bool) -> None:
    """Prints a table of known meshes and files, tables of random damage, and what should not have happened.

    Args:
        console: The terminal or file to print to.
        runs: The repairs.
        device: The Warp device.
        partial: Whether the command was interrupted before all repairs were complete.
    """
    say(console, f"bsc.repair on {device}, {device.name}; moves in median edge lengths; times of a second call")
    named = [run for run in runs if run.kind in (KNOWN_MESH, FILE)]
    random = [run for run in runs if run.kind not in (KNOWN_MESH, FILE)]
    if named:
        console.print()
        _print_meshes(console, named)
    if random:
        console.print()
        _print_freed(console, random)
        console.print()
        _print_costs(console, random)
    console.print()
    for line in [*_describe_failures(runs), *_describe_checks(runs)]:
        say(console, line)
    if partial:
        say(console, "Interrupted: the other repairs are missing.")


def repair_runs_to_dict(runs: Sequence[RepairRun], *, device: wp.Device, partial: bool) -> dict[str, Any]:
    """Returns the measurements as plain data for JSON. Arguments: as of :func:`print_repair_runs`."""
    return {
        "benchmark": "repair",
        "device": str(device),
        "device_name": device.name,
        "ipc_toolkit": ipc_toolkit.version(),
        "partial": partial,
        "runs": [asdict(run) for run in runs],
    }


def _print_meshes(console: Console, runs: Sequence[RepairRun]) -> None:
    """Prints a row for each repair of known meshes and files; the mean move is that of vertices that moved."""
    table = make_table("Mesh", *_MESH_HEADERS)
    for run in runs:
        for attempt in run.attempts:
            table.add_row(
                Text(_title(run, attempt.hint)),
                f"{run.vertices:,}",
                f"{run.crossings:,}",
                f"{attempt.crossings:,}",
                f"{attempt.largest_move:.2f}",
                f"{attempt.mean_move:.2f}",
                f"{100 * attempt.strain:.1f}",
                f"{attempt.seconds:.2f}",
            )
    console.print(table)


def _print_freed(console: Console, runs: Sequence[RepairRun]) -> None:
    """Prints how much of the random damage is freed, by kind and by number of crossings."""
    table = make_table("Damage", *_FREED_HEADERS)
    groups = _by_kind(runs)
    for least, largest in CROSSING_RANGES:
        title = f"{least} or more" if largest is None else f"{least} to {largest}"
        within = [run for run in runs if run.crossings >= least and (largest is None or run.crossings <= largest)]
        groups[f"{title} crossings"] = within
    for title, group in groups.items():
        if group:
            found = summarize(group)
            freed = (found.meshes, found.freed, *(found.freed_by_hint[hint] for hint in HINTS))
            crossings = f"{found.crossings[0]:,} to {found.crossings[1]:,}"
            table.add_row(title, *(f"{number:,}" for number in freed), crossings)
    console.print(table)


def _print_costs(console: Console, runs: Sequence[RepairRun]) -> None:
    """Prints moves, strains and times of repairs of random damage, by kind."""
    table = make_table("Damage", *_COST_HEADERS)
    for kind, group in _by_kind(runs).items():
        found = summarize(group)
        table.add_row(
            kind,
            *(f"{move:.2f}" for move in found.move),
            *(f"{100 * strain:.1f}" for strain in found.strain),
            f"{found.strained:,}",
            f"{found.seconds:.2f}",
        )
    console.print(table)


def _by_kind(runs: Sequence[RepairRun]) -> dict[str, list[RepairRun]]:
    """Returns the runs of each kind."""
    return {kind: [run for run in runs if run.kind == kind] for kind in dict.fromkeys(run.kind for run in runs)}


def _describe_failures(runs: Sequence[RepairRun]) -> list[str]:
    """Returns a line for each repair that left crossings, with the reasons."""
    lines = [
        f"{_title(run, attempt.hint)}: {run.crossings:,} to {attempt.crossings:,} crossings: "
        f"{'; '.join(attempt.reasons)}."
        for run in runs
        for attempt in run.attempts
        if not attempt.certified
    ]
    return [*lines[:LONGEST], *([f"{len(lines) - LONGEST} more are not listed."] if len(lines) > LONGEST else [])]


def _describe_checks(runs: Sequence[RepairRun]) -> list[str]:
    """Returns what came back worse, what moved without need, and what the IPC Toolkit finds."""
    outputs = [(run, attempt) for run in runs for attempt in run.attempts]
    worse = [_title(run, attempt.hint) for run, attempt in outputs if attempt.crossings > run.crossings]
    moved = [_title(run, "none") for run in runs if run.keeps_free is False]
    checked = sum(run.keeps_free is not None for run in runs)
    lines = [
        f"Returned with more crossings: {_list(worse)} of {count(len(outputs), 'repair')}.",
        f"Changed where nothing crossed: {_list(moved)} of {count(checked, 'mesh', 'meshes')}.",
    ]
    if ipc_toolkit.is_installed():
        others = [_title(run, attempt.hint) for run, attempt in outputs if attempt.toolkit_agrees is False]
        title = f"Where IPC Toolkit {ipc_toolkit.version()} disagrees whether anything crosses"
        return [*lines, f"{title}: {_list(others)} of {count(len(outputs), 'output')}."]
    return [*lines, "The IPC Toolkit, which would check the outputs, is not installed: pip install 'warp-bsc[bench]'."]


def _list(titles: Sequence[str]) -> str:
    """Returns the number of titles, with the titles."""
    return f"{len(titles):,}" + (f" ({', '.join(titles[:LONGEST])})" if titles else "")


def _title(run: RepairRun, hint: Hint) -> str:
    """Returns the name of a mesh, with the hint that a repair of it had."""
    name = run.name if run.kind == KNOWN_MESH else Path(run.name).name if run.kind == FILE else f"{run.kind} {run.name}"
    return name if hint == "none" else f"{name}, {hint}="
