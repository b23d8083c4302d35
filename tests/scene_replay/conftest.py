"""What tests of pages in a browser share."""

import pytest
from chromium import CHROMIUM, Browser


@pytest.fixture
def browser(tmp_path):
    if CHROMIUM is None:
        pytest.skip("no Chromium here")
    with Browser(tmp_path / "profile", height=900) as opened:
        yield opened
