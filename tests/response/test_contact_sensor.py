"""Contact sensors: forces by environment and by what is touched, of weights that are known."""

import newton
import numpy as np
import pytest
import warp as wp

import warp_bsc as bsc

WORLDS, DT, GRAVITY = 3, 1.0 / 60.0, 9.81
SIDE = 0.2  # m, of a cloth of 16 quads
CLOTH = np.array([1.0, 2.0, 4.0]) * 0.025  # kg, of the cloth of each world
BOX = 0.3  # kg


def build(device):
    """Returns a model of worlds in which a cloth lies on a box that rests on a table; cloths have different masses."""
    builder = newton.ModelBuilder()
    for mass in CLOTH:
        world = newton.ModelBuilder()
        table = world.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, -0.05), wp.quat_identity()), label="table")
        world.add_shape_box(table, hx=0.3, hy=0.3, hz=0.05, label="top")
        world.body_flags[table] = int(newton.BodyFlags.KINEMATIC)
        density = newton.ModelBuilder.ShapeConfig(density=BOX / (0.2 * 0.2 * 0.1))
        box = world.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.0501), wp.quat_identity()), label="box")
        world.add_shape_box(box, hx=0.1, hy=0.1, hz=0.05, cfg=density, label="sides")
        cell = SIDE / 4
        world.add_cloth_grid(
            pos=wp.vec3(-0.5 * SIDE, -0.5 * SIDE, 0.101),
            rot=wp.quat_identity(),
            vel=wp.vec3(),
            dim_x=4,
            dim_y=4,
            cell_x=cell,
            cell_y=cell,
            mass=mass / 25,
            tri_ke=1e3,
            tri_ka=1e3,
            edge_ke=1e-3,
        )
        builder.add_world(world)
    builder.color()
    return builder.finalize(device=device)


class Scene:
    """The scene, its solver and sensors."""

    def __init__(self, device):
        self.solver = bsc.SolverImplicit(build(device), report=["contacts"])
        self.sensor = bsc.ContactSensor(
            self.solver,
            ["box", "tab*", "particles"],
            ["box", "top", "particles"],
            history_length=3,
            force_threshold=0.1,
        )
        self.state = self.solver.model.state()

    def step(self, mask=None):
        """Takes a step and reads it."""
        self.solver.step(self.state, self.state, None, None, DT, world_mask=mask)
        self.sensor.update(DT, mask)


@pytest.fixture(scope="module")
def rested(device):
    """The scene after cloth and box have come to rest."""
    scene = Scene(device)
    for _ in range(60):
        scene.step()
    return scene


def test_what_rests_shows_its_weight_by_world_and_filter(rested):
    data, weight = rested.sensor.data, GRAVITY * CLOTH
    box, table, cloth = (data.net_forces_w.numpy()[:, sensor] for sensor in range(3))
    up = np.zeros((WORLDS, 3))
    up[:, 2] = 1.0
    tolerance = {"rtol": 0.0, "atol": 0.01 * GRAVITY * BOX}
    np.testing.assert_allclose(cloth, weight[:, None] * up, **tolerance)
    np.testing.assert_allclose(box, GRAVITY * BOX * up, **tolerance)
    np.testing.assert_allclose(table, -(weight[:, None] + GRAVITY * BOX) * up, **tolerance)
    by = data.force_matrix_w.numpy()
    assert by.shape == (WORLDS, 3, 3, 3) and data.complete.numpy()[0]
    np.testing.assert_array_equal(by[:, 0, 1], -by[:, 1, 0])  # equal and opposite: box by table, table by box
    np.testing.assert_array_equal(by[:, 0, 2], -by[:, 2, 0])  # and box and cloth
    np.testing.assert_allclose(by[:, 0].sum(axis=1), box, atol=1e-5)
    assert not by[:, 0, 0].any() and not by[:, 1, 2].any() and rested.sensor.labels == ["box", "table", "particles"]
    parts = data.net_normal_forces_w.numpy() + data.net_friction_forces_w.numpy()
    np.testing.assert_allclose(parts, data.net_forces_w.numpy(), atol=1e-6)
    np.testing.assert_allclose(
        data.net_forces_w.numpy()[:, 0], rested.solver.report.forces.body_impulse.numpy()[1::2, :3] / DT, atol=1e-3
    )


def test_worlds_that_take_no_part_or_are_reset_keep_or_lose_what_they_read(rested):
    data, mask = rested.sensor.data, wp.array([True, False, True, False], dtype=bool, device=rested.solver.device)
    names = [name for name in vars(data) if name != "complete" and getattr(data, name) is not None]
    before = {name: getattr(data, name).numpy().copy() for name in names}
    rested.step(mask)
    for name in names:
        np.testing.assert_array_equal(getattr(data, name).numpy()[1], before[name][1])
    history = data.net_forces_w_history.numpy()
    np.testing.assert_array_equal(history[[0, 2], 1:], before["net_forces_w_history"][[0, 2], :2])
    np.testing.assert_array_equal(history[[0, 2], 0], data.net_forces_w.numpy()[[0, 2]])
    rested.sensor.reset(mask)
    for name in names:
        after = getattr(data, name).numpy()
        assert not after[[0, 2]].any()
        np.testing.assert_array_equal(after[1], before[name][1])


def test_times_in_air_and_in_contact(device):
    """Of a cloth that falls 2 cm, in 0.065 s, on a box, and lies there until it is put above it again."""
    scene = Scene(device)
    lifted = scene.state.particle_q.numpy().copy()  # on a CPU it is the array itself
    lifted[:, 2] += 0.02
    times = []
    for _ in range(2):
        scene.state.particle_q.assign(lifted)
        scene.state.particle_qd.zero_()
        scene.solver.reset(scene.state, flags=0)
        for _ in range(12):
            scene.step()
            data = scene.sensor.data
            names = "current_air_time", "last_air_time", "current_contact_time", "last_contact_time"
            times.append([getattr(data, name).numpy()[:, 2].copy() for name in names])
    air, last_air, contact, last_contact = np.array(times).transpose(1, 0, 2)
    fall = np.sqrt(2.0 * 0.021 / GRAVITY)
    np.testing.assert_allclose(last_air[11], fall, atol=1.5 * DT)
    np.testing.assert_allclose(contact[11], 12 * DT - last_air[11] + DT, atol=1e-5)
    np.testing.assert_allclose(last_contact[12], contact[11] + DT, atol=1e-5)
    np.testing.assert_allclose(air[12], DT, atol=1e-6)
    assert not air[11].any() and not contact[12].any()


def test_too_many_contacts_are_flagged(device):
    solver = bsc.SolverImplicit(build(device), report={"contacts": 4})
    sensor, state = bsc.ContactSensor(solver, ["box"]), solver.model.state()
    assert sensor.data.force_matrix_w is None
    flags = []
    for _ in range(3):
        solver.step(state, state, None, None, DT)
        sensor.update(DT)
        flags.append((bool(sensor.data.complete.numpy()[0]), solver.report.forces.contacts.complete))
    assert flags[-1] == (False, False) and all(one == other for one, other in flags)


def test_a_stage_behind_a_solver_and_a_ground_in_all_worlds(device):
    """The ground is in all worlds, and has a sensor in each."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane(label="ground")
    world = newton.ModelBuilder()
    world.add_cloth_grid(
        pos=wp.vec3(0.0, 0.0, 0.001),
        rot=wp.quat_identity(),
        vel=wp.vec3(),
        dim_x=2,
        dim_y=2,
        cell_x=0.05,
        cell_y=0.05,
        mass=0.01,
        tri_ke=1e3,
        tri_ka=1e3,
    )
    builder.replicate(world, 2)
    builder.color()
    solver = bsc.SolverCCD(newton.solvers.SolverVBD(builder.finalize(device=device)), report=["contacts"])
    sensor, state = bsc.ContactSensor(solver, ["ground"], ["particles"]), solver.model.state()
    forces = []
    for _ in range(48):
        solver.step(state, state, None, None, DT)
        sensor.update(DT)
        forces.append(sensor.data.force_matrix_w.numpy()[:, 0, 0].copy())
        np.testing.assert_array_equal(forces[-1], sensor.data.net_forces_w.numpy()[:, 0])
    mean = np.mean(forces[-12:], axis=0)
    np.testing.assert_allclose(mean, [[0.0, 0.0, -GRAVITY * 0.09]] * 2, atol=0.01 * GRAVITY * 0.09)


@pytest.mark.gpu
def test_in_a_graph(device):
    scene, other = Scene(device), Scene(device)
    scene.step()
    with wp.ScopedCapture(device) as capture:
        scene.step()
    for _ in range(5):
        wp.capture_launch(capture.graph)
    for _ in range(6):
        other.step()
    for name in ("net_forces_w", "force_matrix_w", "net_forces_w_history", "current_contact_time"):
        np.testing.assert_array_equal(
            getattr(scene.sensor.data, name).numpy(), getattr(other.sensor.data, name).numpy()
        )


@pytest.mark.parametrize(
    ("sensors", "filters", "message"),
    [
        ([], [], "sensors: there are none"),
        (["lid"], [], "sensors: no body and no shape has a label like 'lid'"),
        (["box"], ["lid"], "filters: no body and no shape has a label like 'lid'"),
        (["box", "b*"], [], "sensors: 'b\\*' names what another pattern names"),
        (["box"], ["box", "sides"], "filters: 'sides' names what another pattern names"),
    ],
)
def test_patterns_that_name_nothing_or_too_much_are_refused(rested, sensors, filters, message):
    with pytest.raises(ValueError, match=message):
        bsc.ContactSensor(rested.solver, sensors, filters)


def test_other_arguments_that_are_wrong_are_refused(rested, device):
    with pytest.raises(TypeError, match="sensors must be a tuple of strings, not 'box'"):
        bsc.ContactSensor(rested.solver, "box")
    with pytest.raises(TypeError, match="solver must be a SolverCCD or a SolverImplicit"):
        bsc.ContactSensor(newton.solvers.SolverXPBD(rested.solver.model), ["box"])
    with pytest.raises(RuntimeError, match=r'report=\["contacts"\]'):
        bsc.ContactSensor(bsc.SolverImplicit(rested.solver.model), ["box"])
    with pytest.raises(ValueError, match="dt must be"):
        rested.sensor.update(0.0)
