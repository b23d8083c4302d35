"""What is said where OpenUSD is missing or too old."""

import sys
import tomllib
from pathlib import Path

import pytest
from pxr import Usd

import warp_bsc as bsc
from warp_bsc.cli.main import main
from warp_bsc.usd.read.openusd import OLDEST, check_openusd


def test_without_openusd_a_scene_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pxr", None)  # as if it were not installed
    with pytest.raises(ImportError, match=r"USD scenes need OpenUSD.*pip install 'warp-bsc\[usd\]'"):
        bsc.Scene("scene.usd")
    assert main(["replay", "demo", "--device", "cpu"]) == 2
    said = "USD scenes need OpenUSD, whose Python package pxr cannot be imported: pip install 'warp-bsc[usd]'"
    assert capsys.readouterr().err == f"warp-bsc: error: {said}\n"


def test_an_openusd_that_is_too_old_is_named(monkeypatch):
    monkeypatch.setattr(Usd, "GetVersion", lambda: (0, 24, 11))
    with pytest.raises(ImportError, match=r"OpenUSD 25\.08 or later, and .*pxr.* is of 24\.11: update the package"):
        bsc.Scene("scene.usd")
    monkeypatch.setattr(Usd, "GetVersion", lambda: (0, *OLDEST))
    check_openusd()


def test_the_oldest_openusd_is_that_of_the_extra():
    project = Path(__file__).parents[3] / "pyproject.toml"
    extras = tomllib.loads(project.read_text())["project"]["optional-dependencies"]
    assert extras["usd"] == ["usd-core>={}.{}".format(*OLDEST)]
