"""Alembic files, which OpenUSD reads by a plugin that usd-core does not have."""

import pytest
from pxr import Sdf
from usd_stages import add_floor, new_stage, save

from warp_bsc.cli.main import main

if Sdf.FileFormat.FindByExtension("abc"):
    pytest.skip("this OpenUSD reads Alembic", allow_module_level=True)

WHY = "Alembic, for which this OpenUSD has no plugin, as usd-core has none: convert it where there is one, "
HOW = "as in Houdini or Maya, by usdcat cloth.abc --out cloth.usdc"


@pytest.fixture
def cache(tmp_path):
    path = tmp_path / "cloth.abc"
    path.write_bytes(b"Ogawa\xff")
    return path


@pytest.mark.parametrize("command", [["replay"], ["repair", "--output", "fixed.usdc"]])
def test_a_file_is_one_sentence(cache, capsys, command):
    name, *options = command
    assert main([name, str(cache), "--device", "cpu", *options]) == 2
    assert capsys.readouterr().err == f"warp-bsc: error: {cache}: {WHY}{HOW}\n"


def test_a_reference_is_left_out_with_that_sentence(cache, tmp_path, capsys):
    stage = new_stage(tmp_path / "scene.usda")
    add_floor(stage)
    stage.OverridePrim("/World/Cloth").GetReferences().AddReference("./cloth.abc")
    assert main(["replay", save(stage), "--device", "cpu"]) == 4
    assert f" ({WHY}{HOW})" in capsys.readouterr().out


def test_a_plugin_that_fails_has_its_own_message(cache, capsys, monkeypatch):
    """Where OpenUSD has a plugin, its message stands."""
    monkeypatch.setattr(Sdf.FileFormat, "FindByExtension", lambda extension: object())
    assert main(["replay", str(cache), "--device", "cpu"]) == 2
    assert "not a readable USD file: " in capsys.readouterr().err
