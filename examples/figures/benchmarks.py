"""Draws the paper's benchmarks on several devices in one figure, in the layout of its Figure 7.

    warp-bsc bench --device cpu --json cpu.json
    warp-bsc bench --device cuda:0 --json gpu.json
    python examples/figures/benchmarks.py cpu.json gpu.json benchmarks.png

``warp-bsc bench --figure`` draws the same for one run. Needs matplotlib (``pip install matplotlib``).
"""

import argparse
import json
from pathlib import Path

from warp_bsc.bench.figure import draw_paper_benchmarks


def main():
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("times", nargs="+", type=Path, help="JSON of warp-bsc bench")
    parser.add_argument("picture", help="file to write, .png, .svg or .pdf")
    arguments = parser.parse_args()
    draw_paper_benchmarks([json.loads(path.read_text()) for path in arguments.times], arguments.picture)


if __name__ == "__main__":
    main()
