"""Times frames of Newton's ``cloth_rollers`` on a GPU: plain, with ``SolverCCD``, and with the filter that it names.

``python tests/support/rollers_frames.py [FRAMES]`` prints the median and the mean of a frame in ms, of all frames and
from frame 53 on, where a roller takes the cloth through the ground. Each run is a process of its own, with the CUDA
graph of the example; plain ones are the first and the last. Then it prints the ratios to the mean of these two.
"""

import importlib
import json
import subprocess
import sys
import time

import newton
import newton.examples
import numpy as np
import warp as wp

import warp_bsc as bsc

MODES = ("plain", "stage", "filter", "plain")
WARM_UP, THROUGH_GROUND = 2, 52


class Staged:
    """Stands in for Newton's ``SolverVBD``: makes it behind a stage."""

    def __init__(self, *, filtered):
        """Prepares stages, which let everything pass through the ground if ``filtered``."""
        self._inner, self.stage = newton.solvers.SolverVBD, None
        self._options = {"collision_filter": bsc.CollisionFilter(shape_mask=np.zeros(1, int))} if filtered else {}

    def __call__(self, *arguments, **options):
        """Returns a new stage."""
        self.stage = bsc.SolverCCD(self._inner(*arguments, **options), **self._options)
        return self.stage

    def __getattr__(self, name):
        """Returns an attribute of Newton's class."""
        return getattr(self._inner, name)


def measure(mode, frames):
    """Returns what frames of the example take in ms, and what the stage reports."""
    staged = None if mode == "plain" else Staged(filtered=mode == "filter")
    newton.solvers.SolverVBD = staged or newton.solvers.SolverVBD
    example = importlib.import_module("newton.examples.cloth.example_cloth_rollers")
    options = newton.examples.create_parser().parse_args(["--viewer", "null"])
    run, times = example.Example(newton.viewer.ViewerNull(num_frames=frames), options), []
    for _ in range(frames):
        wp.synchronize()
        begin = time.perf_counter()
        run.step()
        wp.synchronize()
        times.append(1e3 * (time.perf_counter() - begin))
    found = {}
    for name, first in (("all", WARM_UP), ("from frame 53 on", THROUGH_GROUND)):
        found[f"median, {name}"] = round(float(np.median(times[first:])), 1)
        found[f"mean, {name}"] = round(float(np.mean(times[first:])), 1)
    return found, "" if staged is None else str(staged.stage.report)


def main():
    """Prints the times of each mode, and their ratios."""
    frames = sys.argv[1] if len(sys.argv) > 1 else "100"
    if len(sys.argv) > 2:
        print(json.dumps(measure(sys.argv[2], int(frames))))
        return
    found = []
    for mode in MODES:
        result = subprocess.run([sys.executable, __file__, frames, mode], stdout=subprocess.PIPE, text=True, check=True)
        times, report = json.loads(result.stdout.splitlines()[-1])
        found.append(times)
        print(f"{mode}: {times}", report, sep="\n", flush=True)
    for mode, times in zip(MODES[1:3], found[1:3], strict=True):
        ratios = {name: round(2.0 * t / (found[0][name] + found[-1][name]), 2) for name, t in times.items()}
        print(f"{mode} / plain: {ratios}")


if __name__ == "__main__":
    main()
