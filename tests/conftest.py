"""Settings of the test run: one device for all tests, quiet Warp, repeatable hypothesis."""

import os

import hypothesis
import pytest
import warp as wp
from guarded_memory import guard_memory

wp.config.log_level = wp.LOG_WARNING
wp.init()
hypothesis.settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=60)
hypothesis.settings.load_profile("repeatable")


def pytest_addoption(parser):
    """Adds the options that look for access out of bounds."""
    parser.addoption("--guard-memory", action="store_true", help="crash on access out of bounds of an array on the CPU")
    parser.addoption("--warp-debug", action="store_true", help="run all kernels in Warp's debug mode, which asserts")


def pytest_configure(config):
    """Sets what must be set before any kernel is loaded or array made."""
    if config.getoption("--guard-memory"):
        guard_memory()
    if config.getoption("--warp-debug"):
        wp.config.mode = "debug"


def _find_device():
    """The device that all tests run on: ``WARP_BSC_DEVICE``, or Warp's default."""
    return wp.get_device(os.environ.get("WARP_BSC_DEVICE") or wp.get_preferred_device())


def pytest_collection_modifyitems(items):
    """Skips the tests that need a GPU where they would run on another device."""
    if not _find_device().is_cuda:
        for item in items:
            if item.get_closest_marker("gpu"):
                item.add_marker(pytest.mark.skip(reason="needs a GPU"))


@pytest.fixture(scope="session", autouse=True)
def device():
    """The device that all tests run on."""
    wp.set_device(_find_device())
    return wp.get_device()
