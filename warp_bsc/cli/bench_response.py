"""The command ``warp-bsc bench response``: measures stretch, rest, energy and time of scenes by configuration."""

import argparse
import difflib
import math
from collections.abc import Generator

import warp as wp

from ..bench.response import (
    CONFIGURATIONS,
    CONVERGED,
    REFERENCE,
    REFERENCE_RATE,
    SCENES,
    SEMI_IMPLICIT_STEPS,
    SOLVERS,
    ResponseRun,
    measure_response,
)
from .bench_response_tables import print_response_runs, response_runs_to_dict
from .bench_runs import RunsProgress, add_json_file, report_runs
from .device import find_device, loading_kernels
from .exit_status import explain_statuses
from .interrupts import INTERRUPTS
from .options import Commands, add_command, add_device, distance, positive

__all__ = ["add_to"]

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

_EPILOG = f"""\
scenes:
  {" ".join(SCENES[:8])}
  {" ".join(SCENES[8:])}

examples:
  warp-bsc bench response --no-reference
  warp-bsc bench response box_edge --rate 240 --no-reference
  warp-bsc bench response sphere box_edge --device cuda:0
  warp-bsc bench response sphere --configurations stage --perturb 1e-6
  warp-bsc bench response --solver xpbd --json response.json

{explain_statuses()}
After a signal, the runs that were complete are printed or written first."""


def add_to(commands: Commands, summary: str) -> None:
    """Adds the command with its options, and a line for the list of commands."""
    command = add_command(
        commands,
        "response",
        _run,
        summary=summary,
        description=_DESCRIPTION,
        epilog=_EPILOG,
    )
    command.add_argument("scenes", metavar="SCENE", nargs="*", help="the scenes to run (default: all)")
    command.add_argument("--solver", choices=SOLVERS, default="vbd", help="the inner solver (default: %(default)s)")
    command.add_argument(
        "--configurations",
        type=_configurations,
        metavar="NAME,...",
        help="the configurations to run (default: all, self-contact, implicit and converged only for vbd)",
    )
    command.add_argument(
        "--reference",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="whether the reference is among the default configurations",
    )
    command.add_argument(
        "--rate",
        type=positive,
        metavar="N",
        help="steps a second of the other configurations (default: that of the scene)",
    )
    command.add_argument(
        "--reference-rate",
        type=positive,
        default=REFERENCE_RATE,
        metavar="N",
        help="steps a second of the reference (default: %(default)s)",
    )
    command.add_argument(
        "--seconds", type=_seconds, metavar="T", help="simulated time of each run [s] (default: that of the scene)"
    )
    command.add_argument(
        "--perturb",
        type=distance,
        metavar="D",
        help="run stage a second time with all particles moved sideways by D [m], and report how much its stretch "
        "differs",
    )
    add_json_file(command)
    add_device(command)


def _configurations(text: str) -> tuple[str, ...]:
    """Returns the configurations that an argument lists, each once."""
    names = tuple(dict.fromkeys(text.split(",")))
    for name in names:
        if name not in CONFIGURATIONS:
            raise argparse.ArgumentTypeError(f"must be of {', '.join(CONFIGURATIONS)}, not {name!r}")
    return names


def _seconds(text: str) -> float:
    """Returns the time that a text holds."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0.0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"must be a finite number more than 0, not {text}")
    return number


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


def _run(arguments: argparse.Namespace) -> int:
    scenes, configurations = _check_scenes(arguments.scenes), _choose_configurations(arguments)
    if arguments.json in SCENES:
        raise ValueError(f"--json {arguments.json}: this is a scene; name scenes before the options")
    if arguments.perturb is not None and "stage" not in configurations:
        raise ValueError("--perturb runs the configuration stage a second time, and --configurations omits it")
    device = find_device(arguments.device)
    report_runs(
        _measure(scenes, configurations, arguments, device),
        to_dict=response_runs_to_dict,
        show=print_response_runs,
        json_path=arguments.json,
        command=arguments.command_line,
        device=device,
    )
    return 0


def _measure(
    scenes: tuple[str, ...], configurations: tuple[str, ...], arguments: argparse.Namespace, device: wp.Device
) -> Generator[ResponseRun, None, None]:
    """Yields a run for each scene and configuration, and shows the progress."""
    pairs = [(scene, configuration) for scene in scenes for configuration in configurations]
    with RunsProgress(len(pairs)) as progress, loading_kernels(device, progress.console):
        for done, (scene, configuration) in enumerate(pairs):
            title = f"{scene}, {configuration}"
            progress.show(done, f"{title}: starts")

            def show(step: int, steps: int, title: str = title, done: int = done) -> None:
                INTERRUPTS.check()
                progress.show(done + step / steps, f"{title}: step {step:,} of {steps:,}")

            with INTERRUPTS.held():  # a library that is interrupted while it loads raises other errors, or none
                run = measure_response(
                    scene,
                    configuration,
                    solver=arguments.solver,
                    device=device,
                    seconds=arguments.seconds,
                    rate=arguments.rate,
                    reference_rate=arguments.reference_rate,
                    perturb=arguments.perturb,
                    progress=show,
                )
            if run.problem:
                progress.note(f"{title}: {run.problem}")
            yield run
