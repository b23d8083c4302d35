"""The program that measures steps a second by the number of worlds, on one and two worlds."""

import sys

import pytest
from worlds_throughput import SOLVERS, build, main


@pytest.mark.slow
def test_a_row_for_each_solver_and_number_of_worlds(device, monkeypatch, capsys):
    """Behind the stage all steps are certified, and the exact detector finds no crossing; behind VBD alone it does."""
    arguments = ["worlds_throughput.py", "--worlds", "1", "2", "--steps", "20", "--device", str(device)]
    monkeypatch.setattr(sys, "argv", arguments)
    main()
    header, *lines = capsys.readouterr().out.splitlines()
    assert header.split() == ["solver", "worlds", "steps/s", "by", "processor", "MB/world", "crossings", "uncertified"]
    rows = [(line[:20].strip(), *line[20:].split()) for line in lines]
    assert [row[:2] for row in rows] == [(name, worlds) for worlds in "12" for name in SOLVERS]
    for name, _, by_clock, by_processor, memory, crossings, uncertified in rows:
        assert float(by_clock) > 0.0 and float(by_processor) > 0.0
        assert memory == "-" if device.is_cpu else float(memory) > 0.0
        if not name.startswith("VBD"):
            assert (crossings, uncertified) == ("0", "0")
        else:
            assert uncertified == "-"
    without = [int(row[5]) for row in rows if row[0] == "VBD"]
    assert 0 < without[0] < without[1]


def test_worlds_are_those_asked_for(device):
    model = build(2)
    assert model.world_count == 2 and model.tri_count == 400
    assert model.particle_world.numpy().tolist() == [0] * 121 + [1] * 121


def test_steps_must_be_a_multiple_of_twenty(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["worlds_throughput.py", "--steps", "30"])
    with pytest.raises(SystemExit):
        main()
    assert "--steps must be a multiple of 20, not 30" in capsys.readouterr().err


def test_one_row_and_no_gpu_of_that_rank(device, monkeypatch, capsys):
    arguments = ["worlds_throughput.py", "--worlds", "1", "--steps", "20", "--solvers", "VBD"]
    monkeypatch.setattr(sys, "argv", [*arguments, "--device", str(device)])
    monkeypatch.setenv("LOCAL_RANK", "99")  # an option goes first
    main()
    _header, line = capsys.readouterr().out.splitlines()
    assert line.split()[:2] == ["VBD", "1"]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(Exception, match="cuda:99"):
        main()
