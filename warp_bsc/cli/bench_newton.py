"""The command ``warp-bsc bench newton``: measures Newton's own examples, plain, with the stage and another solver."""

import argparse
from collections.abc import Generator

import warp as wp

from ..bench.newton_examples import MODES, ExampleRun, NewtonExample, find_examples, measure_example
from .bench_newton_tables import example_runs_to_dict, print_example_runs, print_examples
from .bench_runs import RunsProgress, add_json_file, report_runs
from .device import find_device
from .exit_status import explain_statuses
from .interrupts import INTERRUPTS
from .options import Commands, add_command, add_device, positive
from .tables import Console

__all__ = ["add_to"]

_DESCRIPTION = """\
Run Newton's own examples, unchanged, and measure them: plain, with SolverCCD
put behind their solver, or behind each entry of a coupled solver that has
particles, and with SolverImplicit in place of VBD. Each run is a process of its
own, in which the example captures its own CUDA graph and runs its own tests. A
row has the times of frames, without drawing and without the first two; the
edges of cloth or soft bodies that cross faces at the start, and the most at
frame ends, found in exact arithmetic; the steps that were not certified; and
whether the example's own tests pass. Default: the examples of
newton.examples.cloth, softbody and multiphysics that have cloth or soft bodies.
Any other example of Newton can be named. Options of the example itself follow
its name, in quotes. A run that fails is a row, and a line below the table says
why. Tests that expect a state at rest fail in short runs, in all modes."""

_EPILOG = f"""\
examples:
  warp-bsc bench newton --list
  warp-bsc bench newton cloth_twist softbody_hanging --device cuda:0
  warp-bsc bench newton "cloth_hanging --solver xpbd" --frames 20 --modes stage
  warp-bsc bench newton --json examples.json

{explain_statuses()}
After a signal, the runs that were complete are printed or written first."""


def add_to(commands: Commands, summary: str) -> None:
    """Adds the command with its options, and a line for the list of commands."""
    command = add_command(commands, "newton", _run, summary=summary, description=_DESCRIPTION, epilog=_EPILOG)
    command.add_argument(
        "examples", metavar="EXAMPLE", nargs="*", help="the examples to run, by name, with their options in quotes"
    )
    command.add_argument(
        "--frames",
        type=positive,
        metavar="N",
        help="frames of each run (default: the number that the example sets, else 300; on the CPU at most 10)",
    )
    command.add_argument(
        "--modes",
        type=_modes,
        default=MODES,
        metavar="MODE,...",
        help="plain: the example as it is; stage: with SolverCCD behind its solver; implicit: with SolverImplicit in "
        "place of VBD (default: all)",
    )
    command.add_argument(
        "--check-every",
        type=positive,
        default=5,
        metavar="N",
        help="count crossings at the end of every Nth frame, and of the last (default: %(default)s)",
    )
    command.add_argument(
        "--download", action="store_true", help="let examples download assets; without it, their rows name the assets"
    )
    command.add_argument("--list", action="store_true", help="list the examples and what they need, and run none")
    add_json_file(command)
    add_device(command)


def _modes(text: str) -> tuple[str, ...]:
    """Returns the modes that an argument lists, each once."""
    modes = tuple(dict.fromkeys(text.split(",")))
    for mode in modes:
        if mode not in MODES:
            raise argparse.ArgumentTypeError(f"must be one of {', '.join(MODES)}, not {mode!r}")
    return modes


def _run(arguments: argparse.Namespace) -> int:
    device = find_device(arguments.device)
    with INTERRUPTS.held():  # a library that is interrupted while it loads raises other errors, or none
        examples = find_examples(arguments.examples)
        names = {example.name for example in find_examples()} if arguments.json else set()
    INTERRUPTS.check()
    if arguments.json and arguments.json.split(" ")[0] in names:
        raise ValueError(f"--json {arguments.json}: this is an example; name examples before the options")
    if arguments.list:
        print_examples(Console(), examples)
        return 0
    report_runs(
        _measure(examples, arguments, device),
        to_dict=example_runs_to_dict,
        show=print_example_runs,
        json_path=arguments.json,
        command=arguments.command_line,
        device=device,
    )
    return 0


def _measure(
    examples: list[NewtonExample], arguments: argparse.Namespace, device: wp.Device
) -> Generator[ExampleRun, None, None]:
    """Yields a run for each example and mode, and shows the progress."""
    pairs = [(example, mode) for example in examples for mode in arguments.modes]
    with RunsProgress(len(pairs)) as progress:
        for done, (example, mode) in enumerate(pairs):
            title = f"{example.name}, {mode}"
            progress.show(done, f"{title}: starts")

            def show(frame: int, frames: int, title: str = title, done: int = done) -> None:
                progress.show(done + frame / frames, f"{title}: frame {frame} of {frames}")

            run = measure_example(
                example,
                mode,
                device=str(device),
                frames=arguments.frames,
                check_every=arguments.check_every,
                download=arguments.download,
                progress=show,
            )
            if run.problem:
                progress.note(f"{title}: {run.problem}")
            yield run
