"""The command ``warp-bsc bench repair``: measures bsc.repair on known meshes, files and random damage."""

import argparse
import functools
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from ..bench.measure.repair import (
    CROSSING_RANGES,
    FILE,
    HINTS,
    KNOWN_MESH,
    STRAIN,
    Hint,
    RepairRun,
    measure_repair,
    summarize,
)
from ..bench.peers import ipc_toolkit
from ..bench.scenes.mesh_files import is_mesh_name
from ..bench.scenes.repair import KINDS, KNOWN, TangledMesh, damaged, load_tangled
from .bench import JSON_FILE, Benchmark, check_json, measure_each, report_runs
from .device import find_device
from .options import DEVICE, names_of, natural, number, several
from .tables import LONGEST, Column, Console, count, grouped, print_table, say

__all__ = ["BENCHMARK"]

_DESCRIPTION = f"""\
Measure bsc.repair on known meshes that cross themselves, on mesh files, and on
meshes of {len(KINDS)} kinds that are pushed into themselves at random. The known ones:
  sheets  two sheets through each other in islands
  folded  a fold whose upper layer has sunk through the lower
  corner  one sheet through another from border to border
A row has the crossings before and after, found in exact arithmetic, moves in
median edge lengths, the largest strain of an edge, and the time of a second
call. What is not freed is repaired again with each hint that there is for it:
order= and x_previous=. Lines below say what came back with more crossings, what
moved where nothing crossed, and where the IPC Toolkit, if installed, disagrees.
Vertices of a file at the same position are one."""

_EXAMPLES = """\
  warp-bsc bench repair
  warp-bsc bench repair body.obj --random 0
  warp-bsc bench repair --random 60 --json repair.json
  warp-bsc bench repair --kinds folds --random 1 --seed 17"""

_MESHES = (  # of a run and an attempt; the mean move is that of vertices that moved
    Column("Ver-\ntices", lambda row: row[0].vertices),
    Column("Crossings\nbefore", lambda row: row[0].crossings),
    Column("\nafter", lambda row: row[1].crossings),
    Column("Largest\nmove", lambda row: row[1].largest_move, ".2f"),
    Column("Mean\nmove", lambda row: row[1].mean_move, ".2f"),
    Column("Strain\n[%]", lambda row: 100 * row[1].strain, ".1f"),
    Column("Time\n[s]", lambda row: row[1].seconds, ".2f"),
)
_FREED = (  # of a summary, as the next ones
    Column("Meshes", "meshes"),
    *(
        Column(header, lambda found, hint=hint: found.freed_by_hint[hint] if hint else found.freed)
        for header, hint in zip(("Freed", "with\norder=", "with\nx_previous="), (None, *HINTS), strict=True)
    ),
    Column("Crossings", "crossings", lambda ends: f"{ends[0]:,} to {ends[1]:,}"),
)
_COSTS = (
    Column("Largest move,\nmedian", lambda found: found.move[0], ".2f"),
    Column("at\nmost", lambda found: found.move[1], ".2f"),
    Column("Strain,\nmedian\n[%]", lambda found: 100 * found.strain[0], ".1f"),
    Column("at\nmost\n[%]", lambda found: 100 * found.strain[1], ".1f"),
    Column(f"more\nthan\n{100 * STRAIN:.0f}%", "strained"),
    Column("Time,\nmedian\n[s]", "seconds", ".2f"),
)


def _run(arguments: argparse.Namespace) -> None:
    check_json(arguments.json, is_mesh_name, "a mesh file", "meshes")
    device = find_device(arguments.device)

    def measure(kind: str, name: str, make: Callable[[], TangledMesh], progress: object) -> RepairRun:
        return measure_repair(kind, name, make(), device=device)

    files = {path: load_tangled(path) for path in arguments.meshes}
    meshes = [(KNOWN_MESH, name, make) for name, make in KNOWN.items()]
    meshes += [(FILE, path, lambda mesh=mesh: mesh) for path, mesh in files.items()]
    meshes += [
        (kind, str(number), functools.partial(damaged, kind, number))
        for kind in arguments.kinds
        for number in range(arguments.seed, arguments.seed + arguments.random)
    ]
    place = f"{device}, {device.name}"
    report_runs(
        arguments,
        device,
        measure_each(meshes, measure, device, title=lambda kind, name, make: f"{kind} {name}"),
        name="repair",
        heading=f"bsc.repair on {place}; moves in median edge lengths; times of a second call",
        show=_show,
        to_dict=lambda runs: {"ipc_toolkit": ipc_toolkit.version(), "runs": [asdict(run) for run in runs]},
        what="repairs",
    )


def _show(console: Console, runs: list[RepairRun]) -> None:
    """Prints a table of known meshes and files, tables of random damage, and what should not have happened."""
    named = [run for run in runs if run.kind in (KNOWN_MESH, FILE)]
    if named:
        rows = [(_title(run, attempt.hint), (run, attempt)) for run in named for attempt in run.attempts]
        console.print()
        print_table(console, "Mesh", _MESHES, rows)
    random = [run for run in runs if run.kind not in (KNOWN_MESH, FILE)]
    if random:
        kinds, ranges = grouped(random, "kind"), {}
        for least, largest in CROSSING_RANGES:
            title = f"{least} or more crossings" if largest is None else f"{least} to {largest} crossings"
            within = [run for run in random if run.crossings >= least and (largest is None or run.crossings <= largest)]
            ranges |= {title: within} if within else {}
        for columns, groups in ((_FREED, kinds | ranges), (_COSTS, kinds)):
            console.print()
            print_table(console, "Damage", columns, [(title, summarize(group)) for title, group in groups.items()])
    console.print()
    for line in [*_describe_failures(runs), *_describe_checks(runs)]:
        say(console, line)


def _describe_failures(runs: list[RepairRun]) -> list[str]:
    """Returns a line for each repair that left crossings, with the reasons."""
    lines = [
        f"{_title(run, attempt.hint)}: {run.crossings:,} to {attempt.crossings:,} crossings: "
        f"{'; '.join(attempt.reasons)}."
        for run in runs
        for attempt in run.attempts
        if not attempt.certified
    ]
    return [*lines[:LONGEST], *([f"{len(lines) - LONGEST} more are not listed."] if len(lines) > LONGEST else [])]


def _describe_checks(runs: list[RepairRun]) -> list[str]:
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


def _list(titles: list[str]) -> str:
    """Returns the number of titles, with the titles."""
    return f"{len(titles):,}" + (f" ({', '.join(titles[:LONGEST])})" if titles else "")


def _title(run: RepairRun, hint: Hint) -> str:
    """Returns the name of a mesh, with the hint that a repair of it had."""
    name = run.name if run.kind == KNOWN_MESH else Path(run.name).name if run.kind == FILE else f"{run.kind} {run.name}"
    return name if hint == "none" else f"{name}, {hint}="


BENCHMARK = Benchmark(
    _run,
    _DESCRIPTION,
    _EXAMPLES,
    {
        "meshes": several("MESH", "mesh files to measure beside the known meshes and random damage"),
        "--random": number(
            natural, "meshes of each kind that are pushed into themselves (default: %(default)s)", default=10
        ),
        "--kinds": names_of(KINDS, f"kinds of meshes to push into themselves, of {', '.join(KINDS)} (default: all)"),
        "--seed": number(
            natural,
            "number of the first mesh of each kind, on which its damage depends (default: %(default)s)",
            default=0,
        ),
        **JSON_FILE,
        **DEVICE,
    },
    kept="repairs",
)
