"""The guard of arrays on the CPU: it lets through what is allowed, and nothing else."""

import os
import subprocess
import sys

import guarded_memory
import pytest

PROGRAM = """
import warp as wp
from guarded_memory import guard_memory

wp.config.log_level = wp.LOG_ERROR
guard_memory()

@wp.kernel
def write(x: wp.array[float], at: int):
    x[at] = 1.0

x = wp.empty(1000, dtype=float, device="cpu")
assert x.numpy()[0] != 0.0  # filled
alias = wp.array(ptr=x.ptr, shape=1001, dtype=float, device="cpu")
wp.launch(write, 1, inputs=[alias, 999], device="cpu")
print("inside", flush=True)
{rest}
print("survived")
"""

CRASHES = {
    "behind the end": 'wp.launch(write, 1, inputs=[alias, 1000], device="cpu")',
    "after release": 'del x; wp.launch(write, 1, inputs=[alias, 0], device="cpu")',
}


@pytest.mark.skipif(sys.platform != "linux", reason="Linux only")
@pytest.mark.parametrize("rest", ["", *CRASHES.values()], ids=["allowed", *CRASHES])
def test_access_out_of_bounds_crashes(rest, tmp_path):
    program = tmp_path / "program.py"  # Warp reads the source of kernels
    program.write_text(PROGRAM.format(rest=rest))
    run = subprocess.run(
        [sys.executable, program],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": guarded_memory.__file__.rpartition(os.sep)[0]},
    )
    assert "inside" in run.stdout
    assert ("survived" in run.stdout) == (rest == ""), run.stderr
    assert (run.returncode < 0) == (rest != "")
