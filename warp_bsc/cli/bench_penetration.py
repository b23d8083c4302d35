"""The command ``warp-bsc bench penetration``: judges several simulators on the same scenes by exact detection."""

import argparse
import functools
import itertools
from dataclasses import asdict
from typing import Any

from ..bench.measure.penetration import (
    SCENES,
    SIMULATORS,
    WARM_UP,
    PenetrationMeasurement,
    PenetrationRun,
    measure_penetration,
)
from .bench import JSON_FILE, Benchmark, measure_each, report_runs, run_to_dict
from .device import find_device
from .options import DEVICE, names_of, number, positive
from .tables import Column, Console, count, grouped, print_table, say

__all__ = ["BENCHMARK"]

_LINES = "\n".join(f"  {name:18}{simulator.title}" for name, simulator in SIMULATORS.items())

_DESCRIPTION = f"""\
Run the same scenes through several simulators, each with the settings that its
own examples or documentation recommend, and judge each by exact detection on
its states: edges that pass through faces at frame ends, of cloth and soft
bodies with themselves, each other and fixed shapes; pairs that meet on the way
from each state to the next, where the motion passes through; tetrahedra that
are inverted. A row also has the share of its speed that a freely flying body
keeps before it meets anything, the largest stretch of an edge, and the time of
a step. MuJoCo runs on the CPU, libuipc on a GPU, Newton's solvers on --device.
The simulators:
{_LINES}
SolverCCD and SolverImplicit have their default arguments. A simulator that is
not installed or cannot run a scene is a row, and a line below says why."""

_SECTIONS = f"""\
scenes:
{chr(10).join(f"  {name:8}{text}" for name, text in SCENES.items())}

"""

_EXAMPLES = """\
  warp-bsc bench penetration
  warp-bsc bench penetration --scene bullet,twist --simulator vbd,ccd-vbd
  warp-bsc bench penetration --device cuda:0 --json penetration.json"""

_COLUMNS = (
    Column("Cross-\nings\nworst", lambda took: max(took.crossings), width=6),
    Column("\n\nsum", lambda took: sum(took.crossings), width=9),
    Column("Met\non the\nway", "collisions", width=10),
    Column("In-\nver-\nted", lambda took: max(took.inverted), width=5),
    Column("Speed\nkept\n[%]", "speed_kept", lambda share: f"{100.0 * share:.1f}", width=5),
    Column("Stretch\n\n[%]", "stretch", ",.1f", width=9),
    Column("Step\n\n[ms]", lambda took: took.milliseconds[0], ",.2f", width=8),
)


def _run(arguments: argparse.Namespace) -> None:
    device = find_device(arguments.device)

    measure = functools.partial(measure_penetration, device=device, frames=arguments.frames)
    cases = itertools.product(arguments.scene, arguments.simulator)
    place = f"{device}, {device.name}"
    report_runs(
        arguments,
        device,
        measure_each(cases, measure, device, title=lambda scene, name: f"{scene}, {SIMULATORS[name].title}"),
        name="penetration",
        heading=f"Penetration, Newton's solvers on {place}; medians of a step without the first {WARM_UP}",
        show=_show,
        to_dict=lambda runs: {
            "steps_left_out": WARM_UP,
            "scenes": {name: SCENES[name] for name in grouped(runs, "scene")},
            "simulators": {name: asdict(SIMULATORS[name]) for name in grouped(runs, "simulator")},
            "runs": [run_to_dict(run, _measurement_to_dict) for run in runs],
        },
    )


def _show(console: Console, runs: list[PenetrationRun]) -> None:
    """Prints a table for each scene, a row a simulator, and below them versions and claims."""
    for scene, group in grouped(runs, "scene").items():
        console.print()
        _show_scene(console, scene, group)
    console.print()
    say(console, "Crossings: edges through faces at frame ends, in the worst frame and in all together.")
    say(console, "Met on the way: pairs that meet on the straight way from a state to the next, in all steps.")
    say(console, "Inverted: tetrahedra in the worst frame. Speed kept: of a free flight before anything is met.")
    versions = {run.simulator: run.measured.version for run in reversed(runs) if run.measured}
    for name in grouped((run for run in runs if run.measured), "simulator"):
        simulator = SIMULATORS[name]
        claims = f"claims: {simulator.claims}" if simulator.claims else "claims nothing of penetration"
        say(console, f"{simulator.title}: {simulator.package} {versions[name]}; {simulator.settings}; {claims}.")


def _show_scene(console: Console, scene: str, runs: list[PenetrationRun]) -> None:
    """Prints the table of one scene, and the lines below it."""
    rows = [(SIMULATORS[run.simulator].title, run.measured) for run in runs]
    print_table(console, Column(scene, width=20, kind="text"), _COLUMNS, rows)
    if sizes := next((took for _, took in rows if took), None):
        parts = count(sizes.particles, "particle"), count(sizes.triangles, "triangle"), count(sizes.frames, "frame")
        say(console, f"{SCENES[scene].capitalize()}: {', '.join(parts)}")
    for run, (title, took) in zip(runs, rows, strict=True):
        if took is None:
            say(console, f"{title}: not run: {run.problem}")
            continue
        if took.uncertified_steps:
            say(console, f"{title}: {count(took.uncertified_steps, 'step')} of {took.steps:,} not certified")


def _measurement_to_dict(took: PenetrationMeasurement) -> dict[str, Any]:
    median, mean = took.milliseconds
    return asdict(took) | {"milliseconds": {"median": median, "mean": mean}}


BENCHMARK = Benchmark(
    _run,
    _DESCRIPTION,
    _EXAMPLES,
    {
        "--scene": names_of(SCENES, "the scenes to run (default: all)"),
        "--simulator": names_of(SIMULATORS, "the simulators to run (default: all)"),
        "--frames": number(positive, "frames of each run, of 1/60 s (default: those of the scene)"),
        **JSON_FILE,
        **DEVICE,
    },
    sections=_SECTIONS,
    kept="runs",
)
