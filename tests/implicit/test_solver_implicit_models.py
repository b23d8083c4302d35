"""What models of particles can have, and abuse, with SolverImplicit: each with a clear answer."""

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import DistanceRollout, Rollout, add_patch, bullet, strands
from newton_versions import HAS_OBSERVABLES, needs_attachments, needs_hard_attachments

import warp_bsc as bsc
from warp_bsc.implicit.solver_implicit import SolverImplicit

DT, GRAVITY = 1.0 / 60.0, 9.81
TILTED = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.5)


def add_table(builder, *, half=0.5, **options):
    """Adds a box whose top is at a height of 0."""
    at = wp.transform(wp.vec3(0.0, 0.0, -0.1), wp.quat_identity())
    builder.add_shape_box(-1, xform=at, hx=half, hy=half, hz=0.1, **options)


def sheet(device, height, *, on_plane=False, gravity=(0.0, 0.0, -GRAVITY), mu=0.5, n=4, **options):
    """A sheet of cloth at a height over a table, or over an infinite plane."""
    builder = newton.ModelBuilder(gravity=gravity)
    builder.default_shape_cfg.mu = mu
    add_patch(builder, n, 0.04, (0.0, 0.0, height), **options)
    if on_plane:
        builder.add_ground_plane()
    else:
        add_table(builder)
    return builder.finalize(device=device)


def block(device):
    """A soft block over a table."""
    builder = newton.ModelBuilder()
    options = {"density": 300.0, "k_mu": 1e4, "k_lambda": 1e4, "k_damp": 1e-2, "particle_radius": 0.002}
    cells = {"dim_x": 2, "dim_y": 2, "dim_z": 2, "cell_x": 0.025, "cell_y": 0.025, "cell_z": 0.025}
    builder.add_soft_grid(pos=wp.vec3(0.0, 0.0, 0.01), rot=wp.quat_identity(), vel=wp.vec3(), **cells, **options)
    add_table(builder)
    return builder.finalize(device=device)


def run(model, steps, *, dt=DT, before=None, each=None, **options):
    """Returns the solver and the last state, after ``before`` has changed the first and ``each`` each start."""
    solver, state, other = SolverImplicit(model, **options), model.state(), model.state()
    if before is not None:
        before(state)
    for step in range(steps):
        if each is not None:
            each(state, step)
        solver.step(state, other, None, None, dt)
        state, other = other, state
    return solver, state


def change(array, at, value):
    """Writes a value into an array on a device."""
    values = array.numpy()
    values[at] = value
    array.assign(values)


# Ropes, grains, distances


def test_ropes_and_grains_collide_by_their_radii(device):
    model = strands(device)
    radius = model.particle_radius.numpy().copy()
    radius[np.unique(model.tri_indices.numpy())] = 0.0
    rollout = DistanceRollout(model, SolverImplicit(model), radius=radius)
    for _ in range(30):
        rollout.step(DT)
        assert rollout.solver.report.certified
    assert rollout.approaches == 0
    assert rollout.collisions == 0
    assert np.linalg.norm(rollout.states[0].particle_qd.numpy(), axis=1).max() < 0.3
    assert rollout.states[0].particle_q.numpy()[:, 2].min() > -0.05  # they lie on the patch


def test_ropes_without_radii_warn(device):
    builder = newton.ModelBuilder()
    for i in range(3):
        builder.add_particle(wp.vec3(0.1 * i, 0.0, 0.01), wp.vec3(), 0.01, radius=0.0)
    builder.add_spring(0, 1, 100.0, 0.1, 0)
    builder.add_ground_plane()
    with pytest.warns(UserWarning, match="take no part"):
        solver, state = run(builder.finalize(device=device), 10)
    assert solver.report.certified
    assert (state.particle_q.numpy()[:, 2] > 0.0).all()  # planes stop them all the same


@pytest.mark.parametrize("options", [{"min_distance": 0.012}, {"min_distance": 0.004, "particle_radius": 0.004}])
def test_pairs_keep_their_distance(options, device):
    model = bullet(5.0, device=device)
    radius = np.full(model.particle_count, options.get("particle_radius", 0.0))
    solver = SolverImplicit(model, **options)
    rollout = DistanceRollout(model, solver, options["min_distance"], radius=radius)
    for _ in range(6):
        rollout.step(DT)
        assert solver.report.certified
    assert rollout.approaches == 0
    fast = rollout.states[0].particle_q.numpy()[-81:, 2].min()
    assert fast > -0.15  # the sheet stops what would be 0.4 m below


def test_a_sheet_lands_in_steps_of_a_second(device):
    """Pairs that are held first keep it in the air: such displacements raise the energy, whatever share is taken."""
    model = sheet(device, 0.3, n=12)
    solver, state = run(model, 3, dt=1.0)
    assert solver.report.certified
    assert state.particle_q.numpy()[:, 2].min() > 0.0 and state.particle_q.numpy()[:, 2].max() < 0.1


def test_radii_and_margins_of_the_model(device):
    builder = newton.ModelBuilder()
    add_patch(builder, 4, 0.04, (0.0, 0.0, 0.03))
    add_table(builder, cfg=newton.ModelBuilder.ShapeConfig(margin=0.003))
    model = builder.finalize(device=device)
    _, state = run(model, 30, min_distance="model")
    height = state.particle_q.numpy()[:, 2]
    assert height.min() >= 0.008  # 5 mm of particles, 3 mm of the box
    assert height.max() < 0.012


def test_a_filter_lets_cloth_pass(device):
    model = sheet(device, 0.01)
    _, state = run(model, 20, collision_filter=bsc.CollisionFilter(particle_mask=0))
    np.testing.assert_allclose(state.particle_q.numpy()[:, 2], 0.01 - 0.5 * GRAVITY * (20 * 21) * DT**2, atol=1e-3)
    _, state = run(model, 20)
    assert (state.particle_q.numpy()[:, 2] > 0.0).all()


@pytest.mark.parametrize(("friction", "slides"), [(0.9, False), (0.2, True)])
@pytest.mark.parametrize("on_plane", [False, True])
def test_a_friction_table_decides_what_slides(friction, slides, on_plane, device):
    angle = 0.5  # whose tangent is 0.55
    gravity = (GRAVITY * np.sin(angle), 0.0, -GRAVITY * np.cos(angle))
    model = sheet(device, 5e-4, gravity=gravity, on_plane=on_plane)
    table = np.array([[-1.0, friction], [friction, -1.0]], dtype=np.float32)
    of_pairs = bsc.FrictionTable(table, particle_material=0, shape_material=1)
    steps = 20
    _, state = run(model, steps, friction=of_pairs, max_iterations=40)
    speed = state.particle_qd.numpy()[:, 0].mean()
    if slides:
        expected = steps * DT * GRAVITY * (np.sin(angle) - friction * np.cos(angle))
        assert speed == pytest.approx(expected, rel=0.05)
    else:
        assert abs(speed) < 1e-3  # smoothed below 0.5 mm/s


# Attachments


def attached(device, *, stiffness, damping=0.0):
    """A particle that hangs on a kinematic body 1 m up, and one that an attachment that is not enabled leaves alone."""
    builder = newton.ModelBuilder()
    body = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 1.0), wp.quat_identity()), is_kinematic=True)
    for x in (0.1, 0.5):
        builder.add_particle(wp.vec3(x, 0.0, 1.2), wp.vec3(), 0.02, radius=0.001)
    point = wp.vec3(0.1, 0.0, 0.2)
    builder.add_attachment_particle_body(0, body, body_point=point, stiffness=stiffness, damping=damping)
    builder.add_attachment_particle_body(1, body, body_point=point, stiffness=stiffness, enabled=False)
    return builder.finalize(device=device)


@needs_attachments
def test_attachments_are_springs_with_damping(device):
    stiffness, mass, damping = 30.0, 0.02, 0.1
    model = attached(device, stiffness=stiffness, damping=damping)
    x, v = np.array([0.1, 0.0, 1.2]), np.zeros(3)
    point = x.copy()
    solver, state, other = SolverImplicit(model), model.state(), model.state()
    for step in range(12):
        pose = state.body_q.numpy()
        pose[0, 0] += 0.01 * (step > 0)  # the first step begins where the model has the body
        state.body_q.assign(pose)
        solver.step(state, other, None, None, DT)
        state, other = other, state
        moved = np.array([0.01 * (step > 0), 0.0, 0.0])
        point = point + moved
        inertia = mass / DT**2
        goal = x + DT * v - (0.0, 0.0, DT**2 * GRAVITY)
        total = inertia + stiffness + damping / DT
        end = (inertia * goal + stiffness * point + damping / DT * (x + moved)) / total
        x, v = end, (end - x) / DT
        np.testing.assert_allclose(state.particle_q.numpy()[0], x, atol=1e-5)
    free = 1.2 - 0.5 * GRAVITY * (12 * 13) * DT**2
    assert state.particle_q.numpy()[1, 2] == pytest.approx(free, abs=1e-4)


@needs_attachments
def test_damping_of_attachments_does_not_see_what_a_reset_moves(device):
    model = attached(device, stiffness=0.0, damping=1.0)
    solver, state, other = SolverImplicit(model), model.state(), model.state()
    for _ in range(2):
        solver.step(state, other, None, None, DT)
        state, other = other, state
    start = model.state()
    change(start.body_q, 0, (0.5, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))
    solver.reset(start)
    solver.step(start, other, None, None, DT)
    np.testing.assert_allclose(other.particle_q.numpy()[0, :2], (0.1, 0.0), atol=1e-6)


@needs_hard_attachments
def test_attachments_of_infinite_stiffness_hold_particles(device):
    model = attached(device, stiffness=np.inf)

    def turn(state, step):
        half = 0.05 * (step + 1)
        change(state.body_q, 0, (0.0, 0.0, 1.0 + 0.01 * step, np.sin(half), 0.0, 0.0, np.cos(half)))

    _, state = run(model, 5, each=turn)
    angle = 2.0 * 0.25
    expected = (0.1, -0.2 * np.sin(angle), 1.04 + 0.2 * np.cos(angle))
    np.testing.assert_allclose(state.particle_q.numpy()[0], expected, atol=1e-6)
    assert np.linalg.norm(state.particle_qd.numpy()[0]) > 0.1


@needs_hard_attachments
def test_two_attachments_of_infinite_stiffness_are_refused(device):
    builder = newton.ModelBuilder()
    body = builder.add_body(is_kinematic=True)
    builder.add_particle(wp.vec3(), wp.vec3(), 0.01)
    for x in (0.0, 0.1):
        builder.add_attachment_particle_body(0, body, body_point=wp.vec3(x, 0.0, 0.0), stiffness=np.inf)
    with pytest.raises(NotImplementedError, match="infinite stiffness"):
        SolverImplicit(builder.finalize(device=device))


# Starts


@pytest.mark.parametrize("rate", [60, 1920])
@pytest.mark.parametrize("on_plane", [False, True])
def test_barriers_do_not_throw_what_starts_near(rate, on_plane, device):
    start = 4e-4  # a tenth of the reach
    model, top = sheet(device, start, on_plane=on_plane), 0.0
    solver, state, other = SolverImplicit(model, max_iterations=20), model.state(), model.state()
    for _ in range(rate // 10):
        solver.step(state, other, None, None, 1.0 / rate)
        state, other = other, state
        top = max(top, state.particle_q.numpy()[:, 2].max())
    assert top < start + 0.01  # 0.1 m in steps of 1/1920 s if barriers give all of their energy
    assert state.particle_q.numpy()[:, 2].min() > 0.0


def test_short_steps_fall_as_fast_as_long_ones(device):
    """What a step leaves unsolved adds up over many of them: the sheet is curved, stiff and damped, and falls fast."""
    builder = newton.ModelBuilder()
    x, y = (k.ravel() for k in np.meshgrid(np.arange(4.0), np.arange(4.0)))
    corner = np.arange(16).reshape(4, 4)[:-1, :-1].ravel()
    faces = np.concatenate([[corner, corner + 1, corner + 5], [corner, corner + 5, corner + 4]], axis=1).T
    curved = {"vertices": np.stack([x, y, 0.3 * x**2], axis=1), "indices": faces.ravel(), "scale": 1.0}
    at = {"pos": wp.vec3(0.0, 0.0, 10.0), "rot": TILTED, "vel": wp.vec3(0.0, 0.0, -10.0)}
    material = {"tri_ke": 50.0, "tri_ka": 50.0, "tri_kd": 5.0, "edge_ke": 10.0, "edge_kd": 10.0}
    builder.add_cloth_mesh(**at, **curved, density=0.02, **material)
    model = builder.finalize(device=device)
    _, state = run(model, 60, dt=1.0 / 600.0)
    mass = model.particle_mass.numpy()
    velocity = mass @ state.particle_qd.numpy() / mass.sum()
    assert velocity[2] + 10.0 == pytest.approx(-0.1 * GRAVITY, rel=2e-3)


@pytest.mark.parametrize("on_plane", [False, True])
def test_what_is_pressed_in_short_steps_keeps_its_gap(on_plane, device):
    """Barriers carry a load of 500 times gravity. If they do not, gaps become half in each step, down to rounding."""
    model = sheet(device, 0.001, on_plane=on_plane)
    press = np.zeros((model.particle_count, 3), dtype=np.float32)
    press[:, 2] = -500.0 * GRAVITY * model.particle_mass.numpy()
    solver, state = run(model, 60, dt=1.0 / 600.0, each=lambda state, step: state.particle_f.assign(press))
    assert solver.report.certified and solver.report.converged
    assert state.particle_q.numpy()[:, 2].min() > 1e-6


@pytest.mark.parametrize("on_plane", [False, True])
def test_what_touches_at_the_start_rests(on_plane, device):
    solver, state = run(sheet(device, 0.0, on_plane=on_plane), 20)
    assert solver.report.certified
    height = state.particle_q.numpy()[:, 2]
    assert height.min() > 0.0 and height.max() < 0.005
    assert np.abs(state.particle_qd.numpy()).max() < 0.01


def test_what_crosses_at_the_start_is_named(device):
    model = sheet(device, 0.02)
    with pytest.warns(UserWarning, match="pass through faces at the start"):
        solver, state = run(model, 1, before=lambda state: change(state.particle_q, (12, 2), -0.02))
        assert solver.report.crossings > 0
        solver.report.warn()  # on a GPU, a step has not waited for its result
    assert np.isfinite(state.particle_q.numpy()).all()
    solver, _ = run(sheet(device, -0.02, on_plane=True), 1)
    assert solver.report.excluded == 25


def test_forces_of_contacts_of_newton_are_refused(device):
    """They are in the report; observables that a program does not ask for are none, as of any solver."""
    model = sheet(device, 0.02)
    solver, states = SolverImplicit(model), [model.state(), model.state()]
    contacts = newton.CollisionPipeline(model).contacts()
    solver.step(*states, None, contacts, DT, observables=None)
    assert states[1].particle_q.numpy()[:, 2].mean() < 0.02
    with pytest.raises(NotImplementedError, match=r'report=\["contacts"\]'):
        solver.update_contacts(contacts, states[1])
    if HAS_OBSERVABLES:
        with pytest.raises(ValueError, match="contact_f"):
            solver.observables({"contact_f"})
    else:
        with pytest.raises(TypeError, match=r"observables: Newton 1\.6.* has none"):
            solver.step(*states, None, contacts, DT, observables={"contact_f"})


# Abuse


def _check_others(state, hurt):
    """Checks that all particles but some have finite positions, and have fallen onto the table."""
    others = np.delete(state.particle_q.numpy(), hurt, axis=0)
    assert np.isfinite(others).all()
    assert np.isfinite(np.delete(state.particle_qd.numpy(), hurt, axis=0)).all()
    assert others[:, 2].min() > 0.0
    assert np.median(others[:, 2]) < 0.012


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["particle_q", "particle_qd"])
@pytest.mark.filterwarnings("ignore:.*not finite", "ignore:.*strained", "ignore:.*not certified")
def test_a_particle_that_is_not_finite_harms_no_other(name, value, device):
    model = sheet(device, 0.015)
    solver, state = run(model, 15, before=lambda state: change(getattr(state, name), 12, value))
    _check_others(state, [12])
    assert solver.report.totals.not_finite_steps > 0
    assert solver.report.certified == (name == "particle_qd")  # which is 0 after the first step


@pytest.mark.parametrize("name", ["particle_q", "particle_qd", "particle_f"])
@pytest.mark.parametrize("mass", [0.001, 0.0])
@pytest.mark.filterwarnings("ignore:.*not finite", "ignore:.*not certified")
def test_a_world_with_input_that_is_not_finite_is_not_converged(name, mass, device):
    """Also of a particle that is solved for alone in its world, or is not; the other world is converged."""
    builder = newton.ModelBuilder()
    for world, of_particle in enumerate((0.001, mass)):
        builder.begin_world()
        builder.add_particle(wp.vec3(float(world), 0.0, 0.0), wp.vec3(), of_particle)
        builder.end_world()
    model = builder.finalize(device=device)
    solver, _ = run(model, 1, before=lambda state: change(getattr(state, name), 1, np.nan), report=["worlds"])
    is_used = mass > 0.0 or name != "particle_f"
    assert solver.report.worlds.converged.numpy().tolist() == [True, not is_used]
    assert solver.report.converged != is_used and solver.report.unconverged_steps == is_used


def test_a_light_cloth_is_solved_for_beside_something_heavy(device):
    """A linear solve ends by energies, most of which are of what is heavy: two Newton steps are as of cloth alone."""
    ends = []
    for others in (0, 1):
        builder = newton.ModelBuilder()
        add_patch(builder, 4, 0.04, (0.0, 0.0, 0.0))
        builder.particle_mass[0] = builder.particle_mass[4] = 0.0
        for _ in range(others):
            builder.add_particle(wp.vec3(9.0, 0.0, 0.0), wp.vec3(), 1e3, radius=0.01)
        _, state = run(builder.finalize(device=device), 1, max_iterations=2)
        ends.append(state.particle_q.numpy()[:25])
    np.testing.assert_allclose(ends[1], ends[0], atol=2e-5)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.filterwarnings("ignore:.*not finite", "ignore:.*strained")
def test_a_force_that_is_not_finite_harms_no_other_particle(value, device):
    model = sheet(device, 0.015)
    solver, state = run(model, 15, each=lambda state, step: change(state.particle_f, 12, value))
    assert not solver.report.certified
    assert np.isfinite(state.particle_q.numpy()).all()
    assert state.particle_q.numpy()[12, 2] == pytest.approx(0.015)  # held
    _check_others(state, [7, 11, 12, 13, 17])


@pytest.mark.parametrize("masses", [{12: 0.0}, {12: np.inf}, {12: np.nan}, {12: 1e9, 3: 1e-20}])
@pytest.mark.filterwarnings("ignore:.*strained")
def test_masses(masses, device):
    builder = newton.ModelBuilder()
    add_patch(builder, 4, 0.04, (0.0, 0.0, 0.015))
    add_table(builder)
    for particle, mass in masses.items():
        builder.particle_mass[particle] = mass
    solver, state = run(builder.finalize(device=device), 15)
    assert solver.report.certified
    is_held = len(masses) == 1
    assert (state.particle_q.numpy()[12, 2] == np.float32(0.015)) == is_held
    _check_others(state, [7, 11, 12, 13, 17] if is_held else [])


@pytest.mark.filterwarnings("ignore:.*strained")
def test_inverse_masses_that_are_not_finite_and_inactive_particles_are_held(device):
    model = sheet(device, 0.015)
    change(model.particle_inv_mass, 0, np.inf)
    change(model.particle_inv_mass, 4, np.nan)
    change(model.particle_flags, 24, 0)
    solver, state = run(model, 15)
    assert solver.report.certified
    held = state.particle_q.numpy()[[0, 4, 24], 2]
    np.testing.assert_array_equal(held, np.float32(0.015))
    assert np.isfinite(state.particle_q.numpy()).all()


def test_elements_whose_corners_are_all_held(device):
    builder = newton.ModelBuilder()
    add_patch(builder, 2, 0.04, (0.0, 0.0, 0.1))
    for particle in range(builder.particle_count):
        builder.particle_mass[particle] = 0.0
    add_table(builder)
    model = builder.finalize(device=device)
    solver, state = run(model, 3)
    assert solver.report.certified
    np.testing.assert_array_equal(state.particle_q.numpy(), model.particle_q.numpy())


@pytest.mark.parametrize(("particles", "height"), [(13, 0.1), (slice(None), 0.02)], ids=["inverted", "flat"])
@pytest.mark.filterwarnings("ignore:.*strained")
def test_tetrahedra_recover(particles, height, device):
    """The particle in the middle starts above the block, or all are in one plane."""
    model = block(device)
    solver, state = run(model, 40, before=lambda state: change(state.particle_q, (particles, 2), height))
    assert solver.report.certified
    x = state.particle_q.numpy()
    assert x[:, 2].min() > 0.0
    corners = x[model.tet_indices.numpy().reshape(-1, 4)]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    assert volume.min() > 0.0
    assert volume.sum() == pytest.approx(0.05**3, rel=0.1)


@pytest.mark.filterwarnings("ignore:.*strained", "ignore:edges pass", "ignore:.*not certified")
def test_triangles_of_zero_area(device):
    def collapse(state):
        change(state.particle_q, [6, 12, 13], state.particle_q.numpy()[7])

    _, state = run(sheet(device, 0.015), 20, before=collapse)
    _check_others(state, [])
    assert np.abs(state.particle_qd.numpy()).max() < 0.1


@pytest.mark.parametrize("dt", [1e-6, 1e-4, 0.1, 1.0])
def test_lengths_of_steps(dt, device):
    steps = 8
    solver, state = run(sheet(device, 0.01), steps, dt=dt)
    assert solver.report.certified
    z, speed = state.particle_q.numpy()[:, 2], np.abs(state.particle_qd.numpy()).max()
    assert z.min() > 0.0
    if dt < 1e-3:
        assert speed == pytest.approx(GRAVITY * steps * dt, rel=0.05)
    else:
        assert z.max() < 0.05 and speed < 0.1


@pytest.mark.filterwarnings("ignore:.*strained", "ignore:.*not certified")
def test_a_kinematic_body_at_200_metres_a_second(device):
    builder = newton.ModelBuilder()
    add_patch(builder, 2, 0.06, (0.0, 0.0, 0.2))
    body = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.0), wp.quat_identity()), is_kinematic=True)
    builder.add_shape_box(body, hx=0.03, hy=0.04, hz=0.05)
    model = builder.finalize(device=device)
    judge, solver = Rollout(model, None), SolverImplicit(model)
    state, other, before, height = model.state(), model.state(), judge.start, 0.0
    for _ in range(4):
        height += 200.0 * DT
        change(state.body_q, (0, 2), height)
        solver.step(state, other, None, None, DT)
        state, other = other, state
        after = judge.vertices(state)
        named = set(solver.report.uncertified_vertices.tolist())
        assert all(named.intersection(corners) for corners in judge.find_collisions(before, after))
        before = after
    assert np.isfinite(state.particle_q.numpy()).all()
    middle, report = state.particle_q.numpy()[4], solver.report
    # the body takes the cloth along, or the cloth slides off to a side, or the report says that it is not taken along
    is_beside = (np.abs(middle[:2]) > (0.03, 0.04)).any()
    assert middle[2] > height + 0.05 or is_beside or report.totals.uncertified_steps > 0 or not report.converged


@pytest.mark.filterwarnings("ignore:.*not certified", "ignore:edges pass", "ignore:.*strained")
def test_what_is_crushed_is_named(device):
    builder = newton.ModelBuilder()
    add_patch(builder, 2, 0.06, (0.0, 0.0, 0.01))
    add_table(builder)
    body = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.1), wp.quat_identity()), is_kinematic=True)
    builder.add_shape_box(body, hx=0.3, hy=0.3, hz=0.05)

    def press(state, step):
        change(state.body_q, (0, 2), 0.1 - 0.02 * step)

    solver, state = run(builder.finalize(device=device), 6, each=press)
    assert solver.report.totals.uncertified_steps > 0
    assert np.isfinite(state.particle_q.numpy()).all()
    assert np.abs(state.particle_qd.numpy()).max() < 100.0


@pytest.mark.parametrize("speed", [None, 15.0])
def test_no_candidates_are_sought_between_shapes_alone_or_within_a_body(speed, device):
    """Of a sphere that stands, or is a body that goes as far as it is large in a step."""
    if speed and device.is_cuda:
        pytest.skip("on a GPU pairs within a body are found, and left out later")
    builder = newton.ModelBuilder()
    add_patch(builder, 4, 0.04, (0.0, 0.0, 0.3))
    body = builder.add_body() if speed else -1
    builder.add_shape_sphere(body=body, radius=0.1)
    model = builder.finalize(device=device)
    solver, _ = run(model, 1, before=lambda state: speed and change(state.body_qd, (0, 0), speed))
    newton_method, detector = solver.newton_method, solver.work.detector
    newton_method.find_candidates()
    found = newton_method.problem.candidates
    counts = detector.counters.read()
    queued = counts.vertex_face.queued + counts.edge_edge.queued
    assert 0 < queued == found.near.numpy()[0] + found.far.numpy()[0]


# Models with little


def test_a_model_without_particles_is_refused(device):
    builder = newton.ModelBuilder()
    add_table(builder)
    with pytest.raises(ValueError, match="neither particles nor bodies"):
        SolverImplicit(builder.finalize(device=device))


def test_a_particle_alone_falls_in_all_worlds_of_one(device):
    builder = newton.ModelBuilder()
    builder.begin_world()
    builder.add_particle(wp.vec3(0.0, 0.0, 1.0), wp.vec3(), 0.01, radius=0.01)
    builder.end_world()
    builder.add_particle(wp.vec3(1.0, 0.0, 1.0), wp.vec3(), 0.01, radius=0.01)  # in world -1
    model = builder.finalize(device=device)
    solver, state = run(model, 6)
    assert solver.report.certified
    np.testing.assert_allclose(state.particle_q.numpy()[:, 2], 1.0 - 0.5 * GRAVITY * (6 * 7) * DT**2, rtol=1e-5)
