"""The messages that kernels are compiled."""

import pytest
import warp as wp

from warp_bsc.cli import device
from warp_bsc.detection.run import compilation
from warp_bsc.response.write_back import write_back


@pytest.fixture
def load(monkeypatch, tmp_path):
    """Loads a kernel of the package anew, from an empty cache of kernels."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))

    def load_anew():
        write_back.module.unload()
        wp.load_module(write_back.module, "cpu")

    yield load_anew
    write_back.module.unload()


@pytest.mark.parametrize("log_level", [wp.LOG_INFO, wp.LOG_WARNING])
def test_one_line_says_that_kernels_are_compiled(log_level, load, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(wp.config, "log_level", log_level)
    compilation.say_compiling.cache_clear()
    load()
    load()  # from the cache
    compilation.report_compilation(is_cpu=True)  # of another module
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warp-bsc: ")]
    needed = "half a minute of processor time, two minutes for a solver"
    expected = f"warp-bsc: compiling kernels for the CPU, once for each version: {needed}."
    assert said == [f"{expected} They are kept in {tmp_path}"] * (log_level == wp.LOG_INFO)


def test_what_is_in_the_cache_is_not_reported(load):
    reported = []
    with compilation.reported_to(lambda: reported.append(1)):
        load()
        load()
    assert len(reported) == 1


def test_long_compilations_show_their_progress(monkeypatch, capsys):
    times = iter([0.0, 1.0, 3.0, 5.0, 14.0, 15.0])
    monkeypatch.setattr(device.time, "monotonic", lambda: next(times))
    with device.loading_kernels("cpu"):
        for _ in range(6):
            compilation.report_compilation(is_cpu=True)
    assert capsys.readouterr().err.splitlines() == [
        "Compiling kernels for cpu, once for each version: half a minute of processor time, two minutes for a solver.",
        "Compiling kernels: 4 modules in 14 s.",
    ]
    compilation.report_compilation(is_cpu=True)
    assert not capsys.readouterr().err
