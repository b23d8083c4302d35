"""Commands for which the memory of a device does not suffice: one sentence, and no file that is cut off."""

import json

import numpy as np
import pytest
import warp as wp
from failing_memory import failing_memory
from progress_lines import without_progress
from pxr import Usd
from usd_stages import falling_stage, save

from warp_bsc.cli.main import main

SAMPLES = 5
"""Allocations that fail, of all that a command makes."""


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "scene").mkdir()
    return save(falling_stage(tmp_path / "scene"))


def words(command, scene, folder):
    folder.mkdir()
    if command == "repair":
        return ["repair", scene, "--output", str(folder / "fixed.usdc"), "--device", "cpu"]
    return ["replay", scene, "--json", str(folder / "hits.json"), "--csv", str(folder / "hits.csv"), "--device", "cpu"]


@pytest.mark.parametrize("command", ["replay", "repair"])
def test_a_command_without_memory(command, scene, tmp_path, capsys):
    device = wp.get_device("cpu")
    with failing_memory(device) as memory:
        assert main(words(command, scene, tmp_path / "whole")) == 0
    assert memory.count > SAMPLES
    for number in np.linspace(0, memory.count - 1, SAMPLES).astype(int):
        capsys.readouterr()
        folder = tmp_path / str(number)
        with failing_memory(device, number):
            assert main(words(command, scene, folder)) == 2
        said = without_progress(capsys.readouterr().err)
        assert said.startswith("warp-bsc: error: ") and "out of memory on cpu: " in said, said
        assert said.endswith("or fewer processes on a device\n") and len(said.splitlines()) == 1, said
        for path in folder.iterdir():
            if path.suffix == ".json":
                assert "out of memory" in json.loads(path.read_text())["stopped"]
            elif path.suffix == ".usdc":
                assert Usd.Stage.Open(str(path))
            else:
                assert path.suffix in (".csv", ".part"), path
    assert main(words(command, scene, tmp_path / "again")) == 0
    for path in (tmp_path / "whole").iterdir():
        assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes()
