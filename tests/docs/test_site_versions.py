"""The list of the versions of the site."""

import importlib.util
import json
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / ".ci" / "site_versions.py"
pytestmark = pytest.mark.skipif(not SCRIPT.exists(), reason="not a checkout")


@pytest.fixture(scope="module")
def write_versions():
    spec = importlib.util.spec_from_file_location("site_versions", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.write_versions


def test_versions_are_sorted_by_number_and_the_newest_is_preferred(write_versions, tmp_path):
    for name in ("main", "v0.2.0", "v0.10.0", "v0.9.1", "branch", ".git"):
        (tmp_path / name).mkdir()
    assert write_versions(tmp_path) == ["v0.10.0", "v0.9.1", "v0.2.0", "main"]
    entries = json.loads((tmp_path / "versions.json").read_text())
    assert [entry["version"] for entry in entries if entry.get("preferred")] == ["v0.10.0"]
    assert entries[-1]["url"].endswith("/main/")
    assert "url=v0.10.0/" in (tmp_path / "index.html").read_text()


def test_without_a_release_the_page_leads_to_main(write_versions, tmp_path):
    (tmp_path / "main").mkdir()
    assert write_versions(tmp_path) == ["main"]
    assert "url=main/" in (tmp_path / "index.html").read_text()


def test_a_folder_without_versions_is_an_error(write_versions, tmp_path):
    with pytest.raises(ValueError, match=r"no folder main, nor one of a version"):
        write_versions(tmp_path)
