"""Bodies that turn within a step: nothing passes through their arcs, whatever their chords miss."""

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import SOLVERS, STIFF, Changed, add_patch
from sample_sizes import cases
from scipy.spatial.transform import Rotation
from small_queues import stage as hierarchy_stage

import warp_bsc as bsc
from warp_bsc.response.state import motion as motion_module

DT = 1.0 / 60.0
STAGES = {
    "monitor": (bsc.CollisionMonitor, {}),
    "whole steps": (bsc.SolverCCD, {}),
    "substeps": (bsc.SolverCCD, {"substeps": 4}),
    "default": (bsc.SolverCCD, {}),
    "distance": (bsc.SolverCCD, {"min_distance": 0.002}),
    "monitored distance": (bsc.CollisionMonitor, {"min_distance": 0.002}),
}
each_stage = pytest.mark.parametrize(("make", "options"), STAGES.values(), ids=STAGES)


def about_z(angle):
    """The quaternion of a turn about z."""
    return [0.0, 0.0, np.sin(0.5 * angle), np.cos(0.5 * angle)]


def set_pose(state, position, rotation, body=0):
    poses = state.body_q.numpy()
    poses[body] = [*position, *rotation]
    state.body_q.assign(poses)


def blade_and_strip(device, *, kinematic=True, at=0.9, first=0.0, has_wall=False):
    """A blade of 1 m along x, and a strip of cloth across the circle of its tip, an eighth of a turn ahead.

    All is turned about z by a ``first`` angle.

    The origin is the centre of mass of a blade that can be moved, and the hinge of one that the program moves.
    """
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    corner = wp.vec3(at * np.sqrt(0.5), at * np.sqrt(0.5), -0.05)
    upright = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.5 * np.pi)
    grid = {"dim_x": 2, "dim_y": 4, "cell_x": 0.02, "cell_y": 0.025, "mass": 1e-3}
    turn = wp.quat(*about_z(first))
    builder.add_cloth_grid(pos=wp.quat_rotate(turn, corner), rot=turn * upright, vel=wp.vec3(), **grid)
    weight = {} if kinematic else {"mass": 1.0, "inertia": wp.mat33(np.eye(3)), "lock_inertia": True}
    body = builder.add_body(xform=wp.transform(wp.vec3(), turn), is_kinematic=kinematic, **weight)
    beside = wp.transform(wp.vec3(0.5, 0.0, 0.0), wp.quat_identity())
    config = newton.ModelBuilder.ShapeConfig(density=1000.0 if kinematic else 0.0)
    builder.add_shape_box(body, xform=beside, hx=0.5, hy=0.01, hz=0.02, cfg=config)
    if has_wall:  # right behind the strip, on the way of the blade
        middle = wp.transform(wp.vec3(0.4, 0.85, 0.0), wp.quat_identity())
        builder.add_shape_box(-1, xform=middle, hx=0.5, hy=0.2, hz=3.0)
    builder.color()
    return builder.finalize(device=device)


def turned(angle, position=(0.0, 0.0, 0.0)):
    """A solver that turns the first body about z."""
    return lambda state: set_pose(state, position, about_z(angle))


def step_once(solver, model):
    """Steps once from the model's state; returns the report and both states."""
    start, end = model.state(), model.state()
    solver.step(start, end, None, None, DT)
    return solver.report, start, end


@each_stage
def test_a_blade_meets_what_its_chords_miss(make, options, device):
    model = blade_and_strip(device)
    solver = make(Changed(model, turned(0.5 * np.pi)), **options)
    report, start, end = step_once(solver, model)
    ends = [wp.empty(solver.mesh.vertex_count, dtype=wp.vec3, device=device) for _ in range(2)]
    after = model.state()
    turned(0.5 * np.pi)(after)
    for state, x in zip((start, after), ends, strict=True):
        solver.mesh.positions(start.particle_q, state.body_q, x)
    assert bsc.CollisionDetector(solver.mesh).detect(*ends).earliest_toi == 2.0  # the chords
    assert report.predicted_contacts > 20
    moved = np.abs(end.particle_q.numpy() - start.particle_q.numpy()).max()
    if make is bsc.CollisionMonitor:
        assert not report.certified and report.remaining == report.predicted_contacts and moved == 0.0
        assert len(report.uncertified_vertices) > 0 and report.uncertified_bodies.tolist() == [0]
    else:
        assert report.certified and moved > 0.05
        solver.mesh.positions(end.particle_q, end.body_q, ends[1])
        assert crossings_on_arcs(solver.mesh, *ends, 0.5 * np.pi) == 0


def test_a_blade_turns_from_where_its_world_last_took_part(device):
    """A program turns it before a step in which its world takes no part."""
    model = blade_and_strip(device)
    solver, (start, end, last) = bsc.SolverCCD(Changed(model)), [model.state() for _ in range(3)]
    turned(0.5 * np.pi)(start)
    solver.step(start, end, None, None, DT, world_mask=wp.zeros(2, dtype=bool, device=device))
    solver.step(end, last, None, None, DT)
    assert solver.report.predicted_contacts > 20 and solver.report.certified


@pytest.mark.parametrize("options", [{}, {"min_distance": 0.002}], ids=["touch", "distance"])
@pytest.mark.parametrize("broad_phase", ["simd", "hierarchy"])
def test_boxes_reach_as_far_as_arcs(broad_phase, options, device, monkeypatch):
    """The tip passes through the strip beyond the boxes around its positions at both ends."""
    model = blade_and_strip(device, first=-0.25 * np.pi)
    inner = Changed(model, turned(0.25 * np.pi))
    if broad_phase == "simd":
        monitor = bsc.CollisionMonitor(inner, **options)
    else:
        monitor = hierarchy_stage(model, monkeypatch, make=bsc.CollisionMonitor, tiny=False, inner=inner, **options)
    assert step_once(monitor, model)[0].remaining > 20


def crossings_on_arcs(mesh, x0, x1, angle, samples=24):
    """Edges that pass through faces at times of a step in which all shapes turn about z, computed with a sine."""
    finder, count = bsc.CollisionDetector(mesh), mesh.model.particle_count
    x0, x1 = (x.numpy().astype(np.float64) for x in (x0, x1))
    found = 0
    for time in np.arange(1, samples + 1) / samples:
        x = (1.0 - time) * x0 + time * x1
        sine, cosine = np.sin(time * angle), np.cos(time * angle)
        x[count:] = x0[count:] @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        edges, faces = finder.find_intersections(x).T
        found += np.count_nonzero((mesh.edges[edges, 0] < count) | (mesh.faces[faces, 0] < count))
    return found


@pytest.mark.parametrize("options", [{}, {"min_distance": 0.002}], ids=["touch", "distance"])
@pytest.mark.parametrize("tiny", [False, True], ids=["queues", "no queues"])
def test_the_search_of_a_gpu_finds_them_too(tiny, options, device, monkeypatch):
    """With the broad phase of a GPU, and with queues that are too small and cannot grow."""
    model = blade_and_strip(device)
    plain = step_once(bsc.CollisionMonitor(Changed(model, turned(1.0)), **options), model)[0]
    options = {"inner": Changed(model, turned(1.0)), "tiny": tiny, **options}
    monitor = hierarchy_stage(model, monkeypatch, make=bsc.CollisionMonitor, **options)
    report = step_once(monitor, model)[0]
    assert report.remaining == plain.remaining > 0 and not report.certified
    solver = hierarchy_stage(model, monkeypatch, **options)
    report, start, end = step_once(solver, model)
    ends = [wp.empty(solver.mesh.vertex_count, dtype=wp.vec3, device=device) for _ in range(2)]
    for state, x in zip((start, end), ends, strict=True):
        solver.mesh.positions(state.particle_q, state.body_q, x)
    solver.mesh.positions(start.particle_q, model.body_q, ends[0])
    assert report.certified and crossings_on_arcs(solver.mesh, *ends, 1.0) == 0


def test_a_propeller_throws_a_cloth(device):
    """Five turns a second at 60 Hz: each step is certified, and samples of all steps are free."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_body(xform=wp.transform_identity(), is_kinematic=True)
    for side in (-1.0, 1.0):
        tilted = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.5 * side)
        place = wp.transform(wp.vec3(0.15 * side, 0.0, 0.0), tilted)
        builder.add_shape_box(body, xform=place, hx=0.13, hy=0.02, hz=0.004)
    upright = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.5 * np.pi)
    grid = {"dim_x": 6, "dim_y": 6, "cell_x": 0.06, "cell_y": 0.06, "mass": 0.001, **STIFF}
    builder.add_cloth_grid(pos=wp.vec3(-0.18, 0.12, -0.18), rot=upright, vel=wp.vec3(), **grid)
    builder.color()
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(SOLVERS["vbd"](model))
    states, ends, angle = [model.state(), model.state()], [], np.pi / 6.0
    ends = [wp.empty(solver.mesh.vertex_count, dtype=wp.vec3, device=device) for _ in range(2)]
    hits = 0
    for number in range(12):
        solver.mesh.positions(states[0].particle_q, states[0].body_q, ends[0])
        set_pose(states[0], (0.0, 0.0, 0.0), about_z(number * angle))  # between steps, as programs do
        solver.step(*states, None, None, DT)
        solver.mesh.positions(states[1].particle_q, states[1].body_q, ends[1])
        assert solver.report.certified and solver.report.crossings == 0
        assert crossings_on_arcs(solver.mesh, *ends, angle if number else 0.0) == 0
        hits += solver.report.predicted_contacts
        states.reverse()
    assert hits > 200
    assert np.linalg.norm(states[0].particle_qd.numpy(), axis=1).max() > 2.0


@pytest.mark.parametrize(
    "options", [pytest.param({}, marks=pytest.mark.slow), {"min_distance": 0.003}], ids=["touch", "distance"]
)
def test_random_bars_push_a_cloth_off_their_arcs(options, device):
    """Turns of up to 150 degrees about any axis, of bars that the program moves and of dynamic ones."""
    with_contacts = 0
    for seed in range(10 + cases(30)):
        rng = np.random.default_rng(seed)
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        rotation = rng.standard_normal(4)
        pose = {"pos": wp.vec3(*rng.uniform(-0.5, 0.5, 3)), "rot": wp.quat(*rotation / np.linalg.norm(rotation))}
        grid = {"dim_x": 6, "dim_y": 6, "cell_x": 0.12, "cell_y": 0.12, "mass": 0.001}
        builder.add_cloth_grid(**pose, **grid, vel=wp.vec3(*rng.uniform(-3.0, 3.0, 3)))
        body = builder.add_body(xform=wp.transform_identity(), is_kinematic=bool(rng.integers(2)))
        beside = wp.transform(wp.vec3(0.4, 0.0, 0.0), wp.quat_identity())
        builder.add_shape_box(body, xform=beside, hx=0.4, hy=0.02, hz=0.05)
        builder.color()
        model = builder.finalize(device=device)
        turn = rng.standard_normal(3)
        turn *= np.radians(rng.uniform(5.0, 150.0)) / np.linalg.norm(turn)
        end_of_bar = rng.uniform(-0.05, 0.05, 3), Rotation.from_rotvec(turn).as_quat()
        solver = bsc.SolverCCD(Changed(model, lambda state, pose=end_of_bar: set_pose(state, *pose)), **options)
        finder, count = bsc.CollisionDetector(solver.mesh), model.particle_count
        x = np.concatenate([model.particle_q.numpy(), solver.mesh.shape_vertices.position]).astype(np.float64)
        if len(finder.find_intersections(x)):
            continue
        report, _start, end = step_once(solver, model)
        assert report.certified, seed
        with_contacts += report.predicted_contacts > 0
        start_x, end_x = x.copy(), x.copy()
        end_x[:count] = end.particle_q.numpy()
        place, quaternion = end.body_q.numpy()[0, :3], end.body_q.numpy()[0, 3:]
        end_x[count:] = Rotation.from_quat(quaternion).apply(x[count:]) + place
        arcs = solver.work.arcs
        motion = bsc.RigidMotion(arcs.body.numpy(), arcs.centre.numpy(), arcs.turn.numpy())
        np.testing.assert_allclose(motion.turn[0], Rotation.from_quat(quaternion).as_rotvec(), atol=1e-6)
        for time in np.linspace(0.0, 1.0, 17):
            assert len(finder.find_intersections(motion.positions(start_x, end_x, time))) == 0, (seed, time)
    assert with_contacts >= cases(5)


def test_a_dynamic_blade_is_stopped(device):
    """A strip that is held stops a blade that can be moved, before it on its arc."""
    model = blade_and_strip(device, kinematic=False)
    model.particle_inv_mass.zero_()
    model.particle_mass.zero_()
    solver = bsc.SolverCCD(Changed(model, turned(0.5 * np.pi)))
    report, _start, end = step_once(solver, model)
    assert report.predicted_contacts > 0 and report.certified
    np.testing.assert_array_equal(end.particle_q.numpy(), model.particle_q.numpy())
    place, turn = end.body_q.numpy()[0, :3], Rotation.from_quat(end.body_q.numpy()[0, 3:]).as_rotvec()
    count, finder = model.particle_count, bsc.CollisionDetector(solver.mesh)
    x = np.concatenate([model.particle_q.numpy(), solver.mesh.shape_vertices.position]).astype(np.float64)
    at_start = x[count:].copy()
    for time in np.linspace(0.0, 1.0, 33):  # its centre of mass, the origin, moves straight
        x[count:] = Rotation.from_rotvec(time * turn).apply(at_start) + time * place
        assert len(finder.find_intersections(x)) == 0, time


def test_a_strip_without_a_way_out_is_reported(device):
    """A blade that the program moves through a strip and a wall behind it: the step says that it lacks both."""
    model = blade_and_strip(device, has_wall=True)
    solver = bsc.SolverCCD(Changed(model, turned(0.5 * np.pi)))
    with pytest.warns(UserWarning, match="not certified.*shape"):
        report, *_ = step_once(solver, model)
        assert not report.certified and report.remaining > 0
    assert len(report.uncertified_vertices) > 0 and report.uncertified_bodies.tolist() == [0]


def test_bodies_that_do_not_turn_give_the_same_bits(device, monkeypatch):
    """A blade that moves sideways through the strip, and one that falls on it, as without all this."""
    ends = []
    for watches in (True, False):
        if not watches:
            monkeypatch.setattr(motion_module, "BodyTurns", lambda *_: None)
        for kinematic in (True, False):
            for options in ({}, {"min_distance": 0.002}):
                model = blade_and_strip(device, kinematic=kinematic)
                solver = bsc.SolverCCD(
                    Changed(model, lambda state: set_pose(state, (0, 1.2, 0), about_z(0.0))), **options
                )
                report, _start, end = step_once(solver, model)
                assert report.predicted_contacts > 0
                ends.append([end.particle_q.numpy().tobytes(), end.body_q.numpy().tobytes(), report.predicted_contacts])
    assert ends[:4] == ends[4:]


def test_a_hinge_is_where_it_turns(device):
    """A paddle whose centre of mass is far from its hinge, between the steps of a program: a post on its way is met."""
    for at, hits in ((0.95, True), (1.05, False)):
        model = blade_and_strip(device, at=at)
        report, *_ = step_once(bsc.CollisionMonitor(Changed(model, turned(np.pi / 2))), model)
        assert (report.predicted_contacts > 0) == hits, at


@pytest.mark.parametrize("distance", [0.0, 0.001])
def test_a_disc_that_spins_on_a_sheet_is_at_rest_as_by_its_chords(distance, device, monkeypatch):
    """Two micrometres above what it must keep, over a sheet: arcs bring no contact or push of their own."""
    ends = []
    for watches in (True, False):
        if not watches:
            monkeypatch.setattr(motion_module, "BodyTurns", lambda *_: None)
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        add_patch(builder, 4, 0.1, (0.0, 0.0, 0.0), fixed=True)
        place = [0.01, 0.02, 0.02 + distance + 2e-6]
        body = builder.add_body(xform=wp.transform(wp.vec3(*place), wp.quat_identity()))
        builder.add_shape_cylinder(body, radius=0.1, half_height=0.02)
        builder.color()
        model = builder.finalize(device=device)
        options = {"min_distance": distance} if distance else {}
        solver = bsc.SolverCCD(Changed(model), bodies="separated", **options)
        states = [model.state(), model.state()]
        for number in range(6):
            solver.solver.change = turned(0.2 * (number + 1), place)
            solver.step(*states, None, None, DT)
            assert solver.report.certified and solver.report.predicted_contacts == 0
            states.reverse()
            if not distance:
                np.testing.assert_array_equal(states[0].body_q.numpy()[0, :3], np.float32(place))
        ends.append(np.concatenate([states[0].particle_q.numpy(), states[0].body_q.numpy()[:, :3]]))
    np.testing.assert_allclose(*ends, atol=1e-7)
    assert distance or (ends[0][:-1] == model.particle_q.numpy()).all()
