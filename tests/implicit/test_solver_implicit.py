"""SolverImplicit as a solver of Newton: report, contact forces, graphs, and what a program changes between steps."""

import copy
import threading
import warnings

import newton
import numpy as np
import pytest
import warp as wp
from newton import ModelFlags, ParticleFlags
from newton_scenes import SOFT, add_patch, bullet

import warp_bsc as bsc
from warp_bsc.bench.scenes.contact import build_scene
from warp_bsc.bench.scenes.simulation import Simulation, energy_gained
from warp_bsc.implicit.contact import newton_method, system
from warp_bsc.response.state.motion import arrays_of
from warp_bsc.response.state.structs import allocate

DT, GRAVITY = 1.0 / 60.0, 9.81


def ramp(device, angle=0.0, *, velocity=0.0, mu=0.3, on_plane=False):
    """A cloth near a static box, or a plane, tilted by an angle about the y axis; z is normal to it, x points down."""
    builder = newton.ModelBuilder(gravity=(GRAVITY * np.sin(angle), 0.0, -GRAVITY * np.cos(angle)))
    cfg = newton.ModelBuilder.ShapeConfig(mu=mu)
    if on_plane:
        builder.add_ground_plane(cfg=cfg)
    else:
        at = wp.transform(wp.vec3(0.0, 0.0, -0.1), wp.quat_identity())
        builder.add_shape_box(-1, hx=0.5, hy=0.2, hz=0.1, xform=at, cfg=cfg)
    cells = {"dim_x": 4, "dim_y": 4, "cell_x": 0.05, "cell_y": 0.05, "mass": 0.001}
    at, speed = wp.vec3(-0.1, -0.1, 0.002), wp.vec3(velocity, 0.0, 0.0)
    builder.add_cloth_grid(pos=at, rot=wp.quat_identity(), vel=speed, **cells, **SOFT)
    return builder.finalize(device=device)


def weight_of(model):
    return GRAVITY * float(model.particle_mass.numpy().sum())


def step(solver, state, end, steps=1, dt=DT):
    """Steps from a state to another one and back; returns the one of the end."""
    for _ in range(steps):
        solver.step(state, end, None, None, dt)
        state, end = end, state
    return state


def forces(solver, state, end, steps):
    """Steps, and returns the force on the first shape in each step [N]."""
    found = []
    for _ in range(steps):
        solver.step(state, end, None, None, DT)
        found.append(solver.report.forces.shape_impulse.numpy()[0] / DT)
        state, end = end, state
    return np.array(found)


def positions(state):
    return np.concatenate([state.particle_q.numpy(), state.particle_qd.numpy()])


@pytest.mark.parametrize("on_plane", [False, True])
def test_a_scale_under_a_cloth_shows_its_weight(on_plane, device):
    model = ramp(device, on_plane=on_plane)
    solver = bsc.SolverImplicit(model, report=["contacts"])
    force, weight = forces(solver, model.state(), model.state(), 12)[-1], weight_of(model)
    assert np.allclose(force, (0.0, 0.0, -weight), atol=1e-3 * weight)
    report = solver.report
    assert report.certified and report.converged and report.arrived and report.predicted_contacts == 0
    assert report.forces.contacts.complete and report.forces.complete
    listed = report.forces.contacts.numpy()
    assert np.isin(listed["kind"], [2] if on_plane else [0, 1]).all() and (listed["shapes"] == (-1, 0)).all()
    assert listed["normal_impulse"].sum() / DT == pytest.approx(weight, rel=1e-3)
    assert np.allclose(listed["velocity"], (0.0, 0.0, -GRAVITY * DT), atol=1e-3)
    assert np.allclose(report.forces.particle_impulse.numpy().sum(axis=0) / DT, (0.0, 0.0, weight), atol=1e-3 * weight)
    assert not report.forces.unpaired_particle_impulse.numpy().any()


def test_friction_on_a_ramp_is_mu_times_the_normal_force(device):
    """Of a cloth that slides down; and it accelerates as that says."""
    model = ramp(device, 0.5, velocity=0.5, mu=0.2)
    solver, state = bsc.SolverImplicit(model, friction=0.2, report=["contacts"]), model.state()
    force, weight = -forces(solver, state, model.state(), 12)[-6:].mean(axis=0), weight_of(model)
    assert force[2] == pytest.approx(weight * np.cos(0.5), rel=0.01)
    assert force[0] == pytest.approx(-0.2 * force[2], rel=0.01)
    velocity = state.particle_qd.numpy()[:, 0].mean()
    assert velocity == pytest.approx(0.5 + 12 * DT * GRAVITY * (np.sin(0.5) - 0.2 * np.cos(0.5)), rel=0.02)


def test_torques_on_a_moved_body_are_those_of_its_contacts(device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    body = builder.add_body(xform=wp.transform(wp.vec3(0.3, 0.0, -0.1), wp.quat_identity()), is_kinematic=True)
    builder.add_shape_box(body, hx=0.5, hy=0.2, hz=0.1)
    add_patch(builder, 2, 0.05, (0.0, 0.0, 0.002))
    model = builder.finalize(device=device)
    solver = bsc.SolverImplicit(model, report=["contacts"])
    step(solver, model.state(), model.state(), 12)
    wrench, weight = solver.report.forces.body_impulse.numpy()[body] / DT, weight_of(model)
    # the arm of the weight is 0.3 m to the left
    assert np.allclose(wrench, (0.0, 0.0, -weight, 0.0, -0.3 * weight, 0.0), atol=2e-3 * weight)


def test_a_budget_of_newton_steps_is_kept_and_said_to_have_run_out(device):
    model, changes = ramp(device), []
    for most in (1, 2, 50):
        solver = bsc.SolverImplicit(model, max_iterations=most)
        step(solver, model.state(), model.state())
        report = solver.report
        suffices = most == 50
        assert report.newton_steps == most or (suffices and 2 < report.newton_steps < 50)
        assert report.converged == suffices and (report.last_change <= 5e-3) == suffices
        assert report.unconverged_steps == int(not suffices)
        assert f"{report.unconverged_steps} whose Newton steps did not converge" in str(report)
        changes.append(report.last_change)
    assert changes[0] > changes[1] > changes[2]


def test_a_step_ends_where_what_is_left_of_changes_is_small(device, monkeypatch):
    """Velocities are within 1 mm/s of those of many more Newton steps, after fewer than their changes alone ask for."""
    taken, velocities = [], []
    for least in (None, 1e-6):
        if least:
            monkeypatch.setattr(newton_method, "_LEAST_SPEED", least)
        model = ramp(device)
        solver = bsc.SolverImplicit(model, max_iterations=50)
        end = model.state()
        step(solver, model.state(), end)
        taken.append((solver.report.newton_steps, solver.report.last_change))
        velocities.append(end.particle_qd.numpy())
    assert np.abs(velocities[0] - velocities[1]).max() < 1e-3 < taken[0][1]
    assert taken[0][0] < taken[1][0] and solver.report.converged


@wp.kernel
def find_near_end(progress: system.Progress, is_near: wp.array[wp.bool]):
    w = wp.tid()
    is_near[w] = system.is_near_end(progress, w, 1.0)


def test_a_step_ends_within_a_hundredth_of_the_way_of_what_a_program_moves(device):
    """But ten times as far from its end as without, at most; each world by what moves in it."""
    progress = allocate(system.Progress, 6, device)
    progress.scale.fill_(1.0)
    progress.before.fill_(1.0)
    progress.driven.assign([0.0, 0.0, 300.0, 300.0, 1e6, 1e6])
    progress.change.assign([0.9, 1.1, 2.9, 3.1, 9.9, 10.1])
    is_near = wp.zeros(6, dtype=wp.bool, device=device)
    wp.launch(find_near_end, 6, inputs=[progress, is_near], device=device)
    np.testing.assert_array_equal(is_near.numpy(), [True, False] * 3)


@pytest.mark.parametrize("cells", [9, 21, 29, 37])
def test_cloth_of_any_size_hangs_in_its_weight(device, cells):
    """Each size is solved by threads that share the work in another way on a GPU: the held row carries the weight."""
    builder = newton.ModelBuilder()
    builder.add_cloth_grid(
        pos=wp.vec3(), rot=wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.5 * np.pi), vel=wp.vec3(),
        dim_x=cells, dim_y=cells, cell_x=0.3 / cells, cell_y=0.3 / cells, mass=0.1 / (cells + 1) ** 2, fix_top=True,
        tri_ke=100.0, tri_ka=100.0, tri_kd=0.0,
    )  # fmt: skip
    model = builder.finalize(device=device)
    solver, state = bsc.SolverImplicit(model, max_iterations=50), model.state()
    for _ in range(3):
        step(solver, state, state)
    assert solver.report.converged and solver.report.certified
    z, free = state.particle_q.numpy()[:, 2], model.particle_inv_mass.numpy() > 0
    below = z[~free].min() - 0.3 - z[free].min()  # than where it began
    assert 0.001 < below < 9.81 * (1 + 2 + 3) / 60.0**2  # that of a fall
    assert (np.diff(z.reshape(cells + 1, cells + 1), axis=0) > 0.0).all()


def test_compressed_cloth_takes_few_newton_steps(device):
    """Its Hessian curves downwards in part: without that part, 8 Newton steps are needed."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -3.0))
    cells = {"dim_x": 6, "dim_y": 6, "cell_x": 0.05, "cell_y": 0.05, "mass": 0.0005}
    held = dict.fromkeys(("fix_left", "fix_right", "fix_top", "fix_bottom"), True)
    stiffness = {"tri_ke": 200.0, "tri_ka": 200.0, "tri_kd": 0.0, "edge_ke": 1e-3, "edge_kd": 1e-4}
    at = {"pos": wp.vec3(), "rot": wp.quat_identity(), "vel": wp.vec3()}
    builder.add_cloth_grid(**at, **cells, **held, **stiffness)
    model = builder.finalize(device=device)
    model.particle_q.assign(0.999 * model.particle_q.numpy())
    solver = bsc.SolverImplicit(model, max_iterations=50)
    step(solver, model.state(), model.state())
    assert solver.report.converged and solver.report.newton_steps <= 5


def sheets(device, cell, gap, speed):
    """Twelve sheets of cloth above each other and the ground, falling."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    membrane = {"tri_ke": 1e3, "tri_ka": 1e3, "tri_kd": 0.0, "edge_ke": 1e-3, "edge_kd": 1e-4}
    cells = {"dim_x": 4, "dim_y": 4, "cell_x": cell, "cell_y": cell, "mass": 0.3 * cell**2, "particle_radius": 0.0}
    for k in range(1, 13):
        at = wp.vec3(0.0, 0.0, gap * k)
        builder.add_cloth_grid(pos=at, rot=wp.quat_identity(), vel=wp.vec3(0.0, 0.0, -speed), **cells, **membrane)
    return builder.finalize(device=device)


def test_sheets_that_hit_each_other_where_single_vertices_are_cut_have_their_barriers(device):
    """What falls side by side is not far from each other any more once one of its vertices is cut."""
    solver = bsc.SolverImplicit(sheets(device, 0.04, 0.006, 1.0))
    states, hits = [solver.model.state(), solver.model.state()], 0
    for k in range(20):
        solver.step(states[k % 2], states[1 - k % 2], None, None, DT)
        hits += solver.report.predicted_contacts
    assert hits == 0
    assert solver.report.converged
    assert solver.report.unconverged_steps <= 4
    assert np.abs(states[0].particle_qd.numpy()).max() < 0.05


FALLS = [(0.006, 1.5), (0.008, 1.0)]
FALLS += [pytest.param(*each, marks=pytest.mark.slow) for each in ((0.006, 0.5), (0.008, 2.0), (0.01, 3.0))]


@pytest.mark.parametrize(("gap", "speed"), FALLS)
def test_sheets_that_fall_together_do_not_meet_where_one_is_cut(gap, speed, device):
    """Their ways are the same as long as all take the same part; one that takes less of its own is in the way."""
    solver = bsc.SolverImplicit(sheets(device, 0.04, gap, speed))
    states = [solver.model.state(), solver.model.state()]
    for k in range(3):
        solver.step(states[k % 2], states[1 - k % 2], None, None, DT)
        assert solver.report.predicted_contacts == 0


def test_boxes_of_candidates_take_a_part_of_a_displacement_of_metres(device):
    """Else all pairs are candidates, which do not fit into the buffers of a graph; the others take all of theirs."""
    solver = bsc.SolverImplicit(sheets(device, 0.04, 0.006, 1.0))
    problem = solver.newton_method.problem
    step(solver, solver.model.state(), solver.model.state())
    displaced = np.full((len(problem.trial.lower), 3), [0.005, 0.0, 0.0])
    displaced[7] = 0.0, 20.0, 0.0
    problem.trial.displaced.assign(displaced)
    problem.progress.leaves.fill_(1)
    solver.newton_method.renew_candidates()
    size = problem.trial.upper.numpy() - problem.trial.lower.numpy()
    assert 0.02 < size[7, 1] < 0.15
    assert (np.delete(size[:, 0], 7) > 0.005).all()


def test_layers_of_small_cells_rest_on_each_other(device):
    """Their barriers reach less far than gravity moves them in a step, and carry all that are above."""
    solver = bsc.SolverImplicit(sheets(device, 0.01, 0.0015, 0.0))
    state = step(solver, solver.model.state(), solver.model.state(), 20)
    assert solver.report.converged
    assert solver.report.newton_steps <= 2
    assert solver.report.unconverged_steps <= 4
    heights = state.particle_q.numpy()[:, 2].reshape(12, -1).mean(axis=1)
    assert (np.diff(heights) > 3e-4).all()  # with a reach of 1e-3
    assert heights[0] > 1e-4
    assert np.abs(state.particle_qd.numpy()).max() < 5e-3


def box_sizes(solver):
    """Returns how far the boxes of candidates reach beyond where vertices started the step, by their margins."""
    trial = solver.newton_method.problem.trial
    origin = trial.origin.numpy()
    return np.maximum(origin - trial.lower.numpy(), trial.upper.numpy() - origin) / trial.margin.numpy()[:, None]


def test_boxes_of_candidates_hold_what_rests_where_it_is(device):
    """Not where gravity alone would take it in the step: candidates of a pile at rest are few."""
    solver = bsc.SolverImplicit(sheets(device, 0.01, 0.0015, 0.0))
    step(solver, solver.model.state(), solver.model.state(), 21)
    assert 1.5 * solver.newton_method.problem.trial.margin.numpy().max() < GRAVITY * DT**2
    np.testing.assert_allclose(box_sizes(solver), 0.5, atol=0.1)


@pytest.mark.parametrize(("speed", "size"), [(0.0, 0.5), (0.1, 1.0)])
def test_boxes_of_candidates_are_larger_where_something_moves_in_their_world(speed, size, device):
    """It may hit what rests."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 4, 0.01, (0.0, 0.0, 0.0))
    resting = builder.particle_count
    add_patch(builder, 4, 0.01, (0.0, 0.0, 1.0))
    solver = bsc.SolverImplicit(builder.finalize(device=device))
    state = solver.model.state()
    velocity = state.particle_qd.numpy()
    velocity[resting:] = 0.0, 0.0, speed
    state.particle_qd.assign(velocity)
    step(solver, state, solver.model.state())
    np.testing.assert_allclose(box_sizes(solver)[:resting], size, atol=1e-3)


def test_what_a_program_presses_into_a_wedge_has_not_arrived(device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_shape_box(-1, hx=0.2, hy=0.2, hz=0.1, xform=wp.transform(wp.vec3(0.0, 0.0, -0.1), wp.quat_identity()))
    plate = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.105), wp.quat_identity()), is_kinematic=True)
    builder.add_shape_box(plate, hx=0.2, hy=0.2, hz=0.1)
    add_patch(builder, 2, 0.05, (0.0, 0.0, 0.0025))
    model = builder.finalize(device=device)
    solver, state, end = bsc.SolverImplicit(model, report=["worlds"]), model.state(), model.state()
    for height, arrives in ((0.105, True), (0.09, False)):
        state.body_q.assign([[0.0, 0.0, height, 0.0, 0.0, 0.0, 1.0]])
        with pytest.warns(UserWarning, match="is not certified") if not arrives else pytest.MonkeyPatch.context():
            solver.step(state, end, None, None, DT)
            assert solver.report.arrived == arrives and solver.report.certified == arrives
        assert solver.report.worlds.numpy()["arrived"].tolist() == [arrives]
        state.assign(end)
    assert not solver.report.converged


def test_a_step_that_strains_cloth_says_so_and_what_to_do(device):
    builder = newton.ModelBuilder()
    add_patch(builder, 2, 0.1, (0.0, 0.0, 0.0))
    builder.particle_mass = [1.0] * builder.particle_count
    model = builder.finalize(device=device)
    x0, state = model.particle_q.numpy(), model.state()
    for spread, strains in ((1.0, False), (40.0, True)):
        solver = bsc.SolverImplicit(model)
        state.particle_q.assign(x0)
        state.particle_qd.assign(spread * x0)
        found = []
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            x1 = step(solver, state, model.state()).particle_q.numpy()
            assert solver.report.totals.steps == 1  # on a GPU, what a step warns of is said once it is read
            found = [str(warning.message) for warning in said]
        a, b = solver.mesh.edges.T
        lengths = [np.linalg.norm(x[a] - x[b], axis=1) for x in (x0, x1)]
        assert solver.report.strain == pytest.approx((lengths[1] / lengths[0] - 1.0).max(), rel=1e-3)
        assert (solver.report.strain > 0.2) == strains == (solver.report.totals.strained_steps == 1)
        advice = "a step strained an edge by more than 20%: take shorter steps, or raise max_iterations"
        assert [text.startswith(advice) for text in found] == [True] * strains


def test_a_step_in_a_graph_is_the_step_without(device):
    """Captured before anything has been stepped, and while buffers are small."""
    ends = []
    for in_graph in (True, False):
        model = bullet(20.0, device=device)
        solver = bsc.SolverImplicit(model, report=["contacts"])
        state, end = model.state(), model.state()

        def launch(solver=solver, state=state, end=end):
            solver.step(state, end, None, None, DT)
            state.assign(end)

        if in_graph:
            with wp.ScopedCapture(device) as capture:
                launch()
        found = []
        for _ in range(4):
            if in_graph:
                wp.capture_launch(capture.graph)
            else:
                launch()
            report = solver.report
            found += [positions(state), report.forces.particle_impulse.numpy(), report.newton_steps, report.last_change]
        ends.append(found)
        assert (report.totals.steps, report.totals.uncertified_steps) == (4, 0)
    assert max(ends[0][2::4]) > 1
    for actual, expected in zip(*ends, strict=True):
        np.testing.assert_array_equal(actual, expected)


def test_contacts_that_do_not_fit_are_said_to_lack_where_buffers_cannot_grow(device, monkeypatch):
    """They cannot in a graph on a GPU."""
    model = ramp(device)
    solver = bsc.SolverImplicit(model, max_iterations=50)
    state = step(solver, model.state(), model.state(), 3)
    assert solver.report.converged
    method = solver.newton_method
    method.allocate_contacts(1)
    with monkeypatch.context() as patch:
        patch.setattr(method, "may_grow", False)
        step(solver, state, model.state())
    assert not solver.report.converged and solver.report.certified
    step(solver, state, model.state())
    assert solver.report.converged and len(method.problem.contacts.corners) > 1


def test_energies_of_very_many_fast_particles_do_not_overflow(device):
    count, velocity = 30_000, (0.0, 0.0, 250.0)
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    places = np.stack([np.arange(count), np.zeros(count), np.zeros(count)], axis=1).tolist()
    builder.add_particles(places, [velocity] * count, [1e-3] * count, [1e-3] * count)
    model = builder.finalize(device=device)
    solver = bsc.SolverImplicit(model)
    state = step(solver, model.state(), model.state())
    assert np.allclose(state.particle_qd.numpy(), velocity) and solver.report.converged


def test_states_may_be_one_and_contacts_are_not_used(device):
    ends = []
    for alone in (False, True):
        model = ramp(device, 0.2, velocity=0.3)
        solver, state = bsc.SolverImplicit(model), model.state()
        end, contacts = state, None
        if not alone:
            end, pipeline = model.state(), newton.CollisionPipeline(model)
            contacts = pipeline.contacts()
            pipeline.collide(state, contacts)
        for _ in range(4):
            solver.step(state, end, None, contacts, DT)
            state, end = end, state
        ends.append(positions(state))
    np.testing.assert_array_equal(*ends)


def test_solvers_of_one_model_do_not_disturb_each_other(device):
    model = ramp(device, 0.2, velocity=0.3)
    solvers = [bsc.SolverImplicit(model) for _ in range(2)]
    states = [[model.state(), model.state()] for _ in range(2)]
    for k in (0, 1, 1, 0, 0, 1):
        step(solvers[k], *states[k])
        states[k].reverse()
    np.testing.assert_array_equal(*(positions(pair[0]) for pair in states))


def test_masses_gravity_and_flags_are_read_again(device):
    model = ramp(device)
    solver, state, end = bsc.SolverImplicit(model, report=["contacts"]), model.state(), model.state()
    weight = weight_of(model)
    for scale in ("particle_mass", "gravity"):
        forces(solver, state, end, 2)
        for name, factor in (("particle_mass", 2.0), ("particle_inv_mass", 0.5), ("gravity", 2.0)):
            if scale in name or (scale == "particle_mass" and "mass" in name):
                getattr(model, name).assign(factor * getattr(model, name).numpy())
        solver.notify_model_changed(ModelFlags.MODEL_PROPERTIES)
        weight *= 2.0
        assert forces(solver, state, end, 16)[-1][2] == pytest.approx(-weight, rel=2e-3), scale
    flags = model.particle_flags.numpy()
    flags[:5] &= ~int(ParticleFlags.ACTIVE)
    model.particle_flags.assign(flags)
    model.set_gravity((0.0, 0.0, 5.0))
    solver.notify_model_changed(ModelFlags.MODEL_PROPERTIES)
    before = state.particle_q.numpy()
    after = step(solver, state, end).particle_q.numpy()
    assert np.array_equal(before[:5], after[:5]) and (after[-5:, 2] > before[-5:, 2]).all()


def test_a_shape_that_changes_is_followed(device):
    model = ramp(device)
    solver = bsc.SolverImplicit(model)
    state = step(solver, model.state(), model.state(), 4)
    model.shape_transform.assign([[0.0, 0.0, -0.15, 0.0, 0.0, 0.0, 1.0]])
    solver.notify_model_changed(ModelFlags.SHAPE_PROPERTIES)
    low = step(solver, state, model.state(), 24).particle_q.numpy()[:, 2]
    assert ((low > -0.05) & (low < -0.045)).all() and solver.report.certified


def test_a_reset_begins_where_the_state_is(device):
    """Also if a program has turned time back: kinematic things do not sweep the way between."""
    model = ramp(device)
    solver, end = bsc.SolverImplicit(model), model.state()
    first = positions(step(solver, model.state(), end))
    step(solver, end, model.state(), 5)
    state = model.state()
    solver.reset(state)
    np.testing.assert_array_equal(positions(step(solver, state, model.state())), first)


def test_it_cannot_be_copied_or_used_by_two_threads(device, monkeypatch):
    model = ramp(device)
    solver, state, end = bsc.SolverImplicit(model), model.state(), model.state()
    with pytest.raises(TypeError, match="a SolverImplicit cannot be copied: make a new one of the same model"):
        copy.deepcopy(solver)
    errors, predict = [], solver.solver.step

    def other():
        try:
            solver.step(state, end, None, None, DT)
        except RuntimeError as error:
            errors.append(str(error))

    def predict_meanwhile(*arguments, **options):
        patch.undo()
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        predict(*arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(solver.solver, "step", predict_meanwhile)
        solver.step(state, end, None, None, DT)
    assert errors == ["another thread is using this SolverImplicit: use one for each thread"]


def test_a_model_without_particles_is_refused(device):
    with pytest.raises(ValueError, match="model: it has neither particles nor bodies"):
        bsc.SolverImplicit(newton.ModelBuilder().finalize(device=device))


def test_a_step_whose_straight_way_has_contacts_ends_at_an_earlier_newton_step(device):
    """At the last one to which the straight way has none, here as if it had them to all but the first."""
    model = ramp(device)
    solver, end = bsc.SolverImplicit(model, max_iterations=3), model.state()
    solver.step(model.state(), end, None, None, DT)
    method, found = solver.newton_method, solver.work.status.contact_iteration
    assert solver.report.newton_steps == 3 and solver.report.certified
    path, count = method.problem.trial.path.numpy().copy(), model.particle_count
    assert np.array_equal(path[2, :count], end.particle_q.numpy())
    ends = []

    def detect():
        ends.append(end.particle_q.numpy().copy())
        found.fill_(-1 if len(ends) == 2 else 0)

    found.zero_()
    method.retreat(arrays_of(end), detect)
    np.testing.assert_array_equal(ends, path[[1, 0], :count])
    assert not np.array_equal(path[0], path[1]) and not solver.report.converged


def test_a_drape_gains_no_energy(device):
    """Where the straight way of a solve meets something, its end is not pushed out of it, which would give energy."""
    with wp.ScopedDevice(device):
        simulation = Simulation(build_scene("sphere", "vbd"), "implicit", 60)
    simulation.run(0.6, lambda step, steps: None)
    samples = simulation.samples
    assert energy_gained(np.array(samples.energy)) < 1e-3
    assert max(samples.stretch) < 0.04 and simulation.count_crossings() == 0


def test_a_kinematic_ball_at_40_metres_a_second_stretches_cloth_as_little_as_it_must(device):
    """Each step ends near its least energy: barriers hold taut cloth, and Newton steps follow on the ball's arrival."""
    for steps, least_change in ((1, 0.1), (6, 2e-3)):
        with wp.ScopedDevice(device):
            simulation = Simulation(build_scene("ball", "vbd"), "implicit", 120)
        simulation.run(steps / 120.0, lambda step, steps: None)
        report = simulation.stage.report
        assert report.arrived and report.totals.uncertified_steps == 0
        assert max(simulation.samples.stretch) < 0.12 and simulation.count_crossings() == 0
        assert report.last_change < least_change
