"""The command ``warp-bsc bench response``: measures stretch, rest, energy and time of scenes by configuration."""

import argparse
import difflib
import functools
import itertools
from dataclasses import asdict
from typing import Any

from ..bench.measure.response import (
    CONFIGURATIONS,
    CONVERGED,
    EARLY_STEPS,
    REFERENCE,
    REFERENCE_RATE,
    SCENES,
    SEMI_IMPLICIT_STEPS,
    SOLVERS,
    WARM_UP,
    ResponseMeasurement,
    ResponseRun,
    measure_response,
)
from .bench import JSON_FILE, Benchmark, check_json, measure_each, report_runs, run_to_dict
from .device import find_device
from .options import DEVICE, distance, names_of, number, positive, positive_real, several, switch
from .tables import Column, Console, count, grouped, print_table, say

__all__ = ["BENCHMARK"]

_DESCRIPTION = f"""\
Run scenes in which cloth, soft bodies, ropes and a ball touch, at 1/60 s, and
measure what each configuration of a solver and the collision stage makes of
them: the largest stretch of an edge, at the end and at most; the speed at rest;
the energy that is gained behind VBD, where nothing does work, with that of
elastic strain; the edges that cross faces at the end, and the pairs that meet
on the straight way of a step, found in exact arithmetic; the time of a step, on
a GPU in a CUDA graph; and the steps that were not certified. The balls take steps of 1/120 s.
The configurations:
  plain           the solver with Newton's contacts
  self-contact    the same with VBD's own contacts between particles
  stage           SolverCCD with default arguments, without Newton's contacts
  stage+contacts  the same with Newton's contacts
  implicit        SolverImplicit with default arguments, in place of VBD
  converged       the same with as many Newton steps as a step needs
  reference       SolverCCD at a small step: slow
Ropes have particle_radius, without which nothing collides with springs. The
semi-implicit solver takes {SEMI_IMPLICIT_STEPS} times as many steps in all configurations, unless
--rate is given. A scene that the solver cannot run is a row, and a line below
says why."""

_SECTIONS = f"""\
scenes:
  {" ".join(SCENES[:8])}
  {" ".join(SCENES[8:])}

"""

_EXAMPLES = """\
  warp-bsc bench response --no-reference
  warp-bsc bench response box_edge --rate 240 --no-reference
  warp-bsc bench response sphere box_edge --device cuda:0
  warp-bsc bench response sphere --configurations stage --perturb 1e-6
  warp-bsc bench response --solver xpbd --json response.json"""


def _digits(decimals: int, value: float) -> str:
    """Returns a number, without decimals from 1,000 on."""
    return f"{value:,.{decimals if value < 1000.0 else 0}f}"


_COLUMNS = (
    Column("Stretch\nat end\n[%]", "stretch_at_end", functools.partial(_digits, 2), width=7),
    Column("at\nmost\n[%]", "stretch_at_most", functools.partial(_digits, 2), width=7),
    Column("Speed\nat end\n[mm/s]", "rest_speed", functools.partial(_digits, 1), width=6),
    Column("Energy\ngained\n[J]", "energy_gained", ",.4f", width=7),
    Column("Cross-\nings", "crossings", width=6),
    Column("Pairs\nmeet", "collisions", width=6),
    Column("A step:\nmedian\n[ms]", "median", functools.partial(_digits, 2), width=7),
    Column("\nmean\n[ms]", "mean", functools.partial(_digits, 2), width=6),
)  # 80 columns with the first one and the gaps


def _run(arguments: argparse.Namespace) -> None:
    scenes, configurations = _check_scenes(arguments.scenes), _choose_configurations(arguments)
    check_json(arguments.json, SCENES.__contains__, "a scene", "scenes")
    if arguments.perturb is not None and "stage" not in configurations:
        raise ValueError("--perturb runs the configuration stage a second time, and --configurations omits it")
    device = find_device(arguments.device)

    names = "solver", "seconds", "rate", "reference_rate", "perturb"
    measure = functools.partial(measure_response, device=device, **{name: getattr(arguments, name) for name in names})
    report_runs(
        arguments,
        device,
        measure_each(itertools.product(scenes, configurations), measure, device, unit="step"),
        name="response",
        heading=f"Contact on {device}, {device.name}; times of a step without the first {WARM_UP}",
        show=_show,
        to_dict=lambda runs: {
            "steps_left_out": WARM_UP,
            "runs": [
                run_to_dict(run, _measurement_to_dict) | {"from_converged": _distance_from_converged(run, runs)}
                for run in runs
            ],
        },
    )


def _check_scenes(names: list[str]) -> tuple[str, ...]:
    """Returns scenes by name, each once; without one, all."""
    for name in names:
        if name not in SCENES:
            close = difflib.get_close_matches(name, SCENES, n=1)
            hint = f"; did you mean {close[0]}?" if close else "."
            raise ValueError(f"{name!r}: there is no scene of this name{hint} The scenes are {', '.join(SCENES)}")
    return tuple(dict.fromkeys(names)) or SCENES


def _choose_configurations(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Returns the configurations to run: those that are named, otherwise all that the solver and options allow."""
    if arguments.configurations is not None:
        return arguments.configurations
    omitted = set() if arguments.solver == "vbd" else {"self-contact", "implicit", CONVERGED}
    omitted |= set() if arguments.reference else {REFERENCE}
    return tuple(name for name in CONFIGURATIONS if name not in omitted)


def _show(console: Console, runs: list[ResponseRun]) -> None:
    """Prints a table for each scene, a row a run, and below it why runs are missing."""
    for scene, group in grouped(runs, "scene").items():
        console.print()
        first = Column(f"{scene}\n{group[0].solver}", width=14, kind="text")
        print_table(console, first, _COLUMNS, [(run.configuration, run.measured) for run in group])
        for note in _describe(group):
            say(console, note)


def _describe(runs: list[ResponseRun]) -> list[str]:
    """Returns the lines below the table of a scene."""
    lines = []
    if measured := [run.measured for run in runs if run.measured]:
        steps = dict.fromkeys(f"{count(took.steps, 'step')} of 1/{took.rate} s" for took in measured)
        sizes = count(measured[0].particles, "particle"), count(measured[0].triangles, "triangle")
        lines.append(", ".join([*sizes, " or ".join(steps)]))
    for run in runs:
        if run.measured is None:
            lines.append(f"{run.configuration}: not run: {run.problem}")
            continue
        if run.measured.uncertified_steps:
            lines.append(f"{run.configuration}: {count(run.measured.uncertified_steps, 'step')} not certified")
        if spread := run.measured.spread:
            lines.append(
                f"{run.configuration}, moved by {spread.distance:g} m: stretch differs by "
                f"{spread.stretch_at_end:.2f} at the end, {spread.stretch_at_most:.2f} at most"
            )
    distances = {run.configuration: _distance_from_converged(run, runs) for run in runs}
    shown = [f"{name} {mm:.2f}" for name, mm in distances.items() if mm is not None and name != CONVERGED]
    if shown:
        lines.append(f"Mean distance from {CONVERGED} after {EARLY_STEPS} steps [mm]: {', '.join(shown)}")
    return lines


def _distance_from_converged(run: ResponseRun, runs: list[ResponseRun]) -> float | None:
    """Returns how far particles are from those of the converged run of the scene in the mean [mm]; None without it."""
    converged = next((o.measured for o in runs if (o.scene, o.configuration) == (run.scene, CONVERGED)), None)
    return run.measured.distance_from(converged) if run.measured and converged else None


def _measurement_to_dict(took: ResponseMeasurement) -> dict[str, Any]:
    values = asdict(took)
    del values["early"]
    return values | {"milliseconds": {"median": took.median, "mean": took.mean, "worst": max(took.milliseconds)}}


BENCHMARK = Benchmark(
    _run,
    _DESCRIPTION,
    _EXAMPLES,
    {
        "scenes": several("SCENE", "the scenes to run (default: all)"),
        "--solver": {"choices": SOLVERS, "default": "vbd", "help": "the inner solver (default: %(default)s)"},
        "--configurations": names_of(
            CONFIGURATIONS,
            "the configurations to run (default: all, self-contact, implicit and converged only for vbd)",
            all_by_default=False,
        ),
        "--reference": switch("whether the reference is among the default configurations"),
        "--rate": number(positive, "steps a second of the other configurations (default: that of the scene)"),
        "--reference-rate": number(
            positive, "steps a second of the reference (default: %(default)s)", default=REFERENCE_RATE
        ),
        "--seconds": number(positive_real, "simulated time of each run [s] (default: that of the scene)", metavar="T"),
        "--perturb": number(
            distance,
            "run stage a second time with all particles moved sideways by D [m], and report how much its stretch "
            "differs",
            metavar="D",
        ),
        **JSON_FILE,
        **DEVICE,
    },
    sections=_SECTIONS,
    kept="runs",
)
