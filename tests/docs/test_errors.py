"""The index of warnings and errors has each warning that the sources have, and nothing that they have not."""

import re
from pathlib import Path

import pytest
from warning_texts import all_texts, warning_texts

PAGE = Path(__file__).parents[2] / "docs" / "errors.md"
ENTRY = re.compile(r"^- ((?:`[^`]+`(?:,\s+|\s+and\s+)?)+)", re.MULTILINE)
PARTS = {
    "... (...:...)",
    "... times, first at time ...",
    "each of ... meshes of ...",
    "particles of another entry",
}
"""Texts that are put into a sentence that is in the index."""


@pytest.fixture(scope="module")
def fragments():
    """The beginnings of the entries: parts of messages."""
    return [" ".join(f.split()) for spans in ENTRY.findall(PAGE.read_text()) for f in re.findall(r"`([^`]+)`", spans)]


def test_each_warning_is_in_the_index(fragments):
    found = {text for _, text in warning_texts()} - PARTS
    missing = [text for text in found if not any(fragment in text for fragment in fragments)]
    assert len(found) > 50 and not missing, "docs/errors.md lacks:\n" + "\n".join(missing)


def test_each_entry_is_a_message_of_the_package(fragments):
    texts = all_texts()
    stale = [fragment for fragment in fragments if not any(fragment in text for text in texts)]
    assert len(fragments) == len(set(fragments)) > 70 and not stale, stale


@pytest.mark.parametrize(
    "text",
    [
        "a step strained an edge by more than",
        "a linear solve of a gradient did not converge",
        "take no part: faces",
        "flattened into",
        "invisible prims are not checked",
        "polygons are checked as fans",
        "draws contacts only if",
    ],
)
def test_the_sources_are_scanned_for_each_way_to_warn(text):
    """A call with a constant, one of a function, methods of a report, lists of notes."""
    assert any(text in found for _, found in warning_texts())
