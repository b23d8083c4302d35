"""The message that kernels are compiled."""

import time

import pytest
import warp as wp

from warp_bsc.cli import device


@pytest.mark.parametrize("compiles", [False, True])
def test_the_message_comes_only_if_kernels_are_compiled(compiles, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(device, "_SILENT_SECONDS", 0.02)
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    with device.loading_kernels(wp.get_device("cpu")):
        if compiles:
            (tmp_path / "wp_module").mkdir()
        time.sleep(0.2)
    printed = capsys.readouterr().err
    assert printed.count("Compiling kernels for cpu") == compiles and bool(printed) == compiles
