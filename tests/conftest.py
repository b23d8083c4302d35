"""Settings of the test run: one device for all tests, what tests need, quiet Warp, repeatable hypothesis."""

import gc
import os
import signal

import hypothesis
import pytest
import warp as wp
from benchmark_data import data_folder
from chromium import CHROMIUM
from compilation import compile_for_gpus, compile_kernels_once, compile_quickly
from guarded_memory import guard_memory
from sample_sizes import cases, choose
from sanitized_kernels import SANITIZED, restart_with_sanitizers, sanitize_kernels, sanitizers_available

import warp_bsc.usd.scene  # noqa: F401 (before OpenUSD, which reads the variables that it sets: no mapped files)

gc.disable()  # until all tests are collected: each collection would look at all kernels imported so far
wp.config.log_level = wp.LOG_WARNING
wp.init()
compile_kernels_once()
hypothesis.settings.register_profile("new", deadline=None, max_examples=300)  # each night: --hypothesis-profile=new


def pytest_addoption(parser):
    """Adds the options that look for access out of bounds."""
    parser.addoption("--guard-memory", action="store_true", help="crash on access out of bounds of an array on the CPU")
    parser.addoption(
        "--compile-for", type=int, metavar="ARCH", help="at the end compile for GPUs, such as 75, what was loaded"
    )
    parser.addoption("--sanitize", action="store_true", help="run kernels on the CPU under Address and UB sanitizers")
    parser.addoption("--warp-debug", action="store_true", help="run all kernels in Warp's debug mode, which asserts")


def pytest_configure(config):
    """Sets what must be set before any kernel is loaded or array made, and signals as a terminal has them."""
    choose(config.getoption("-m"))
    if not config.getoption("--hypothesis-profile"):
        hypothesis.settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=cases(30))
        hypothesis.settings.load_profile("repeatable")
    for name, handler in (("SIGINT", signal.default_int_handler), ("SIGHUP", signal.SIG_DFL)):
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        if number and signal.getsignal(number) == signal.SIG_IGN:  # as a shell has it for programs in the background
            signal.signal(number, handler)
    if config.getoption("--sanitize"):
        if not sanitizers_available():
            raise pytest.UsageError("--sanitize needs clang 16 or later with its sanitizer runtime (libclang-rt-*-dev)")
        if not SANITIZED:
            config.pluginmanager.getplugin("capturemanager").stop_global_capturing()
            restart_with_sanitizers()
        sanitize_kernels()
    if config.getoption("--compile-for") and getattr(config.option, "numprocesses", None):
        raise pytest.UsageError("--compile-for compiles what one process has loaded: omit -n")
    if config.getoption("--guard-memory"):
        guard_memory()
    if config.getoption("--warp-debug"):
        wp.config.mode = "debug"


def _find_device():
    """The device that all tests run on: ``WARP_BSC_DEVICE``, or Warp's default."""
    return wp.get_device(os.environ.get("WARP_BSC_DEVICE") or wp.get_preferred_device())


def pytest_collection_modifyitems(items):
    """Skips the tests whose markers name something that is missing."""
    present = {
        "gpu": (_find_device().is_cuda, "needs a GPU"),
        "data": (data_folder(), "needs the public benchmark data: set WARP_BSC_DATA to its folder"),
        "browser": (CHROMIUM, "needs Chromium (Debian's package is called chromium)"),
    }
    missing = {marker: pytest.mark.skip(reason=reason) for marker, (found, reason) in present.items() if not found}
    for item in items:
        for marker, skip in missing.items():
            if item.get_closest_marker(marker):
                item.add_marker(skip)


def pytest_collection_finish():
    """Sets options of modules that are imported, and keeps what they have made out of every collection of garbage."""
    compile_quickly()
    gc.enable()
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 20, 20)  # each launch makes objects, and few of them are garbage in cycles


def pytest_sessionfinish(session):
    """Compiles for GPUs if asked, and fails if a kernel does not compile."""
    arch = session.config.getoption("--compile-for")
    problems = compile_for_gpus(arch) if arch else {}
    for name, problem in problems.items():
        print(f"\n{name} does not compile for sm_{arch}: {problem}")
    if problems:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture(scope="session", autouse=True)
def device():
    """The device that all tests run on."""
    wp.set_device(_find_device())
    return wp.get_device()
