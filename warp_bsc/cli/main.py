"""The command line ``warp-bsc``: parses the arguments and runs the command that they name."""

import argparse
import importlib
import sys
from typing import NoReturn

from .._version import __version__
from .error_boundary import run_guarded
from .exit_status import ExitStatus, explain_statuses

_EPILOG = f"""\
examples:
  warp-bsc replay demo
  warp-bsc repair cloth.usd --output fixed.usdc
  warp-bsc query 227vf.csv 227ee.csv
  warp-bsc bench detector
  warp-bsc replay --help

{explain_statuses(*ExitStatus)}"""

_COMMANDS = {
    "replay": "find the collisions in a USD scene",
    "repair": "move the meshes of a USD scene or of mesh files so that they do not collide",
    "check": "find what crosses, touches or is not sound in mesh files",
    "query": "decide queries of CSV files",
    "bench": "measure detection, SolverCCD and repair",
}
"""The commands. Each is a module of this package, imported when it is named: some take seconds."""


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are raised as a ValueError, like those of bad input."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message}; see {self.prog} --help")


def main(argv: list[str] | None = None) -> int:
    """Runs the command line and returns the exit status, see ``warp-bsc --help``.

    Args:
        argv: The arguments; default: those of the process.
    """
    return run_guarded(lambda: run(sys.argv[1:] if argv is None else argv))


def run(argv: list[str]) -> int:
    """Runs the command line as :func:`main` does, but raises every error."""
    argv = _with_joined_frames(_with_benchmark(argv))
    arguments = build_parser(argv).parse_args(argv)
    arguments.command_line = ["warp-bsc", *argv]
    return arguments.run(arguments) or ExitStatus.DONE


def build_parser(argv: list[str] | None = None) -> argparse.ArgumentParser:
    """Returns the parser, with the options of the command that the arguments name; without any, of all commands."""
    parser = _Parser(
        prog="warp-bsc",
        description="Continuous collision detection for deforming triangle meshes.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"warp-bsc {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, summary in _COMMANDS.items():
        if argv is None or argv[:1] == [name]:
            module = importlib.import_module(f".{name}", __package__)
            more = {"named": None if argv is None else argv[1:2]} if name == "bench" else {}
            module.add_to(commands, summary, **more)
        else:
            commands.add_parser(name, help=summary)
    return parser


def _with_benchmark(argv: list[str]) -> list[str]:
    """Returns the arguments with the default benchmark inserted if ``bench`` names none."""
    if argv[:1] == ["bench"]:
        from .bench import BENCHMARKS  # noqa: PLC0415 (slow)

        if argv[1:2] not in [[name] for name in (*BENCHMARKS, "-h", "--help")]:
            return ["bench", "paper", *argv[1:]]
    return argv


def _with_joined_frames(argv: list[str]) -> list[str]:
    """Returns the arguments with the value of --frames joined to it, as argparse would take "-10:-8" for an option."""
    if "--frames" not in argv[:-1]:
        return argv
    index = argv.index("--frames")
    return [*argv[:index], "=".join(argv[index : index + 2]), *_with_joined_frames(argv[index + 2 :])]
