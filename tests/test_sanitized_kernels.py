"""Kernels under sanitizers: they let through what is allowed, and end the process at what is not."""

import os
import subprocess
import sys

import pytest
import sanitized_kernels

PROGRAM = """
import sys
import warp as wp
from sanitized_kernels import SANITIZED, restart_with_sanitizers, sanitize_kernels

if not SANITIZED:
    restart_with_sanitizers()
wp.config.log_level = wp.LOG_ERROR
sanitize_kernels()

@wp.func_native("int values[4]; for (int i = 0; i < n; ++i) values[i] = 1 << i; return values[n - 1];")
def last_power(n: int) -> int: ...

@wp.func_native("return 1 << bits;")
def power(bits: int) -> int: ...

@wp.kernel(enable_backward=False)
def write(x: wp.array[int], at: int, n: int, bits: int):
    x[at] = last_power(n) + power(bits)

x = wp.zeros(1001, dtype=int, device="cpu")
wp.launch(write, 1, inputs=[x, 1000, 4, 30], device="cpu")
print("inside", x.numpy()[1000], flush=True)
wp.launch(write, 1, inputs=[x, *map(int, sys.argv[1:4])], device="cpu")
print("survived")
"""

FAULTS = {
    "behind an array": ("1001", "4", "30"),
    "behind a local array": ("1000", "5", "30"),
    "an undefined shift": ("1000", "4", "32"),
}


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    path = tmp_path_factory.mktemp("sanitized") / "program.py"  # Warp reads the source of kernels
    path.write_text(PROGRAM)
    return path


@pytest.mark.slow
@pytest.mark.skipif(not sanitized_kernels.sanitizers_available(), reason="needs clang with its sanitizer runtime")
@pytest.mark.parametrize("fault", FAULTS)
def test_faults_end_the_process(fault, program):
    folder = os.path.dirname(sanitized_kernels.__file__)
    run = subprocess.run(
        [sys.executable, program, *FAULTS[fault]],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": folder, "XDG_CACHE_HOME": str(program.parent)},
    )
    assert f"inside {8 + 2**30}" in run.stdout, run.stderr
    assert "survived" not in run.stdout
    assert "Sanitizer" in run.stderr and run.returncode < 0
