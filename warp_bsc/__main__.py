"""Runs the command line: ``python -m warp_bsc`` is ``warp-bsc``."""

import os
import sys

from .cli.error_boundary import run_guarded
from .cli.interrupts import INTERRUPTS

__all__ = ["main"]


def main() -> int:
    """Runs the command line with the arguments of the process, and returns its exit status."""
    status = run_guarded(_load_and_run)
    try:
        sys.stdout.flush()
    except (OSError, AttributeError):
        # Said already, and Python would say it again and end with a status of its own.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return status


def _load_and_run():
    with INTERRUPTS.held():  # libraries that are interrupted while they are loaded make other errors of it, or none
        from .cli.main import run  # noqa: PLC0415 (slow: what happens meanwhile must not end in a traceback)
    INTERRUPTS.check()
    return run(sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
