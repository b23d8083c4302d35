"""Coupled steps: the inner solver takes substeps against the contacts, and nothing else of a step changes."""

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import DT, SOFT, SOLVERS, STIFF, Rollout, add_patch, bullet

import warp_bsc as bsc
from warp_bsc.response.substeps.strain import edges_at_rest


def drape(device):
    """A cloth of 0.6 m above a fixed sphere."""
    builder = newton.ModelBuilder()
    builder.add_shape_sphere(body=-1, radius=0.15, cfg=newton.ModelBuilder.ShapeConfig(mu=0.5))
    cells = {"dim_x": 12, "dim_y": 12, "cell_x": 0.05, "cell_y": 0.05, "mass": 0.001}
    builder.add_cloth_grid(pos=wp.vec3(-0.3, -0.3, 0.16), rot=wp.quat_identity(), vel=wp.vec3(), **cells, **SOFT)
    builder.color()
    return builder.finalize(device=device)


def largest_stretch(model, dt, duration=0.4, **options):
    """The largest stretch of an edge of a cloth on a sphere, averaged over the last tenth of a second."""
    solver = bsc.SolverCCD(newton.solvers.SolverVBD(model, iterations=10), friction=0.5, **options)
    rollout = Rollout(model, solver)
    edges = rollout.mesh.edges[rollout.mesh.edges[:, 1] < model.particle_count]

    def lengths():
        return np.linalg.norm(rollout.positions[edges[:, 0]] - rollout.positions[edges[:, 1]], axis=1)

    rest, largest = lengths(), []
    for _ in range(round(duration / dt)):
        rollout.states[0].clear_forces()
        solver.step(*rollout.states, rollout.control, None, dt)
        rollout.states = rollout.states[::-1]
        largest.append((lengths() / rest).max() - 1.0)
    assert solver.report.totals.uncertified_steps == 0
    return np.mean(largest[-round(0.1 / dt) :]), solver.report


def test_a_step_in_substeps_stretches_as_little_as_small_steps(device):
    """At 1/60 s, cloth in substeps stretches like at 1/480 s; without substeps, it stretches several times as much.

    That is so with a number of substeps, and where the stage chooses.
    """
    model = drape(device)
    reference, _ = largest_stretch(model, 1.0 / 480.0)
    plain, report = largest_stretch(model, 1.0 / 60.0)
    assert report.totals.substepped_steps == 0
    assert plain > 3.0 * reference
    for substeps in (8, "auto"):
        coupled, report = largest_stretch(model, 1.0 / 60.0, substeps=substeps)
        assert report.totals.substepped_steps > 0.5 * report.totals.steps
        assert coupled < reference + 0.02


def test_auto_follows_the_strain(device, monkeypatch):
    """A drape takes no substeps where steps are small; where they are large, it takes no whole steps beside substeps.

    A resting patch takes none.
    """
    model, step = drape(device), newton.solvers.SolverVBD.step
    for rate, least, most in ((480, 0, 2), (60, 4, 16)):
        lengths, numbers = [], []

        def logged(*arguments):
            lengths.append(arguments[-1])  # noqa: B023
            step(*arguments)

        monkeypatch.setattr(newton.solvers.SolverVBD, "step", logged)
        inner = newton.solvers.SolverVBD(model, iterations=5)
        state, end, control = model.state(), model.state(), model.control()
        solver = bsc.SolverCCD(inner, friction=0.5, substeps="auto")
        for _ in range(rate // 3):
            del lengths[:]
            solver.step(state, end, control, None, 1.0 / rate)
            numbers.append(solver.report.substeps)
            state, end = end, state
        assert solver.report.totals.substepped_steps == np.count_nonzero(numbers)
        assert solver.report.totals.uncertified_steps == 0
        assert least <= np.median(numbers) <= most
        if rate == 60:
            assert np.allclose(lengths, 1.0 / rate / numbers[-1])

    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    add_patch(builder, 4, 0.05, (0.0, 0.0, 0.001))
    builder.color()
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), substeps="auto"))
    for _ in range(10):
        rollout.step()
    assert rollout.solver.report.totals.substepped_steps == 0
    assert 0.0 < rollout.positions[:, 2].max() < 0.001  # it lies


def hanging(device, *, n, ball):
    """A cloth held by two corners, which hangs before a kinematic ball, or swings against a static one."""
    builder, cell = newton.ModelBuilder(), 0.48 / n
    body = builder.add_body(xform=wp.transform(wp.vec3(0.0, -0.2, -0.25)), is_kinematic=True) if ball else -1
    at = wp.transform() if ball else wp.transform(wp.vec3(0.0, 0.0, -0.3))
    builder.add_shape_sphere(body, radius=0.08, xform=at)
    cells = {"dim_x": n, "dim_y": n, "cell_x": cell, "cell_y": cell, "mass": 5e-4}
    material = {"tri_ke": 2e2, "tri_ka": 2e2, "tri_kd": 1e-3, "edge_ke": 1e-3, "edge_kd": 1e-4}
    builder.add_cloth_grid(pos=wp.vec3(-0.24, 0.0, 0.0), rot=wp.quat_identity(), vel=wp.vec3(), **cells, **material)
    for i, (x, y, _) in enumerate(builder.particle_q):
        below = y - 0.48
        builder.particle_q[i] = wp.vec3(x, 0.0, below) if ball else wp.vec3(x, 0.5 * below - 0.092, 0.866 * below)
    for corner in (n * (n + 1), (n + 1) ** 2 - 1):
        builder.particle_mass[corner], builder.particle_flags[corner] = 0.0, 0
    builder.color()
    return builder.finalize(device=device)


@pytest.mark.parametrize("ball, n, steps", [(True, 8, 40), (False, 6, 60)])
def test_a_contact_does_not_end_with_softer_cloth(ball, n, steps, device):
    """Whole steps of VBD stretch a hanging cloth by themselves, by 41% after this ball; substeps do not end with it.

    Until something touches it, the cloth is that of VBD alone, bit by bit.
    """
    model = hanging(device, n=n, ball=ball)
    options = {"iterations": 10, "integrate_with_external_rigid_solver": True}
    plain = newton.solvers.SolverVBD(model, **options)
    solver = bsc.SolverCCD(newton.solvers.SolverVBD(model, **options))
    edges, lengths, _ = edges_at_rest(model)
    states, alone = ([model.state() for _ in range(2)] for _ in range(2))
    numbers, stretch, touched = [], [], False
    for i in range(steps):
        if ball:
            y = -0.2 + 0.2 * np.sin(np.pi * min((i + 1) / 20, 1.0))
            for state in (*states, *alone):
                state.body_q.assign(np.float32([[0.0, y, -0.25, 0.0, 0.0, 0.0, 1.0]]))
        solver.step(*states, None, None, 1.0 / 60.0)
        states.reverse()
        numbers.append(solver.report.substeps)
        x = states[0].particle_q.numpy()
        stretch.append((np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1) / lengths).max() - 1.0)
        touched = touched or solver.report.hits > 0
        if not touched:
            plain.step(*alone, None, None, 1.0 / 60.0)
            alone.reverse()
            assert x.tobytes() == alone[0].particle_q.numpy().tobytes()
    first = np.flatnonzero(numbers)[0]
    assert first >= 4 and numbers[first] >= 16  # it begins with many
    assert max(stretch[:first]) > 0.1  # as VBD alone stretches it
    assert max(stretch[first + 4 :]) < 0.05


def test_soft_bodies_are_coupled_where_they_are_compressed(device):
    """A plate presses a block at once by a tenth of a cell: a third of its strain of a tenth counts."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_body(is_kinematic=True)
    builder.add_shape_box(body, hx=0.2, hy=0.2, hz=0.05)
    material = {"density": 100.0, "k_mu": 1e4, "k_lambda": 1e4, "k_damp": 0.0, "particle_radius": 0.002}
    cells = {"dim_x": 2, "dim_y": 2, "dim_z": 2, "cell_x": 0.05, "cell_y": 0.05, "cell_z": 0.05}
    at = wp.vec3(-0.05, -0.05, 0.051)
    builder.add_soft_grid(pos=at, rot=wp.quat_identity(), vel=wp.vec3(), **cells, **material)
    builder.color()
    model = builder.finalize(device=device)
    inner = newton.solvers.SolverVBD(model, iterations=5, integrate_with_external_rigid_solver=True)
    solver = bsc.SolverCCD(inner, substeps="auto")
    start, end = model.state(), model.state()
    end.body_q.assign(np.float32([[0.0, 0.0, 0.006, 0.0, 0.0, 0.0, 1.0]]))
    solver.step(start, end, model.control(), None, DT)
    assert solver.report.certified and solver.report.substeps >= 4


@pytest.mark.parametrize("inner", SOLVERS)
def test_without_contacts_coupling_changes_no_bit(inner, device):
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    add_patch(builder, 4, 0.05, (0.0, 0.0, 1.0), velocity=(1.0, 0.0, 2.0))
    builder.color()
    model = builder.finalize(device=device)
    plain = Rollout(model, SOLVERS[inner](model))
    coupled = Rollout(model, bsc.SolverCCD(SOLVERS[inner](model), substeps=4))
    for _ in range(5):
        plain.step(1e-4)  # short enough for the explicit solver
        coupled.step(1e-4)
    assert coupled.positions.tobytes() == plain.positions.tobytes()
    assert coupled.velocities.tobytes() == plain.velocities.tobytes()
    assert coupled.solver.report.totals.substepped_steps == 0


def test_a_world_without_contacts_keeps_its_bits(device):
    """One of two worlds collides, and the other is that of the inner solver alone."""
    builder = newton.ModelBuilder()
    for height in (0.01, 1.0):
        world = newton.ModelBuilder()
        world.add_ground_plane()
        add_patch(world, 4, 0.05, (0.0, 0.0, height), velocity=(0.0, 0.0, -5.0))
        builder.add_world(world)
    builder.color()
    model = builder.finalize(device=device)
    plain = Rollout(model, SOLVERS["vbd"](model))
    coupled = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), substeps=3))
    for _ in range(4):
        plain.step()
        coupled.step()
    half = model.particle_count // 2
    assert coupled.solver.report.totals.substepped_steps > 1
    assert coupled.positions[:half, 2].min() > 0.0 > plain.positions[:half, 2].min()
    assert coupled.positions[half:].tobytes() == plain.positions[half:].tobytes()
    assert coupled.velocities[half:].tobytes() == plain.velocities[half:].tobytes()


def test_worlds_are_like_one_alone(device):
    models = bullet(30.0, device=device), bullet(30.0, device=device, worlds=2)
    one, both = (Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), restitution=0.3, substeps=3)) for model in models)
    for _ in range(6):
        one.step()
        both.step()
    assert both.collisions == 0 and both.solver.report.totals.substepped_steps > 1
    for world in both.positions.reshape(2, -1, 3):
        assert world.tobytes() == one.positions.tobytes()


@pytest.mark.parametrize("substeps", [None, 4, "auto"])
def test_momentum_of_free_bodies_is_conserved(substeps, device):
    """Two patches collide; momentum is kept to 1e-6 of what collides, as XPBD keeps it and VBD by itself does not.

    In many substeps, XPBD by itself keeps it to the rounding of positions.
    """
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 6, 0.05, (0.0, 0.0, 0.0), velocity=(0.0, 0.0, 3.0))
    add_patch(builder, 5, 0.04, (0.013, 0.017, 0.012), velocity=(0.5, 0.0, -3.0))
    builder.color()
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(SOLVERS["xpbd"](model), friction=0.3, substeps=substeps))
    before, _ = rollout.momenta()
    colliding = model.particle_mass.numpy() @ np.linalg.norm(rollout.velocities, axis=1)
    most = 0
    for _ in range(8):
        rollout.step()
        most = max(most, rollout.solver.report.substeps)
    after, _ = rollout.momenta()
    assert rollout.collisions == 0 and rollout.solver.report.totals.uncertified_steps == 0
    assert (rollout.solver.report.totals.substepped_steps > 0) is (substeps is not None)
    allowed = 1e-6 * colliding
    if substeps == "auto":  # velocities of XPBD are differences of float32 positions, rounded in each substep
        rounding = np.spacing(np.abs(rollout.positions).max()) / 2.0 / (DT / most)
        allowed += 3.0 * rounding * np.sqrt(8 * most / model.particle_count) * model.particle_mass.numpy().sum()
    assert np.abs(after - before).max() < allowed
    assert abs(rollout.velocities[: 7 * 7, 2].mean() - 3.0) > 1.0  # they did collide


@pytest.mark.parametrize("substeps", [None, 4])
@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_a_bounce_returns_the_energy_of_restitution(restitution, substeps, device):
    """A patch hits a box squarely: its energy afterwards is that before times restitution squared."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    box = newton.ModelBuilder.ShapeConfig(mu=0.0)
    builder.add_shape_box(-1, xform=wp.transform((0.0, 0.0, -0.1), wp.quat_identity()), hx=1.0, hy=1.0, hz=0.1, cfg=box)
    add_patch(builder, 5, 0.05, (0.0, 0.0, 0.02), velocity=(0.0, 0.0, -2.0))
    builder.color()
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(SOLVERS["vbd"](model), friction=0.0, restitution=restitution, substeps=substeps)
    rollout = Rollout(model, solver)
    mass = model.particle_mass.numpy()[:, None]
    before = (mass * rollout.velocities**2).sum()
    for _ in range(8):
        rollout.step()
    assert (solver.report.totals.substepped_steps > 0) is (substeps is not None) and rollout.collisions == 0
    assert abs((mass * rollout.velocities**2).sum() / before - restitution**2) < 0.02


@pytest.mark.parametrize("substeps, dt", [(None, DT), (3, DT), ("auto", DT), (None, DT / 3)])
def test_a_pile_comes_to_rest(substeps, dt, device):
    """Layers that fall on the ground gain no energy, and lie still; in small steps they are very near the ground."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    for layer in range(3):
        add_patch(builder, 4, 0.05, (0.011 * layer, 0.007 * layer, 0.02 * (layer + 1)))
    builder.color()
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), friction=0.5, substeps=substeps))
    mass = model.particle_mass.numpy().astype(float)

    def energy():
        return mass @ (0.5 * (rollout.velocities.astype(float) ** 2).sum(axis=1) + 9.81 * rollout.positions[:, 2])

    start, energies = energy(), []
    for _ in range(90 if dt == DT else 150):
        rollout.step(dt)
        energies.append(energy())
    assert rollout.collisions == 0 and rollout.solver.report.totals.uncertified_steps == 0
    assert max(energies) < 1.001 * start
    assert np.sqrt((rollout.velocities**2).sum(axis=1).mean()) < 0.1


def test_style3d_is_coupled_too(device):
    """Cloth on a fixed box stretches less at 1/60 s with substeps, and nothing passes through."""
    builder = newton.ModelBuilder()
    newton.solvers.SolverStyle3D.register_custom_attributes(builder)
    builder.add_shape_box(-1, xform=wp.transform((0.0, 0.0, -0.05), wp.quat_identity()), hx=0.08, hy=0.3, hz=0.05)
    newton.solvers.style3d.add_cloth_grid(
        builder,
        pos=wp.vec3(-0.24, -0.24, 0.005),
        rot=wp.quat_identity(),
        vel=wp.vec3(),
        dim_x=12,
        dim_y=12,
        cell_x=0.04,
        cell_y=0.04,
        mass=5e-4,
        particle_radius=0.002,
        tri_aniso_ke=wp.vec3(1e2, 1e2, 1e1),
        edge_aniso_ke=wp.vec3(2e-5, 1e-5, 5e-6),
    )
    model = builder.finalize(device=device)
    contacts = newton.CollisionPipeline(model).contacts()
    stretch = []
    for substeps in (None, 8):
        inner = newton.solvers.SolverStyle3D(model, config=newton.solvers.SolverStyle3D.Config(iterations=4))
        rollout = Rollout(model, bsc.SolverCCD(inner, friction=0.5, substeps=substeps))
        edges = rollout.mesh.edges[rollout.mesh.edges[:, 1] < model.particle_count]
        rest = np.linalg.norm(np.diff(rollout.positions[edges], axis=1)[:, 0], axis=1)
        for _ in range(20):
            rollout.step(1.0 / 60.0, contacts)
        length = np.linalg.norm(np.diff(rollout.positions[edges], axis=1)[:, 0], axis=1)
        stretch.append((length / rest).max() - 1.0)
        assert rollout.collisions == 0 and rollout.solver.report.totals.uncertified_steps == 0
    assert rollout.solver.report.totals.substepped_steps > 10
    assert stretch[1] < 0.5 * stretch[0]


def test_xpbd_is_coupled_too(device):
    """Cloth of springs falls on a sphere at 1/60 s, where XPBD with its contacts between steps throws it apart."""
    builder = newton.ModelBuilder()
    builder.add_shape_sphere(body=-1, radius=0.15)
    cells = {"dim_x": 12, "dim_y": 12, "cell_x": 0.05, "cell_y": 0.05, "mass": 0.001, "particle_radius": 0.005}
    springs = {"edge_ke": 0.0, "edge_kd": 0.0, "add_springs": True, "spring_ke": 5.0, "spring_kd": 0.0}
    at = wp.vec3(-0.3, -0.3, 0.16)
    builder.add_cloth_grid(pos=at, rot=wp.quat_identity(), vel=wp.vec3(), **cells, **springs)
    model = builder.finalize(device=device)
    inner = newton.solvers.SolverXPBD(model, iterations=10)
    rollout = Rollout(model, bsc.SolverCCD(inner, friction=0.5, substeps=8))
    edges, lengths, _ = edges_at_rest(model)
    for _ in range(12):
        rollout.step(1.0 / 60.0)
    stretch = (np.linalg.norm(np.diff(rollout.positions[edges], axis=1)[:, 0], axis=1) / lengths).max() - 1.0
    assert rollout.collisions == 0 and rollout.solver.report.totals.uncertified_steps == 0
    assert rollout.solver.report.totals.substepped_steps > 6
    assert stretch < 0.5


class Clocked(newton.solvers.SolverVBD):
    """VBD with a clock on the device."""

    def __init__(self, model):
        super().__init__(model, iterations=3)
        self.time = wp.zeros(1, dtype=float, device=model.device)
        self.calls = 0

    def step(self, state_in, state_out, control, contacts, dt, **options):
        super().step(state_in, state_out, control, contacts, dt, **options)
        self.time += dt
        self.calls += 1


def test_a_clock_of_the_inner_solver_advances_once_a_step(device):
    model = bullet(30.0, device=device)
    rollout = Rollout(model, bsc.SolverCCD(Clocked(model), substeps=4))
    for _ in range(6):
        rollout.step()
    assert rollout.solver.report.totals.substepped_steps > 1
    assert rollout.solver.solver.calls == 6
    assert np.isclose(rollout.solver.solver.time.numpy()[0], 6 * DT)


def test_the_state_at_the_start_may_be_that_at_the_end(device):
    model = bullet(30.0, device=device)
    apart = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), substeps=3))
    state, solver = model.state(), bsc.SolverCCD(SOLVERS["vbd"](model), substeps=3)
    for _ in range(6):
        apart.step()
        state.clear_forces()
        solver.step(state, state, apart.control, None, DT)
    assert apart.solver.report.totals.substepped_steps > 1
    assert state.particle_q.numpy().tobytes() == apart.positions.tobytes()


def test_forces_act_as_often_as_without_substeps(device):
    """A patch on frictionless ground is pushed: coupled, it accelerates as force over mass."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=0.0))
    add_patch(builder, 4, 0.05, (0.0, 0.0, 0.001))
    builder.color()
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(SOLVERS["vbd"](model), friction=0.0, substeps=4)
    start, end = model.state(), model.state()
    for _ in range(24):
        start.particle_f.assign(model.particle_mass.numpy()[:, None] * np.float32([2.0, 0.0, 0.0]))
        solver.step(start, end, model.control(), None, DT)
        start, end = end, start
    assert solver.report.totals.substepped_steps > 10
    velocity = start.particle_qd.numpy().mean(axis=0)
    assert np.allclose(velocity[0], 2.0 * 24 * DT, rtol=1e-3)
    assert abs(velocity[2]) < 9.81 * DT  # it falls within the separation


def test_a_moving_plate_pushes_in_each_substep(device):
    """A kinematic plate that rises carries cloth along without throwing it ahead."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_body(is_kinematic=True)
    builder.add_shape_box(body, hx=0.2, hy=0.2, hz=0.05)
    add_patch(builder, 4, 0.05, (0.0, 0.0, 0.051))
    builder.color()
    model = builder.finalize(device=device)
    inner = newton.solvers.SolverVBD(model, iterations=5, integrate_with_external_rigid_solver=True)
    solver = bsc.SolverCCD(inner, restitution=0.0, substeps=4)
    start, end = model.state(), model.state()
    heights = 0.5 * 20.0 * (DT * np.arange(1, 13)) ** 2  # at 20 m/s^2
    for height in heights:
        start.clear_forces()
        end.body_q.assign(np.float32([[0.0, 0.0, height, 0.0, 0.0, 0.0, 1.0]]))
        solver.step(start, end, model.control(), None, DT)
        assert solver.report.certified
        is_pushed = solver._work.status.is_fast.numpy()[0] == 1  # so that no vertex is left in the way
        assert is_pushed or solver.report.hits == 0
        start, end = end, start
    assert solver.report.totals.substepped_steps > 8
    above = start.particle_q.numpy()[:, 2] - (0.05 + heights[-1])
    assert above.min() > 0.0 and above.max() < 0.001
    assert np.allclose(start.particle_qd.numpy()[:, 2], 20.0 * 12 * DT, rtol=0.1)


@pytest.mark.parametrize("substeps", [3, "auto"])
def test_substeps_in_a_graph_are_those_without(substeps, device):
    if device.is_cuda and not wp.is_conditional_graph_supported():
        pytest.skip("needs conditional nodes")
    model = bullet(30.0, device=device)
    plain, captured = (Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), substeps=substeps)) for _ in range(2))
    start, end = captured.states

    def frame():
        for states in ((start, end), (end, start)):
            states[0].clear_forces()
            captured.solver.step(*states, captured.control, None, DT)

    with wp.ScopedCapture(device) as capture:
        frame()
    for _ in range(3):
        wp.capture_launch(capture.graph)
    for _ in range(6):
        plain.step()
    assert plain.solver.report.totals.substepped_steps > 1
    assert captured.solver.report.totals.substepped_steps == plain.solver.report.totals.substepped_steps
    assert captured.positions.tobytes() == plain.positions.tobytes()


def test_a_solver_that_allocates_is_captured_too(device):
    """On a GPU, the body of a condition cannot allocate memory, as XPBD does: its substeps are taken in each step."""
    if device.is_cuda and not wp.is_conditional_graph_supported():
        pytest.skip("needs conditional nodes")
    model = bullet(30.0, device=device)
    rollout = Rollout(model, bsc.SolverCCD(SOLVERS["xpbd"](model), substeps=3))
    start, end = rollout.states
    rollout.step()
    with wp.ScopedCapture(device) as capture:
        for states in ((end, start), (start, end)):
            states[0].clear_forces()
            rollout.solver.step(*states, rollout.control, None, DT)
    for _ in range(3):
        wp.capture_launch(capture.graph)
    assert rollout.solver.report.totals.steps == 7 and rollout.solver.report.totals.substepped_steps > 1
    assert rollout.solver.report.totals.uncertified_steps == 0
    if device.is_cuda:  # a graph of the CPU knows what to leave out
        chooses = bsc.SolverCCD(SOLVERS["xpbd"](model))
        chooses.step(start, end, rollout.control, None, DT)
        assert chooses.report.substeps_omitted is None
        with wp.ScopedCapture(device) as capture:
            chooses.step(start, end, rollout.control, None, DT)
        wp.capture_launch(capture.graph)
        assert "may allocate memory" in chooses.report.substeps_omitted and chooses.report.substeps == 0


def test_what_cannot_take_substeps_is_refused(device):
    model = bullet(10.0, device=device)
    with pytest.raises(ValueError, match="not 1: pass None for none, 2 to 1024, or 'auto'"):
        bsc.SolverCCD(SOLVERS["vbd"](model), substeps=1)
    with pytest.raises(ValueError, match="'auto', not 'always'"):
        bsc.SolverCCD(SOLVERS["vbd"](model), substeps="always")


def test_friction_holds_and_slides_as_without_substeps(device):
    """Cloth on a ramp slides as a rigid body would, without friction and with it."""
    angle, time = np.radians(20.0), 0.25
    tilt = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), float(angle))
    up, down = np.array([np.sin(angle), 0.0, np.cos(angle)]), np.array([np.cos(angle), 0.0, -np.sin(angle)])
    for friction in (0.0, 0.2, 0.6):
        builder = newton.ModelBuilder()
        material = newton.ModelBuilder.ShapeConfig(mu=friction)
        pose = wp.transform(wp.vec3(), tilt)
        builder.add_shape_box(-1, xform=pose, hx=2.0, hy=1.0, hz=0.1, cfg=material)
        cells = {"dim_x": 4, "dim_y": 4, "cell_x": 0.04, "cell_y": 0.04, "mass": 0.001}
        builder.add_cloth_grid(pos=wp.vec3(*(0.1003 * up - down)), rot=tilt, vel=wp.vec3(), **cells, **STIFF)
        builder.color()
        model = builder.finalize(device=device)
        rollout = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), friction=friction, substeps=4))
        start = rollout.positions.mean(axis=0)
        for _ in range(round(time / DT)):
            rollout.states[0].clear_forces()
            rollout.solver.step(*rollout.states, rollout.control, None, DT)
            rollout.states = rollout.states[::-1]
        slid = (rollout.positions.mean(axis=0) - start) @ down
        expected = 0.5 * 9.81 * max(0.0, np.sin(angle) - friction * np.cos(angle)) * time**2
        assert abs(slid - expected) < 0.03 * expected + 1.5e-3
