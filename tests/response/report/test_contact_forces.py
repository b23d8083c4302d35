"""Contact forces: weight, friction, impulses, and sums that are the changes of momentum."""

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import DT, SOFT, SOLVERS, Changed, add_patch, add_plates, bullet, place_plates

import warp_bsc as bsc
from warp_bsc.response.report.forces import contact_forces
from warp_bsc.response.state.mesh import members_of_worlds
from warp_bsc.response.state.structs import ContactKind

GRAVITY = 9.81


def ramp(device, angle, *, velocity=0.0, mu=0.3):
    """A cloth on a static box whose top is tilted by an angle about the y axis; z is normal to it, x points down."""
    builder = newton.ModelBuilder(gravity=(GRAVITY * np.sin(angle), 0.0, -GRAVITY * np.cos(angle)))
    cfg = newton.ModelBuilder.ShapeConfig(mu=mu)
    builder.add_shape_box(
        -1, hx=0.5, hy=0.2, hz=0.1, xform=wp.transform(wp.vec3(0, 0, -0.1), wp.quat_identity()), cfg=cfg
    )
    cells = {"dim_x": 4, "dim_y": 4, "cell_x": 0.05, "cell_y": 0.05, "mass": 0.001}
    at, speed = wp.vec3(-0.1, -0.1, 0.0005), wp.vec3(velocity, 0.0, 0.0)
    builder.add_cloth_grid(pos=at, rot=wp.quat_identity(), vel=speed, **cells, **SOFT)
    builder.color()
    return builder.finalize(device=device)


def step_forces(model, solver, dt, steps):
    """Steps, and returns the forces on the first shape in each step [N]."""
    state, end, control, forces = model.state(), model.state(), model.control(), []
    for _ in range(steps):
        state.clear_forces()
        solver.step(state, end, control, None, dt)
        forces.append(solver.report.forces.shape_impulse.numpy()[0] / dt)
        state, end = end, state
    return np.array(forces)


@pytest.mark.parametrize(
    "inner, substeps, rate",
    [
        ("vbd", 1, 240),
        pytest.param("vbd", 2, 120, marks=pytest.mark.slow),
        pytest.param("xpbd", 1, 240, marks=pytest.mark.slow),
        ("xpbd", 2, 240),
        pytest.param("semi_implicit", 1, 960, marks=pytest.mark.slow),
        pytest.param("semi_implicit", 2, 480, marks=pytest.mark.slow),
    ],
)
def test_a_scale_under_a_cloth_shows_its_weight(inner, substeps, rate, device):
    """The mean force of the last tenth of a second is the weight within 1%, and has no other part."""
    model = ramp(device, 0.0)
    solver = bsc.SolverCCD(SOLVERS[inner](model), friction=0.3, substeps=substeps, report=["contacts"])
    forces = step_forces(model, solver, 1.0 / rate, int(0.35 * rate))
    weight = GRAVITY * float(model.particle_mass.numpy().sum())
    assert np.allclose(forces[-rate // 10 :].mean(axis=0), (0.0, 0.0, -weight), atol=0.01 * weight)
    report = solver.report
    assert report.forces.contacts.complete and report.forces.complete
    assert np.allclose(
        report.forces.particle_impulse.numpy().sum(axis=0) * rate, -forces[-1], rtol=1e-5, atol=1e-5 * weight
    )


def test_friction_on_a_ramp_is_mu_times_the_normal_force(device):
    """Of a cloth that slides down."""
    model = ramp(device, 0.5, velocity=0.5, mu=0.2)
    solver = bsc.SolverCCD(SOLVERS["vbd"](model), friction=0.2, report=["contacts"])
    force = -step_forces(model, solver, DT, 60)[-30:].mean(axis=0)
    weight = GRAVITY * float(model.particle_mass.numpy().sum())
    assert force[2] == pytest.approx(weight * np.cos(0.5), rel=0.02)
    assert force[0] == pytest.approx(-0.2 * force[2], rel=0.02)
    assert abs(force[1]) < 0.01 * force[2]


def test_pads_feel_the_weight_of_what_they_grip_and_its_velocity_is_its_motion(device):
    """Of a triangle that two static pads hold by friction: they only keep their distance, and nothing else pushes."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    cloth = {"vertices": [wp.vec3(-0.05, 0.0, -0.03), wp.vec3(0.05, 0.0, -0.03), wp.vec3(0.0, 0.0, 0.06)], "scale": 1.0}
    material = {"density": 1.0, "tri_ke": 1e3, "tri_ka": 1e3, "tri_kd": 0.0, "edge_ke": 0.0}
    at = {"pos": wp.vec3(), "rot": wp.quat_identity(), "vel": wp.vec3()}
    builder.add_cloth_mesh(indices=[0, 1, 2], **at, **cloth, **material)
    for side in (-1.0, 1.0):
        pad = wp.transform(wp.vec3(0.0, side * 0.00699, 0.0), wp.quat_identity())
        cfg = newton.ModelBuilder.ShapeConfig(mu=1.0)
        builder.add_shape_box(-1, xform=pad, hx=0.01, hy=0.005, hz=0.01, cfg=cfg)
    builder.color()
    model = builder.finalize(device=device)
    options = {"report": ["contacts"], "min_distance": 0.002, "friction": 1.0}
    solver = bsc.SolverCCD(newton.solvers.SolverVBD(model, iterations=10), **options)
    mass, dt, (state, end), rows = model.particle_mass.numpy(), 1.0 / 240.0, (model.state() for _ in range(2)), []
    for _ in range(80):
        solver.step(state, end, None, None, dt)
        state, end = end, state
        force = solver.report.forces.shape_impulse.numpy()[:, 2].sum() / dt
        means = [x.numpy()[:, 2].astype(float) @ mass / mass.sum() for x in (state.particle_q, state.particle_qd)]
        rows.append((force, *means))
    force, centre, velocity = np.array(rows[40:]).T
    assert -force.mean() == pytest.approx(GRAVITY * mass.sum(), rel=0.01)
    assert velocity.mean() == pytest.approx((centre[-1] - centre[0]) / (39 * dt), abs=1e-3)


def test_the_impulse_of_a_bounce_is_the_change_of_momentum(device):
    """Of a rigid ball on the ground, which leaves with half of its speed."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    builder.add_ground_plane()
    ball = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.101), wp.quat_identity()))
    builder.add_shape_sphere(ball, radius=0.1)
    builder.body_qd[ball] = wp.spatial_vector(0.0, 0.0, -2.0, 0.0, 0.0, 0.0)
    builder.add_particle(wp.vec3(9.0, 0.0, 9.0), wp.vec3(), 1.0)
    model = builder.finalize(device=device)
    inner = newton.solvers.SolverSemiImplicit(model, angular_damping=0.0)
    options = {"bodies": "separated", "restitution": 0.5, "friction": 0.0, "report": ["contacts"]}
    solver = bsc.SolverCCD(inner, **options)
    state, end, mass = model.state(), model.state(), float(model.body_mass.numpy()[0])
    solver.step(state, end, model.control(), None, DT)
    after = float(end.body_qd.numpy()[0, 2])
    assert after > 0.9
    impulse = solver.report.forces.body_impulse.numpy()[0]
    assert impulse[2] == pytest.approx(mass * (after + 2.0 + GRAVITY * DT), rel=1e-4)
    assert np.allclose(impulse[[0, 1, 3, 4, 5]], 0.0, atol=1e-4 * impulse[2])
    assert solver.report.forces.shape_impulse.numpy()[0, 2] == pytest.approx(-impulse[2], rel=1e-6)
    (kind,) = set(solver.report.forces.contacts.numpy()["kind"])
    assert kind == ContactKind.PLANE


def check_momentum(model, solver, steps, place=None):
    """Steps free flight, and checks each sum against the change of momentum, and against the contacts it consists of.

    Returns:
        The largest impulse on a particle, and the largest part of one that is of no pair [N s].
    """
    state, end, control = model.state(), model.state(), model.control()
    mass, free = model.particle_mass.numpy()[:, None].astype(float), model.particle_inv_mass.numpy() > 0.0
    largest, largest_unpaired = 0.0, 0.0
    for i in range(steps):
        if place is not None:
            place(state, i)
        before, body_before = state.particle_qd.numpy(), state.body_qd.numpy() if model.body_count else None
        speed = 1.0 + np.abs(before).max()
        solver.step(state, end, control, None, DT)
        report = solver.report
        impulse, unpaired = report.forces.particle_impulse.numpy(), report.forces.unpaired_particle_impulse.numpy()
        change = mass * (end.particle_qd.numpy().astype(float) - before)
        rounding = 3e-6 * mass.max() * speed
        assert np.allclose(impulse[free], change[free], rtol=0.0, atol=rounding)
        of_pairs, of_shapes = sum_up(model, report.forces.contacts.numpy())
        assert np.allclose(of_pairs + unpaired, impulse, rtol=0.0, atol=rounding)
        assert np.allclose(of_shapes, report.forces.shape_impulse.numpy(), rtol=0.0, atol=10.0 * rounding)
        total = of_pairs.astype(float).sum(axis=0) + report.forces.shape_impulse.numpy().astype(float).sum(axis=0)
        assert np.allclose(total, 0.0, atol=10.0 * rounding)
        if body_before is not None:
            check_bodies(model, report, end.body_qd.numpy().astype(float) - body_before, body_before)
        largest, largest_unpaired = max(largest, np.abs(impulse).max()), max(largest_unpaired, np.abs(unpaired).max())
        state, end = end, state
    return largest, largest_unpaired


def sum_up(model, found):
    """Returns the impulses of contacts by particle and by shape, where a contact acts on a face or edge as a whole.

    An impulse is shared among the vertices of an element by the place of its contact point.
    """
    of_particles, of_shapes = np.zeros((model.particle_count, 3)), np.zeros((model.shape_count, 3))
    impulses = found["normal_impulse"][:, None] * found["normal"] + found["tangential_impulse"]
    for i, impulse in enumerate(impulses):
        for side, sign in ((0, 1.0), (1, -1.0)):
            shape = found["shapes"][i, side]
            if shape >= 0:
                of_shapes[shape] += sign * impulse
        shares = found["weights"][i]
        for vertex, share in zip(found["vertices"][i], shares, strict=True):
            if 0 <= vertex < model.particle_count:
                of_particles[vertex] += share * impulse
    return of_particles, of_shapes


def check_bodies(model, report, change, speed):
    """Checks the impulses on free bodies with isotropic inertia against the changes of their velocities."""
    free = (model.body_inv_mass.numpy() > 0.0) & (model.body_flags.numpy() & newton.BodyFlags.KINEMATIC == 0)
    impulse = report.forces.body_impulse.numpy()[free]
    linear = model.body_mass.numpy()[:, None] * change[:, :3]
    # velocities are rounded, of which the change is a difference
    rounding = 1e-6 * model.body_mass.numpy().max() * (1.0 + np.abs(speed).max())
    angular = np.einsum("bij,bj->bi", model.body_inertia.numpy(), change[:, 3:])
    assert np.allclose(impulse[:, :3], linear[free], rtol=0.0, atol=rounding)
    assert np.allclose(impulse[:, 3:], angular[free], rtol=0.0, atol=rounding)


@pytest.mark.parametrize("speed, substeps", [(60, 1), (200, 4)])
def test_sums_are_the_changes_of_momentum_of_cloth(speed, substeps, device):
    """Of a patch shot at a sheet, where nothing is cut: only the turn of a world is of no pair."""
    model = bullet(speed, device=device)
    solver = bsc.SolverCCD(Changed(model), substeps=substeps, report=["contacts"])
    with pytest.warns(UserWarning, match="a step strained") if speed == 60 else pytest.warns():
        largest, unpaired = check_momentum(model, solver, 8)
    assert largest > 1e-4 * speed and unpaired < 1e-3 * largest
    assert solver.report.totals.truncated_steps == 0


@pytest.mark.parametrize("substeps", [1, 4])
def test_sums_are_the_changes_of_momentum_of_cloth_and_bodies(substeps, device):
    """Of a box that flies into a free sheet, and slides along it."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    box = builder.add_body(xform=wp.transform(wp.vec3(0.03, 0.01, 0.16), wp.quat_identity()))
    builder.add_shape_box(box, hx=0.05, hy=0.05, hz=0.05, cfg=newton.ModelBuilder.ShapeConfig(mu=0.3, density=20.0))
    builder.body_qd[box] = wp.spatial_vector(0.5, 0.0, -5.0, 0.0, 0.0, 0.0)
    add_patch(builder, 8, 0.05, (0.0, 0.0, 0.1), velocity=(0.0, 0.0, 1.0))
    model = builder.finalize(device=device)
    inner = newton.solvers.SolverXPBD(model, iterations=0)
    solver = bsc.SolverCCD(inner, substeps=substeps, friction=0.3, report=["contacts"])
    largest, _ = check_momentum(model, solver, 4)
    assert largest > 1e-3


def test_velocities_that_paths_gave_are_of_no_pair(device):
    """Of cloth between plates that leave no space: what is cut or frozen loses momentum that no contact took."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_plates(builder, 0.05)
    for i in range(builder.particle_count):
        builder.particle_qd[i] = wp.vec3(0.0, 0.0, 3.0 * (-1.0) ** i)
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(Changed(model), max_iterations=0, report=["contacts"])
    largest, unpaired = check_momentum(model, solver, 6, lambda state, i: place_plates(state, 0.05 - 0.01 * i))
    totals = solver.report.totals
    assert totals.truncated_steps > 0 and totals.frozen_steps > 0
    assert unpaired > 0.1 * largest


def test_matrices_of_pairs_add_up(device):
    """Of two worlds with a common shape: rows are opposite to columns, and add up to the sums of shapes."""
    world = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    body = world.add_body(is_kinematic=True)
    world.add_shape_box(body, hx=0.05, hy=0.05, hz=0.05, xform=wp.transform(wp.vec3(0, 0, 0.05), wp.quat_identity()))
    add_patch(world, 4, 0.05, (0.0, 0.0, 0.1005), velocity=(0.0, 0.0, -1.0))
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    builder.add_ground_plane()
    builder.replicate(world, 2)
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(SOLVERS["xpbd"](model), substeps=2, report=["contacts"])
    state, end, report = model.state(), model.state(), solver.report
    for _ in range(20):
        solver.step(state, end, model.control(), None, DT)
        state, end = end, state
    matrix, shapes = report.forces.shape_pair_impulse.numpy(), report.forces.shapes_of_worlds
    assert shapes.tolist() == [[0, 1], [0, 2]] and matrix.shape == (2, 3, 3, 3)
    assert (
        np.array_equal(matrix, -matrix.transpose(0, 2, 1, 3))
        and (matrix[:, 1, 2, 2] <= 0.0).all()
        and matrix[:, 1, 2, 2].min() < 0.0
    )
    found, scale = report.forces.contacts.numpy(), np.abs(matrix).max()
    for world in range(2):
        ours = found["world"] == world
        _, of_shapes = sum_up(model, {name: values[ours] for name, values in found.items()})
        assert np.allclose(of_shapes[shapes[world]], matrix[world, :2].sum(axis=1), atol=1e-5 * scale)
        assert np.allclose(
            matrix[world, 1].sum(axis=0), report.forces.shape_impulse.numpy()[world + 1], atol=1e-5 * scale
        )
        assert np.allclose(
            report.forces.body_impulse.numpy()[world, :3], matrix[world, 1].sum(axis=0), atol=1e-5 * scale
        )
    assert np.allclose(matrix[:, 0].sum(axis=(0, 1)), report.forces.shape_impulse.numpy()[0], atol=1e-5 * scale)
    assert set(found["kind"]) >= {ContactKind.VERTEX_FACE, ContactKind.PLANE}


def test_matrices_that_are_too_large_are_an_error(device, monkeypatch):
    monkeypatch.setattr(contact_forces, "MAX_PAIRS", 0)
    model = bullet(60, device=device)
    solver = bsc.SolverCCD(Changed(model), report=["contacts"])
    solver.step(model.state(), model.state(), model.control(), None, DT)
    with pytest.raises(RuntimeError, match="1 entries: sum up contacts"):
        solver.report.forces.shape_pair_impulse  # noqa: B018


def test_what_pushes_before_the_stage_is_named(device):
    model = bullet(1, device=device)
    self_contact = newton.solvers.SolverVBD(model, particle_enable_self_contact=True)
    assert bsc.SolverCCD(SOLVERS["vbd"](model)).report.impulses_elsewhere is None
    assert "self-contact" in bsc.SolverCCD(self_contact).report.impulses_elsewhere


def test_contacts_that_the_inner_solver_gets_are_named(device):
    model = ramp(device, 0.0)
    contacts = newton.CollisionPipeline(model).contacts()
    assert contacts.soft_contact_max > 0
    solver = bsc.SolverCCD(SOLVERS["vbd"](model))
    solver.step(model.state(), model.state(), model.control(), contacts, DT)
    assert solver.report.impulses_elsewhere is not None
    solver.step(model.state(), model.state(), model.control(), None, DT)
    assert solver.report.impulses_elsewhere is None


def test_members_of_worlds():
    found = members_of_worlds(np.array([-1, 1, 0, 1, -1]), 3)
    assert found.tolist() == [[0, 4, 2, -1], [0, 4, 1, 3], [0, 4, -1, -1]]


@pytest.mark.filterwarnings("ignore:a step strained")
def test_contacts_beyond_the_capacity_are_counted_and_summed_up(device):
    model = bullet(60, device=device)
    few, all_listed = (
        bsc.SolverCCD(Changed(model), report=report) for report in ({"contacts": 5, "worlds": True}, ["contacts"])
    )
    state, control = model.state(), model.control()
    state.particle_q.assign(
        state.particle_q.numpy() - np.float32((0.0, 0.0, 0.09)) * (np.arange(model.particle_count) > 288)[:, None]
    )
    for solver in (few, all_listed):
        solver.step(state, model.state(), control, None, DT)
    assert not few.report.forces.contacts.complete and all_listed.report.forces.contacts.complete
    assert few.report.forces.contacts.count.numpy()[0] == all_listed.report.forces.contacts.count.numpy()[0] > 5
    assert len(few.report.forces.contacts.numpy()["toi"]) == few.report.forces.contacts.capacity == 5
    assert few.report.forces.complete and len(few.report.worlds.certified) == 1
    assert np.array_equal(few.report.forces.particle_impulse.numpy(), all_listed.report.forces.particle_impulse.numpy())


@pytest.mark.parametrize("mass, complete", [(1e-3, True), (1e8, False)])
def test_impulses_that_are_too_large_for_a_sum_are_flagged(mass, complete, device):
    model = ramp(device, 0.0)
    model.particle_mass.fill_(mass)
    model.particle_inv_mass.fill_(1.0 / mass)
    solver = bsc.SolverCCD(SOLVERS["semi_implicit"](model), report=["contacts"])
    step_forces(model, solver, 1.0 / 100.0, 3)
    assert len(solver.report.forces.contacts.numpy()["toi"])
    assert solver.report.forces.complete == solver.report.forces.contacts.complete == complete


def test_a_stage_that_is_not_asked_has_no_contacts(device):
    """And takes the same steps, bit by bit."""
    model = bullet(60, device=device)
    ends = []
    for asked in ([], ["contacts"]):
        solver = bsc.SolverCCD(SOLVERS["vbd"](model), substeps=2, report=asked)
        state, end = model.state(), model.state()
        for _ in range(6):
            solver.step(state, end, model.control(), None, DT)
            state, end = end, state
        ends.append(np.concatenate([state.particle_q.numpy(), state.particle_qd.numpy()]))
        if not asked:
            with pytest.raises(RuntimeError, match=r'report=\["contacts"\]'):
                _ = solver.report.forces
    assert np.array_equal(*ends)


@pytest.mark.parametrize(
    "value, error", [(0, ValueError), (-1, ValueError), ("yes", TypeError), (2.5, TypeError), (None, TypeError)]
)
def test_bad_capacities_are_errors(value, error, device):
    with pytest.raises(error, match=r"report\['contacts'\]"):
        bsc.SolverCCD(Changed(bullet(1, device=device)), report={"contacts": value})
