"""The program that measures environments in which grippers lift cloths."""

import sys

import pytest
import warp as wp
from lift_throughput import SOLVERS, build, main


@pytest.mark.slow
def test_solvers_lift_the_cloth(device, monkeypatch, capsys):
    """All lift it; behind the stage, all steps are certified, and the exact detector finds no crossing."""
    pytest.importorskip("mujoco_warp", reason='needs MuJoCo: pip install "newton[sim]"')
    monkeypatch.setattr(sys, "argv", ["lift_throughput.py", "--worlds", "1", "--steps", "60", "--device", str(device)])
    main()
    header, *lines = capsys.readouterr().out.splitlines()
    assert header.split() == ["solver", "worlds", "env-steps/s", "crossings", "uncertified", "episodes", "lifted"]
    rows = {line[:22].strip(): line[22:].split() for line in lines}
    assert rows.keys() == SOLVERS.keys()
    for name, (worlds, rate, crossings, uncertified, episodes, lifted) in rows.items():
        assert (worlds, episodes, lifted) == ("1", "1", "1") and float(rate) > 0.0
        if name.startswith("Solver"):
            assert (crossings, uncertified) == ("0", "0")


def test_worlds_are_those_of_isaac_lab(device):
    with wp.ScopedDevice(device):
        model = build(2)
    assert model.world_count == 2 and model.tri_count == 2 * 128 and model.particle_count == 2 * 81
    assert model.particle_mass.numpy().sum() == pytest.approx(2 * 0.04)
    assert model.joint_effort_limit.numpy()[[1, 2, 4, 5]].tolist() == [500.0] * 4


def test_steps_must_be_a_multiple_of_ten(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["lift_throughput.py", "--steps", "15"])
    with pytest.raises(SystemExit):
        main()
    assert "--steps must be a multiple of 10, not 15" in capsys.readouterr().err
