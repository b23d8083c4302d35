"""The command ``warp-bsc bench penetration``: judges several simulators on the same scenes by exact detection."""

import argparse
from collections.abc import Generator

import warp as wp

from ..bench.penetration import SCENES, SIMULATORS, PenetrationRun, measure_penetration
from .bench_penetration_tables import penetration_runs_to_dict, print_penetration_runs
from .bench_runs import RunsProgress, add_json_file, report_runs
from .device import find_device
from .exit_status import explain_statuses
from .interrupts import INTERRUPTS
from .options import Commands, add_command, add_device, positive

__all__ = ["add_to"]

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

_EPILOG = f"""\
scenes:
{chr(10).join(f"  {name:8}{text}" for name, text in SCENES.items())}

examples:
  warp-bsc bench penetration
  warp-bsc bench penetration --scene bullet,twist --simulator vbd,ccd-vbd
  warp-bsc bench penetration --device cuda:0 --json penetration.json

{explain_statuses()}
After a signal, the runs that were complete are printed or written first."""


def add_to(commands: Commands, summary: str) -> None:
    """Adds the command with its options, and a line for the list of commands."""
    command = add_command(commands, "penetration", _run, summary=summary, description=_DESCRIPTION, epilog=_EPILOG)
    for option, known in (("scene", SCENES), ("simulator", SIMULATORS)):
        command.add_argument(
            f"--{option}",
            type=lambda text, known=known: _names(text, tuple(known)),
            default=tuple(known),
            metavar="NAME,...",
            help=f"the {option}s to run (default: all)",
        )
    command.add_argument(
        "--frames", type=positive, metavar="N", help="frames of each run, of 1/60 s (default: those of the scene)"
    )
    add_json_file(command)
    add_device(command)


def _names(text: str, known: tuple[str, ...]) -> tuple[str, ...]:
    """Returns the names that an argument lists, each once."""
    names = tuple(dict.fromkeys(text.split(",")))
    for name in names:
        if name not in known:
            raise argparse.ArgumentTypeError(f"must be of {', '.join(known)}, not {name!r}")
    return names


def _run(arguments: argparse.Namespace) -> int:
    device = find_device(arguments.device)
    report_runs(
        _measure(arguments, device),
        to_dict=penetration_runs_to_dict,
        show=print_penetration_runs,
        json_path=arguments.json,
        command=arguments.command_line,
        device=device,
    )
    return 0


def _measure(arguments: argparse.Namespace, device: wp.Device) -> Generator[PenetrationRun, None, None]:
    """Yields a run for each scene and simulator, and shows the progress."""
    pairs = [(scene, simulator) for scene in arguments.scene for simulator in arguments.simulator]
    with RunsProgress(len(pairs)) as progress:
        for done, (scene, simulator) in enumerate(pairs):
            title = f"{scene}, {SIMULATORS[simulator].title}"
            progress.show(done, f"{title}: starts")

            def show(part: int, parts: int, title: str = title, done: int = done) -> None:
                INTERRUPTS.check()
                progress.show(done + part / parts, f"{title}: {part / parts:.0%}")

            with INTERRUPTS.held():  # a library that is interrupted while it loads raises other errors, or none
                run = measure_penetration(scene, simulator, device=device, frames=arguments.frames, progress=show)
            if run.problem:
                progress.note(f"{title}: {run.problem}")
            yield run
