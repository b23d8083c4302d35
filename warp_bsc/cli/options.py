"""Options that several commands share, with their types and help texts."""

import argparse
import math
import os
from collections.abc import Callable
from pathlib import Path

from .._arguments import SMALLEST_DISTANCE
from ..detection.settings import METHODS

__all__ = [
    "Commands",
    "add_command",
    "add_detection_options",
    "add_device",
    "add_fail_on",
    "add_json",
    "add_repeat",
    "add_scene",
    "add_threads",
    "distance",
    "natural",
    "positive",
    "scene_path",
]

Commands = argparse._SubParsersAction
"""What ``ArgumentParser.add_subparsers`` returns: the commands, to which each module adds its own."""

_DEMO = "assets/cloth_twist.usd"
"""The scene called demo. In a checkout it stands beside the package, as the device code does, else in it."""


def add_command(
    commands: Commands,
    name: str,
    run: Callable[[argparse.Namespace], int] | None,
    *,
    summary: str,
    description: str,
    epilog: str,
) -> argparse.ArgumentParser:
    """Adds a command and returns its parser.

    Args:
        commands: The commands to add it to.
        name: The command's name.
        run: Runs it with the parsed arguments and returns the exit status; None for a group of commands.
        summary: One line for the list of commands.
        description: The help text above the options.
        epilog: The help text below the options.
    """
    command = commands.add_parser(
        name,
        help=summary,
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.set_defaults(run=run)
    return command


def add_scene(command: argparse.ArgumentParser, *, optional: bool = False) -> None:
    """Adds the scene, whose value is for :func:`scene_path`."""
    text = "a .usd, .usda, .usdc or .usdz file; demo for a recorded cloth that comes with warp-bsc"
    command.add_argument("scene", metavar="SCENE", nargs="?" if optional else None, help=text)


def scene_path(name: str) -> str:
    """Returns the path of a scene: for demo that of the package's own, unless there is a file of this name."""
    if name != "demo" or os.path.exists(name):
        return name
    package = Path(__file__).parents[1]
    return next(str(folder / _DEMO) for folder in (package, package.parent) if (folder / _DEMO).exists())


def add_detection_options(command: argparse.ArgumentParser, *, method: str) -> None:
    """Adds --method, with this default, and --device."""
    command.add_argument(
        "--method",
        choices=METHODS,
        default=method,
        help="float: trust the signs that floating point computes; conservative: count pairs that floating point "
        "cannot certify as collisions; exact: decide these pairs in exact arithmetic (default: %(default)s)",
    )
    add_device(command)


def add_device(command: argparse.ArgumentParser) -> None:
    """Adds --device."""
    command.add_argument("--device", help="Warp device, such as cpu or cuda:0 (default: the first GPU, else cpu)")


def add_json(command: argparse.ArgumentParser) -> None:
    """Adds --json, without a file."""
    command.add_argument("--json", action="store_true", help="print all results as JSON instead of tables")


def add_fail_on(group: argparse._ActionsContainer, reasons: dict[str, str]) -> None:
    """Adds --fail-on, whose value is a set of reasons.

    Args:
        group: The command, or a group of its options.
        reasons: The kinds of finding, and an explanation of each, which may be empty.
    """

    def parse(text: str) -> frozenset[str]:
        named = frozenset(text.split(","))
        if unknown := named - reasons.keys():
            known = ", ".join(reasons)
            raise argparse.ArgumentTypeError(f"must be of {known}, not {', '.join(sorted(unknown))!r}")
        return named

    explained = ", ".join(f"{reason} ({text})" if text else reason for reason, text in reasons.items())
    several = " of these, separated by commas" if len(reasons) > 1 else ""
    group.add_argument(
        "--fail-on",
        type=parse,
        default=frozenset(),
        metavar="WHAT",
        help=f"exit with status 1 if there is any{several}: {explained}",
    )


def add_repeat(command: argparse.ArgumentParser, *, default: int) -> None:
    """Adds --repeat."""
    command.add_argument(
        "--repeat",
        type=positive,
        default=default,
        metavar="N",
        help="number of repetitions; their median is reported (default: %(default)s)",
    )


def add_threads(command: argparse.ArgumentParser) -> None:
    """Adds --threads."""
    command.add_argument(
        "--threads", type=positive, metavar="N", help="number of CPU cores to use, on Linux only (default: all)"
    )


def distance(text: str) -> float:
    """Returns the distance that a text holds.

    Raises:
        argparse.ArgumentTypeError: If it is not a number, not finite or less than 2^-1021, for example 0.
    """
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not SMALLEST_DISTANCE <= number < math.inf:
        raise argparse.ArgumentTypeError(f"must be a finite number more than 0, at least 2^-1021, not {text}")
    return number


def positive(text: str) -> int:
    """Returns the integer that a text holds.

    Raises:
        argparse.ArgumentTypeError: If it is not an integer in [1, 2^31).
    """
    return _integer(text, 1)


def natural(text: str) -> int:
    """Returns the integer that a text holds, which may be 0.

    Raises:
        argparse.ArgumentTypeError: If it is not an integer in [0, 2^31).
    """
    return _integer(text, 0)


def _integer(text: str, least: int) -> int:
    try:
        number = int(text)
    except ValueError:
        number = least - 1
    if not least <= number < 2**31:
        raise argparse.ArgumentTypeError(f"must be an integer of at least {least}, less than 2^31, not {text}")
    return number
