"""The program that counts the tetrahedra that steps invert, on two steps of the block that is thrown."""

import sys

import pytest
from inverting_steps import MODES, main


@pytest.mark.slow
def test_a_row_for_each_mode(monkeypatch, capsys):
    """Alone and behind the stage, VBD inverts tetrahedra, as the report says; with prevention it does not."""
    monkeypatch.setattr(sys, "argv", ["inverting_steps.py", "throw", "--steps", "2"])
    main()
    header, *lines = capsys.readouterr().out.splitlines()
    assert header.split()[:3] == ["scene", "mode", "steps"]
    assert [line.split()[1] for line in lines] == list(MODES)
    inverting = {line.split()[1]: [int(x) for x in line.split()[5:7]] for line in lines}
    assert all(float(line.split()[3]) > 0.0 and line.split()[2] == "2" for line in lines)
    assert inverting["plain"][1] > 0 and inverting["prevented"] == [0, 0]
    assert inverting["reported"] == inverting["allowed"] and inverting["allowed"][1] > 100
    assert f"{inverting['reported'][0]} that inverted tetrahedra" in lines[2]
