"""The code of the page on Isaac Lab, against stand-ins for the classes of Isaac Lab that it names."""

import re
import sys
import types
from pathlib import Path

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import DT, bullet

import warp_bsc as bsc

PAGE = Path(__file__).parents[2] / "docs" / "newton" / "isaac_lab.md"


class NewtonManager:
    """Its slots and hooks, as the documentation lists them."""

    _solver = None

    @classmethod
    def _step_solver(cls, state_0, state_1, control, contacts, substep_dt):
        cls._solver.step(state_0, state_1, control, contacts, substep_dt)

    @classmethod
    def _reset_solver_internals(cls, state, world_mask):
        cls._solver.reset(state, world_mask=world_mask, flags=0)


class NewtonVBDManager(NewtonManager):
    @classmethod
    def _create_solver(cls, model, solver_cfg):
        return newton.solvers.SolverVBD(model, iterations=solver_cfg.iterations)

    @classmethod
    def _build_solver(cls, model, solver_cfg):
        NewtonManager._solver = cls._create_solver(model, solver_cfg)


class VBDSolverCfg:
    iterations = 3
    particle_enable_self_contact = False


@pytest.fixture
def page(monkeypatch):
    """The names of the first block of code of the page."""
    names = {"NewtonManager": NewtonManager, "NewtonVBDManager": NewtonVBDManager, "VBDSolverCfg": VBDSolverCfg}
    modules = {"isaaclab": {}, "isaaclab.utils": {}, "isaaclab.utils.configclass": {"configclass": lambda cls: cls}}
    modules |= {"isaaclab_newton": {}, "isaaclab_newton.physics": names}
    for name, content in modules.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    code = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    found = {}
    exec(code[0], found)
    return found, code[1]


def test_the_manager_steps_and_resets_worlds(page, device):
    names, reading = page
    model = bullet(30, device=device, worlds=2)
    manager, config = names["NewtonCCDManager"], names["CCDSolverCfg"]()
    manager._build_solver(model, config)
    assert isinstance(NewtonManager._solver, bsc.SolverCCD)
    state, end, contacts = model.state(), model.state(), 0
    start = state.particle_q.numpy().copy()
    for _ in range(3):
        manager._step_solver(state, end, model.control(), None, DT)
        contacts += len(NewtonManager._solver.report.contacts.numpy()["kind"])
        state, end = end, state
    assert contacts > 10 and NewtonManager._solver.report.certified
    moved = state.particle_q.numpy().copy()
    moved[: len(start) // 2] = start[: len(start) // 2]  # as a task puts a world back
    state.particle_q.assign(moved)
    manager._reset_solver_internals(state, wp.array([True, False, False], dtype=bool, device=device))
    np.testing.assert_array_equal(state.particle_q.numpy(), moved)
    manager._step_solver(state, end, model.control(), None, DT)
    assert NewtonManager._solver.report.certified
    fake = types.SimpleNamespace(**vars(wp))
    fake.to_torch = lambda array: array.numpy()  # PyTorch may not be installed
    exec(reading.replace("import warp as wp\n", ""), scope := {"NewtonManager": NewtonManager, "wp": fake, "dt": DT})
    assert scope["certified"].tolist() == [True, True] and scope["forces"].size == 0  # there are no bodies


def test_the_manager_refuses_a_second_self_contact(page, device):
    names, _ = page
    config = names["CCDSolverCfg"]()
    config.particle_enable_self_contact = True
    with pytest.raises(ValueError, match="particle_enable_self_contact"):
        names["NewtonCCDManager"]._build_solver(bullet(1, device=device), config)
