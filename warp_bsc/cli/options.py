"""Options that several commands share, with their types and help texts."""

import argparse
import functools
import math
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from .._arguments import SMALLEST_DISTANCE
from ..detection.run.settings import METHODS

Commands = argparse._SubParsersAction
"""What ``ArgumentParser.add_subparsers`` returns: the commands, to which each module adds its own."""

Options = Mapping[str, Mapping[str, Any]]
"""Arguments and options of a command: what ``ArgumentParser.add_argument`` takes, by name."""

_DEMO = "assets/cloth_twist.usd"
"""The scene called demo. In a checkout it stands beside the package, as the device code does, else in it."""


def add_command(
    commands: Commands,
    name: str,
    run: Callable[[argparse.Namespace], int | None] | None,
    *,
    summary: str,
    description: str,
    epilog: str,
) -> argparse.ArgumentParser:
    """Adds a command and returns its parser.

    ``run`` runs it with the parsed arguments and returns the exit status, None for 0; it is None for a group of
    commands. ``summary`` is its line in the list of commands; the help texts are above and below the options.
    """
    command = commands.add_parser(
        name, help=summary, description=description, epilog=epilog, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    command.set_defaults(run=run)
    return command


def scene_path(name: str) -> str:
    """Returns the path of a scene: for demo that of the package's own, unless there is a file of this name."""
    if name != "demo" or os.path.exists(name):
        return name
    package = Path(__file__).parents[1]
    return next(str(folder / _DEMO) for folder in (package, package.parent) if (folder / _DEMO).exists())


def add_options(group: argparse._ActionsContainer, options: Options) -> None:
    """Adds options to a command, or to a group of its options."""
    for name, option in options.items():
        group.add_argument(name, **option)


def distance(text: str) -> float:
    """Returns the distance that a text holds; an ArgumentTypeError if it is not finite, or less than 2^-1021."""
    return _real(text, SMALLEST_DISTANCE, "more than 0, at least 2^-1021")


def positive_real(text: str) -> float:
    """Returns the number that a text holds; an ArgumentTypeError if it is not finite, or not more than 0."""
    return _real(text, math.ulp(0.0), "more than 0")


def _real(text: str, least: float, what: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not least <= number < math.inf:
        raise argparse.ArgumentTypeError(f"must be a finite number {what}, not {text}")
    return number


def positive(text: str) -> int:
    """Returns the integer that a text holds; an ArgumentTypeError if it is not in [1, 2^31)."""
    return _integer(text, 1)


def natural(text: str) -> int:
    """Returns the integer that a text holds; an ArgumentTypeError if it is not in [0, 2^31)."""
    return _integer(text, 0)


def _integer(text: str, least: int) -> int:
    try:
        number = int(text)
    except ValueError:
        number = least - 1
    if not least <= number < 2**31:
        raise argparse.ArgumentTypeError(f"must be an integer of at least {least}, less than 2^31, not {text}")
    return number


def number(kind: Callable[[str], Any], help: str, *, default: float | None = None, metavar: str = "N") -> dict:
    """Returns an option whose value is a number, or another that ``kind`` makes of a text."""
    return {"type": kind, "help": help, "default": default, "metavar": metavar}


def flag(help: str) -> dict:
    """Returns an option without a value."""
    return {"action": "store_true", "help": help}


def switch(help: str) -> dict:
    """Returns an option that is set, unless its name begins with no-."""
    return {"action": argparse.BooleanOptionalAction, "default": True, "help": help}


def several(metavar: str, help: str, *, nargs: str = "*") -> dict:
    """Returns an argument that may be given any number of times."""
    return {"metavar": metavar, "nargs": nargs, "help": help}


def file_option(help: str, **more: Any) -> dict:
    """Returns an option whose value is a file."""
    return {"metavar": "FILE", "help": help, **more}


def patterns(help: str) -> dict:
    """Returns an option whose value is a list of patterns, and which may be repeated."""
    return {"nargs": "+", "action": "extend", "default": [], "metavar": "PATTERN", "help": help}


def pair(help: str) -> dict:
    """Returns an option whose value is two patterns."""
    return {"nargs": 2, "metavar": ("A", "B"), "help": help}


def names_of(known: Iterable[str], help: str, *, metavar: str = "NAME,...", all_by_default: bool = True) -> dict:
    """Returns an option whose value is a tuple of names, each once, in the order that they are given in.

    ``metavar`` stands for the value in help texts; the default is all names that there are, or None.
    """
    known = tuple(known)
    default = known if all_by_default else None
    return {"type": functools.partial(_names, known), "help": help, "default": default, "metavar": metavar}


def _names(known: tuple[str, ...], text: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(text.split(",")))
    if unknown := [name for name in names if name not in known]:
        raise argparse.ArgumentTypeError(f"must be of {', '.join(known)}, not {', '.join(unknown)!r}")
    return names


DEVICE: Options = {
    "--device": {
        "help": "Warp device, such as cpu or cuda:0; replay, and repair where it finds and checks, also take several, "
        "such as cuda:0,cuda:1, each for a process of its own (default: the first GPU, else cpu)"
    },
}
JSON: Options = {"--json": flag("print all results as JSON instead of tables")}
THREADS: Options = {"--threads": number(positive, "number of CPU cores to use, on Linux only (default: all)")}


def detection_options(method: str) -> Options:
    """Returns --method, with this default, and --device."""
    text = (
        "float: trust the signs that floating point computes; conservative: count pairs that floating point "
        "cannot certify as collisions; exact: decide these pairs in exact arithmetic (default: %(default)s)"
    )
    return {"--method": {"choices": METHODS, "default": method, "help": text}, **DEVICE}


def repeat_options(default: int) -> Options:
    """Returns --repeat."""
    text = "number of repetitions; their median is reported (default: %(default)s)"
    return {"--repeat": number(positive, text, default=default)}


def add_fail_on(group: argparse._ActionsContainer, reasons: dict[str, str]) -> None:
    """Adds --fail-on, whose value is a set of reasons: kinds of finding, each with an explanation that may be empty."""
    explained = ", ".join(f"{reason} ({text})" if text else reason for reason, text in reasons.items())
    several = " of these, separated by commas" if len(reasons) > 1 else ""
    group.add_argument(
        "--fail-on",
        type=lambda text: frozenset(_names(tuple(reasons), text)),
        default=frozenset(),
        metavar="WHAT",
        help=f"exit with status 1 if there is any{several}: {explained}",
    )
