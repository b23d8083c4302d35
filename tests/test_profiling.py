"""Ranges for profilers: a profile reads as the phases of a step."""

import os
import subprocess
import sys

import pytest

from warp_bsc._profiling import VARIABLE, phase

PROGRAM = """
import gc, sys, types
gc.disable()  # as conftest.py does while it imports
names = []
nvtx = types.ModuleType("nvtx")
nvtx.start_range = lambda name, **_: names.append(name)
nvtx.end_range = lambda *_: None
sys.modules["nvtx"] = nvtx

import newton, warp as wp, warp_bsc as bsc
wp.config.log_level = wp.LOG_ERROR
with wp.ScopedDevice("cpu"):
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    at = wp.vec3(0.0, 0.0, 1e-3)
    options = {"rot": wp.quat_identity(), "vel": wp.vec3(), "dim_x": 2, "dim_y": 2, "cell_x": 0.1, "cell_y": 0.1}
    builder.add_cloth_grid(pos=at, mass=0.01, **options)
    model = builder.finalize()
    solver = bsc.SolverCCD(newton.solvers.SolverXPBD(model))
    names.clear()
    for _ in range(4):
        state, end = model.state(), model.state()
        solver.step(state, end, None, None, 0.02)
print(*dict.fromkeys(names), sep="\\n")
"""


def test_a_profile_reads_as_the_phases_of_a_step():
    environment = os.environ | {VARIABLE: "1"}
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True)
    phases = [line.removeprefix("warp_bsc: ") for line in done.stdout.splitlines() if line.startswith("warp_bsc: ")]
    assert phases[:3] == ["inner solver", "begin", "detect contacts"]
    assert {"add proximities", "project velocities"} <= set(phases)


@pytest.mark.parametrize("value", ["0", None])
def test_without_the_variable_functions_are_themselves(monkeypatch, value):
    monkeypatch.delenv(VARIABLE, raising=False)
    if value:
        monkeypatch.setenv(VARIABLE, value)
    assert phase("begin")(abs) is abs
