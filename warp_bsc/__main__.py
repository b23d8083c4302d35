"""Runs the command line: ``python -m warp_bsc`` is ``warp-bsc``."""

import os
import sys

from ._garbage import paused_collection
from .cli.error_boundary import run_guarded
from .cli.interrupts import INTERRUPTS


def main() -> int:
    """Runs the command line with the arguments of the process and returns its exit status."""
    status = run_guarded(_load_and_run)
    try:
        sys.stdout.flush()
    except (OSError, AttributeError):
        # This error is reported already; Python would report it again and end with a status of its own.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return status


def _load_and_run() -> int:
    # a library that is interrupted while it loads raises other errors, or none
    with paused_collection(), INTERRUPTS.held():
        from .cli.main import run  # noqa: PLC0415 (slow: an error meanwhile must not end in a traceback)
    INTERRUPTS.check()
    return run(sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
