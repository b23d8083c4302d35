"""Simulators on the same scenes: what is run, what is judged, and why a run is missing."""

import dataclasses
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from warp_bsc.bench.measure import penetration
from warp_bsc.bench.measure.judge import Judge
from warp_bsc.bench.measure.penetration import FRAME_RATE, SCENES, SIMULATORS, measure_penetration
from warp_bsc.bench.peers import libuipc as penetration_libuipc
from warp_bsc.bench.peers import mujoco_flex as penetration_mujoco
from warp_bsc.bench.peers import newton_solvers as penetration_newton
from warp_bsc.bench.peers.newton_solvers import simulate_newton
from warp_bsc.bench.peers.states import find_bodies, held_positions
from warp_bsc.bench.scenes.penetration import SCENES as BUILDERS
from warp_bsc.bench.scenes.penetration import build_penetration_scene
from warp_bsc.bench.scenes.simulation import NotFinite

each_scene = pytest.mark.parametrize("scene", SCENES)


@pytest.fixture(autouse=True)
def on_the_cpu():
    with wp.ScopedDevice("cpu"):
        yield


def positions(model):
    return model.particle_q.numpy().astype(np.float64)


def measure(*arguments, **options):
    return SimpleNamespace(**measure_penetration(*arguments, **options).measured)


@each_scene
def test_no_scene_begins_with_a_crossing_or_a_stretch(scene):
    assert tuple(SCENES) == tuple(BUILDERS)
    built = build_penetration_scene(scene, "vbd", 600)
    start = positions(built.scene.model)
    found = Judge(built.scene.model).judge([start, start], 1)
    assert found["crossings"] == found["inverted"] == found["collisions"] == [0]
    assert found["stretch"] == pytest.approx(0.0, abs=1e-3)
    held, places = held_positions(built.scene.motion, 0.0)
    np.testing.assert_allclose(start[held], places, atol=1e-7)
    if built.flying:
        qd = built.scene.model.particle_qd.numpy()
        np.testing.assert_array_equal(qd[built.flying], np.tile(np.float32(built.flight), (len(built.flying), 1)))
        assert len(built.flying) + np.count_nonzero(~qd.any(axis=1)) == len(qd)


def test_rates_are_whole_numbers_of_steps_a_frame():
    assert all(simulator.rate % FRAME_RATE == 0 for simulator in SIMULATORS.values())


def test_bodies_and_their_stiffness():
    built = build_penetration_scene("soft", "vbd", 600)
    model = built.scene.model
    sheet, block = find_bodies(model)
    assert (sheet.is_soft, block.is_soft) == (False, True)
    assert len(sheet.particles) == 17 * 17 and len(block.particles) == 4**3
    assert (sheet.elements.shape, block.elements.shape) == ((512, 3), (3**3 * 5, 4))
    x = positions(model)
    for body in (sheet, block):
        a, b, c = x[body.particles][body.faces].transpose(1, 0, 2)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0
        assert area == pytest.approx(0.8**2 if body is sheet else 6 * 0.15**2, rel=1e-5)
    assert (sheet.area, sheet.volume) == (pytest.approx(0.8**2), 0.0)
    assert (block.area, block.volume) == (0.0, pytest.approx(0.15**3, rel=1e-5))
    # equal Lamé parameters: a third in the plane, a quarter in space
    assert sheet.poisson == pytest.approx(1.0 / 3.0)
    assert block.poisson == pytest.approx(0.25)
    assert sheet.young == pytest.approx(2.0 * (1.0 + 1.0 / 3.0) * sheet.mu)
    assert block.young == pytest.approx(2.5 * block.mu)


@pytest.mark.parametrize("simulator", ["xpbd", "ccd-xpbd", "implicit"])
def test_a_bullet_passes_a_solver_without_detection_and_no_other(simulator):
    """XPBD is the fastest here. The patch meets the sheet in the second frame."""
    steps = []
    found = measure("bullet", simulator, frames=2, progress=lambda done, count: steps.append((done, count)))
    rate = SIMULATORS[simulator].rate
    taken = 4 if rate == FRAME_RATE else 20
    assert (found.frames, found.steps, found.triangles) == (taken * FRAME_RATE // rate, taken, 512 + 128)
    assert steps[-1] == (2 * taken, 2 * taken) and steps == sorted(steps)  # run, then judged
    assert found.speed_kept == pytest.approx(1.0 + 0.5 * 9.81 / rate / 20.0, abs=1e-4)  # gravity acts a step at once
    assert not any(found.inverted)
    assert found.milliseconds["median"] > 0.0
    if simulator == "xpbd":
        assert found.collisions > 100 and 1 <= found.colliding_steps <= 4
        assert found.uncertified_steps is None
    else:
        assert found.collisions == found.uncertified_steps == sum(found.crossings) == 0


@pytest.mark.parametrize("has_stage", [False, True])
def test_the_stage_replaces_the_contacts_of_newton(monkeypatch, has_stage):
    made = []

    class Recorder(penetration_newton.Simulation):
        def __init__(self, *arguments, **options):
            made.append(options)
            super().__init__(*arguments, **options)

    monkeypatch.setattr(penetration_newton, "Simulation", Recorder)
    measure_penetration("bullet", "ccd-xpbd" if has_stage else "xpbd", frames=1)
    (options,) = made
    assert options["has_contacts"] is not has_stage
    assert options["stage_options"] == ({} if has_stage else None)


def test_self_contact_limits_the_speed_of_what_flies_freely():
    """To half the relaxed reach a step, as VBD cuts paths; the first of nine steps is faster."""
    found = measure("bullet", "vbd-self-contact", frames=1)
    built = build_penetration_scene("bullet", "vbd", 600)
    limit = 0.5 * 0.85 * (built.margin + built.gap) * 600
    assert found.speed_kept == pytest.approx(limit / 20.0, rel=0.25)
    assert found.speed_kept < 0.4


def test_what_was_built_without_metadata_is_measured(monkeypatch):
    monkeypatch.setitem(SIMULATORS, "xpbd", dataclasses.replace(SIMULATORS["xpbd"], package="no-such-distribution"))
    assert measure("bullet", "xpbd", frames=1).version == "of unknown version"


def test_a_step_that_meets_something_says_nothing_of_free_flight():
    """The block meets the sheet 10 ms after the start."""
    built = build_penetration_scene("soft", "vbd", 60)
    start = positions(built.scene.model)
    assert penetration.find_speed_kept(built, [start, start], 60) is None
    assert penetration.find_speed_kept(built, [start, start], 120) == 0.0


def test_what_a_solver_cannot_run_is_a_reason():
    run = measure_penetration("soft", "style3d")
    assert run.measured is None
    assert "Style3D has no tetrahedra" in run.problem


def test_a_scene_that_bursts_is_a_reason(monkeypatch):
    built = build_penetration_scene("bullet", "xpbd", 600)
    monkeypatch.setattr(penetration_newton, "_BURST", 0.01)
    options = {"has_self_contact": False, "has_stage": False}
    with pytest.raises(NotFinite, match=r"it bursts: after step [0-9]+ an edge is 1 times as long"):
        simulate_newton(built, "xpbd", 600, 0.1, lambda *_: None, **options)


@pytest.mark.parametrize(
    ("module", "name", "simulator"),
    [
        (penetration_mujoco, "mujoco", "mujoco-ipc"),
        (penetration_libuipc, "uipc", "libuipc"),
    ],
)
def test_what_is_not_installed_is_a_reason(monkeypatch, module, name, simulator):
    monkeypatch.setattr(module, name, None)
    run = measure_penetration("bullet", simulator, frames=1)
    assert run.measured is None
    assert f"is not installed: pip install {SIMULATORS[simulator].package}" in run.problem


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (("gone", "vbd"), {}, "scene must be one of bullet"),
        (("bullet", "gone"), {}, "simulator must be one of vbd"),
        (("bullet", "vbd"), {"frames": 0}, "frames must be at least 1, not 0"),
    ],
)
def test_bad_arguments(arguments, options, message):
    with pytest.raises(ValueError, match=message):
        measure_penetration(*arguments, **options)


def test_mujoco_is_given_the_scenes():
    mujoco = pytest.importorskip("mujoco")
    for scene in SCENES:
        built = build_penetration_scene(scene, "vbd", 600)
        model = built.scene.model
        held = set(held_positions(built.scene.motion, 0.0)[0].tolist())
        made = mujoco.MjModel.from_xml_string(penetration_mujoco.make_mujoco_xml(model, held, 600))
        assert made.opt.enableflags & mujoco.mjtEnableBit.mjENBL_IPC
        assert made.opt.timestep == pytest.approx(1.0 / 600.0)
        assert made.nflex == len(find_bodies(model))
        data = mujoco.MjData(made)
        mujoco.mj_forward(made, data)
        order = np.concatenate([body.particles for body in find_bodies(model)])
        np.testing.assert_allclose(data.flexvert_xpos, positions(model)[order], atol=1e-12)
        moving = model.particle_mass.numpy()[model.particle_mass.numpy() > 0.0]
        masses = [made.body(f"p{i}").mass[0] for i in range(model.particle_count) if _is_moving(model, i)]
        np.testing.assert_allclose(masses, moving)
        assert made.ngeom == model.shape_count


def _is_moving(model, i):
    return model.particle_mass.numpy()[i] > 0.0


def test_mujoco_holds_a_bullet_and_turns_borders():
    pytest.importorskip("mujoco")
    found = measure("bullet", "mujoco-ipc", frames=3)
    assert (found.device, found.steps, found.collisions, sum(found.crossings)) == ("cpu", 30, 0, 0)
    assert found.speed_kept == pytest.approx(1.0, abs=1e-3)
    built = build_penetration_scene("twist", "vbd", 600)
    trajectory = penetration_mujoco.simulate_mujoco(built, 600, 0.1, lambda *_: None)
    held, places = held_positions(built.scene.motion, 0.1)
    np.testing.assert_allclose(trajectory.states[-1][held], places, atol=1e-4)
    assert np.abs(trajectory.states[-1] - trajectory.states[0]).max() > 0.05


def test_mujoco_without_the_flag_is_a_reason(monkeypatch):
    mujoco = pytest.importorskip("mujoco")
    old = dataclasses.make_dataclass("Old", ["mjtEnableBit", "__version__"])(object(), "3.13.0")
    assert hasattr(mujoco.mjtEnableBit, "mjENBL_IPC")
    monkeypatch.setattr(penetration_mujoco, "mujoco", old)
    assert (
        measure_penetration("bullet", "mujoco-ipc").problem
        == "MuJoCo 3.13.0 has no ipc contact: it needs 3.14 or later"
    )


@pytest.mark.skipif(sys.platform != "linux", reason="libuipc has no wheel for other systems here")
@each_scene
def test_libuipc_accepts_the_scenes(scene, tmp_path):
    """By its sanity check, which needs no GPU."""
    uipc = pytest.importorskip("uipc")
    uipc.Logger.set_level(uipc.Logger.Level.Critical)
    built = build_penetration_scene(scene, "vbd", 120)
    made = penetration_libuipc.LibuipcScene(built, 120)
    engine = uipc.Engine("none", str(tmp_path))  # a world does not keep it
    world = uipc.World(engine)
    world.init(made.scene)
    assert world.is_valid()
    np.testing.assert_array_equal(made.positions(), positions(built.scene.model))
