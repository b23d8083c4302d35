"""Settings of the test run: one device for all tests, quiet Warp, repeatable hypothesis."""

import os

import hypothesis
import pytest
import warp as wp

wp.config.log_level = wp.LOG_WARNING
wp.init()
hypothesis.settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=60)
hypothesis.settings.load_profile("repeatable")


@pytest.fixture(scope="session", autouse=True)
def device():
    """The device that all tests run on: ``WARP_BSC_DEVICE``, or Warp's default."""
    wp.set_device(os.environ.get("WARP_BSC_DEVICE") or wp.get_preferred_device())
    return wp.get_device()
