"""Processor time of the tutorial's pages, one after the other in one process.

python tests/support/tutorial_time.py
WARP_CACHE_PATH=/tmp/empty python tests/support/tutorial_time.py --cold  # the folder must be new: kernels are compiled
"""

import argparse
import contextlib
import io
import tempfile
import time
from pathlib import Path

import warp as wp
from tutorial_notebook import PAGES, PYTHON


def seconds_of(page):
    """Runs the code of a page, and returns the processor time of this process in it [s]."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "page.py"
        path.write_text("\n".join(PYTHON.findall(page.read_text())))
        started = time.process_time()
        with contextlib.redirect_stdout(io.StringIO()):
            exec(compile(path.read_text(), str(path), "exec"), {"__name__": page.stem})
        return time.process_time() - started


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cold", action="store_true", help="Time the first run of each page, else the second.")
    is_cold = parser.parse_args().cold
    wp.config.log_level = wp.LOG_WARNING
    for page in PAGES:
        times = [seconds_of(page) for _ in range(1 if is_cold else 2)]
        print(f"{page.stem}: {times[-1]:.1f} s", flush=True)
