"""The package: what of a checkout can be imported as a part of it."""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import warp_bsc

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("name", ["tests", "examples", "assets", "warp_bsc"])
def test_what_stands_beside_the_package_is_no_part_of_it(name):
    assert (ROOT / name).is_dir()
    assert importlib.util.find_spec(f"warp_bsc.{name}") is None


def test_a_checkout_that_is_not_installed_has_its_own_kernels(tmp_path):
    """Whatever is installed."""
    package = Path(warp_bsc.__file__).parent
    kernels = Path(importlib.util.find_spec("warp_bsc.kernels").origin).parent
    shutil.copytree(package, tmp_path / "warp_bsc", ignore=shutil.ignore_patterns("kernels"))
    shutil.copytree(kernels, tmp_path / "kernels")
    script = "import importlib.util as u; print(u.find_spec('warp_bsc').origin, u.find_spec('warp_bsc.kernels').origin)"
    command, environment = [sys.executable, "-c", script], os.environ | {"PYTHONPATH": str(tmp_path)}
    found = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert found.stdout.split() == [str(tmp_path / name / "__init__.py") for name in ("warp_bsc", "kernels")]
