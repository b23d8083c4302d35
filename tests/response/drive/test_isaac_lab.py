"""The code of the page on Isaac Lab: in Isaac Lab's own classes where it is installed, and in stand-ins for them."""

import dataclasses
import importlib
import inspect
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

PAGE = Path(__file__).parents[3] / "docs" / "newton" / "isaac_lab.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
SOLVERS = {"Implicit": bsc.SolverImplicit, "CCD": bsc.SolverCCD}


class NewtonManager:
    """The slots and hooks of Isaac Lab's class that the page relies on; the tests below compare them with it."""

    _solver = None
    _use_single_state = None
    _needs_collision_pipeline = False
    _supports_rigid_body_force_input = False
    backend = None
    _solver_dt = 1.0 / 200.0

    @classmethod
    def get_solver_dt(cls):
        return cls._solver_dt

    @staticmethod
    def _filter_solver_kwargs(solver_cls, solver_cfg):
        accepted = inspect.signature(solver_cls.__init__).parameters
        return {name: value for name, value in vars(solver_cfg).items() if name in accepted}

    @classmethod
    def _step_solver(cls, state_0, state_1, control, contacts, substep_dt):
        cls._solver.step(state_0, state_1, control, contacts, substep_dt)

    @classmethod
    def _reset_solver_internals(cls, world_mask):
        cls._solver.reset(cls.backend.state_0, world_mask=world_mask, flags=0)


class NewtonVBDManager(NewtonManager):
    @classmethod
    def _prepare_builder_for_finalize(cls, builder):
        builder.color(balance_colors=False)

    @classmethod
    def _create_solver(cls, model, solver_cfg):
        options = cls._filter_solver_kwargs(newton.solvers.SolverVBD, solver_cfg)
        return newton.solvers.SolverVBD(model, **options)

    @classmethod
    def _build_solver(cls, model, solver_cfg):
        NewtonManager._solver = cls._create_solver(model, solver_cfg)
        NewtonManager._use_single_state = False
        NewtonManager._needs_collision_pipeline = True


@dataclasses.dataclass
class NewtonSolverCfg:
    class_type: str = ""


@dataclasses.dataclass
class VBDSolverCfg(NewtonSolverCfg):
    iterations: int = 10
    particle_enable_self_contact: bool = False


STAND_INS = {
    "isaaclab": {},
    "isaaclab.utils": {"configclass": dataclasses.dataclass},
    "isaaclab_newton": {},
    "isaaclab_newton.physics": {
        x.__name__: x for x in (NewtonManager, NewtonVBDManager, NewtonSolverCfg, VBDSolverCfg)
    },
}


@pytest.fixture
def task(monkeypatch, tmp_path):
    """The module of the first block of code of the page, in a package, as Isaac Lab resolves its names from there."""
    (tmp_path / "my_task").mkdir()
    (tmp_path / "my_task" / "__init__.py").touch()
    (tmp_path / "my_task" / "ccd_manager.py").write_text(BLOCKS[0])
    monkeypatch.syspath_prepend(tmp_path)
    yield lambda: importlib.import_module("my_task.ccd_manager")
    for name in ("my_task", "my_task.ccd_manager"):
        sys.modules.pop(name, None)


@pytest.fixture
def stand_ins(monkeypatch):
    for name, content in STAND_INS.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    for name in ("_solver", "_use_single_state", "_needs_collision_pipeline", "_supports_rigid_body_force_input"):
        monkeypatch.setattr(NewtonManager, name, getattr(NewtonManager, name))


@pytest.mark.parametrize("kind", SOLVERS)
def test_the_manager_steps_and_resets_worlds(stand_ins, task, kind, device, monkeypatch):
    names = vars(task())
    model = bullet(30, device=device, worlds=2)
    manager, config = names[f"Newton{kind}Manager"], names[f"{kind}SolverCfg"]()
    assert config.class_type == "{DIR}.ccd_manager:" + manager.__name__
    manager._build_solver(model, config)
    solver = NewtonManager._solver
    assert type(solver) is SOLVERS[kind] and NewtonManager._use_single_state is False
    assert NewtonManager._needs_collision_pipeline is (kind == "CCD")
    state, end, contacts = model.state(), model.state(), 0
    start = state.particle_q.numpy().copy()
    for _ in range(3):
        manager._step_solver(state, end, model.control(), None, DT)
        contacts += len(solver.report.forces.contacts.numpy()["kind"])
        state, end = end, state
    assert contacts > 10 and solver.report.certified
    moved = state.particle_q.numpy().copy()
    moved[: len(start) // 2] = start[: len(start) // 2]  # as a task puts a world back
    state.particle_q.assign(moved)
    monkeypatch.setattr(NewtonManager, "backend", types.SimpleNamespace(state_0=state))
    manager._reset_solver_internals(wp.array([True, False, False], dtype=bool, device=device))
    np.testing.assert_array_equal(state.particle_q.numpy(), moved)
    manager._step_solver(state, end, model.control(), None, DT)
    assert solver.report.certified
    monkeypatch.setattr(wp, "to_torch", lambda array: array.numpy())  # PyTorch may not be installed
    exec(BLOCKS[1], read := {})
    assert read["certified"].tolist() == [True, True] and read["forces"].size == 0  # there are no bodies


def test_the_manager_refuses_a_second_self_contact(stand_ins, task, device):
    config = task().CCDSolverCfg(particle_enable_self_contact=True)
    with pytest.raises(ValueError, match="particle_enable_self_contact"):
        task().NewtonCCDManager._build_solver(bullet(1, device=device), config)


class TestInIsaacLab:
    """Isaac Lab 3.0.0 without Isaac Sim."""

    @pytest.fixture(autouse=True)
    def physics(self):
        pytest.importorskip("isaaclab", reason="needs Python 3.12 and pip install isaaclab==3.0.0")
        return importlib.import_module("isaaclab_newton.physics")

    @pytest.mark.parametrize("name", STAND_INS["isaaclab_newton.physics"])
    def test_the_stand_ins_have_the_shape_of_its_classes(self, physics, name):
        own, their = STAND_INS["isaaclab_newton.physics"][name], getattr(physics, name)
        assert [base.__name__ for base in own.__bases__[:1] if base is not object] in ([], [their.__base__.__name__])
        if dataclasses.is_dataclass(own):
            fields, mine = ({field.name: field for field in dataclasses.fields(x)} for x in (their, own))
            assert mine.keys() <= fields.keys()
            assert all(getattr(their(), x) == getattr(own(), x) for x in mine.keys() - {"class_type"})
            return
        for key, value in vars(own).items():
            if isinstance(value, classmethod | staticmethod):
                parameters = [list(inspect.signature(getattr(x, key)).parameters) for x in (own, their)]
                assert type(vars(their)[key]) is type(value) and parameters[0] == parameters[1], key
            elif not key.startswith("__"):
                assert value == getattr(their, key), key

    @pytest.mark.parametrize("kind", SOLVERS)
    def test_cloth_falls_on_a_ball_in_two_environments(self, physics, task, kind):
        from isaac_lab_scene import cloth_above_ball  # noqa: PLC0415 (imports Isaac Lab)

        manager = physics.NewtonManager
        options = {"Implicit": {}, "CCD": {"iterations": 10, "min_distance": 0.001}}[kind]
        with cloth_above_ball(getattr(task(), f"{kind}SolverCfg")(friction=0.4, **options)) as (simulation, cloth, _):

            def heights():
                cloth.update(1.0 / 60.0)
                return cloth.data.nodal_pos_w.torch[..., 2].numpy().copy()

            solver = manager._solver
            assert type(solver) is SOLVERS[kind] and solver.friction.numpy().tolist() == [np.float32(0.4)]
            start = heights()
            for _ in range(30):
                simulation.step(render=False)
            report, fallen = solver.report, heights()
            assert report.totals.steps == 30 and report.totals.uncertified_steps == 0 and not report.penetrated
            distances = np.linalg.norm(cloth.data.nodal_pos_w.torch.numpy() - [[[0, 0, 0.3]], [[1, 0, 0.3]]], axis=2)
            assert distances.min() > 0.095 and (fallen.min(axis=1) < 0.35).all()  # it hangs over the ball
            exec(BLOCKS[1], read := {})
            assert read["certified"].tolist() == [True, True]
            assert read["forces"].shape == (2, 6) and (read["forces"][:, 2] < 0.0).all()  # the balls carry it
            cloth.write_nodal_state_to_sim_index(cloth.data.default_nodal_state_w.torch[:1], env_ids=np.int32([0]))
            manager.invalidate_fk(env_ids=wp.array([0], dtype=int, device="cpu"))
            manager.forward()  # which resets the solver
            reset = heights()
            np.testing.assert_array_equal(reset[0], start[0])
            np.testing.assert_array_equal(reset[1], fallen[1])
            simulation.step(render=False)
            assert report.totals.uncertified_steps == 0 and not report.penetrated
            assert heights()[0].min() > 0.41 and heights()[1].min() < 0.35
