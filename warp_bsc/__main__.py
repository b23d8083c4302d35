"""Runs the command line: ``python -m warp_bsc`` is ``warp-bsc``."""

import sys

from .cli.main import main

if __name__ == "__main__":
    sys.exit(main())
