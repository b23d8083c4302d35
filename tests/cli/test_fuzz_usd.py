"""Files of USD that are broken at random: a few of those that ``tests/support/fuzz_usd.py`` makes each night."""

import random

from fuzz_usd import check, write_text


def test_broken_files_are_replayed_or_refused_in_words(tmp_path):
    """Text alone, as crates that are broken make OpenUSD itself die."""
    output = tmp_path / "out"
    output.mkdir()
    found, statuses = {}, set()
    for number in range(40):
        path = write_text(random.Random(f"CI {number}"), tmp_path / f"f{number}.usda")
        status, found[number] = check(path, output)
        statuses.add(status)
        path.unlink()
    assert not {number: problem for number, problem in found.items() if problem}
    assert statuses == {0, 2, 4, 5}
