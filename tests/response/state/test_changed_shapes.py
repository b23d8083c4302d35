"""Shapes that a program changes at run time: the stage follows them, as a stage of the changed model would."""

import newton
import numpy as np
import pytest
import warp as wp
from newton import ModelFlags
from newton_scenes import DT, SOLVERS, Changed, Rollout, add_patch
from test_model_mesh import SHAPES, pose

import warp_bsc as bsc
from warp_bsc.response.state.mesh import ModelMesh

SHAPES_CHANGED = ModelFlags.SHAPE_PROPERTIES


def change(model, **arrays):
    """Assigns arrays of the shapes of a model, with the rows that are given by number."""
    for name, rows in arrays.items():
        array = getattr(model, f"shape_{name}")
        values = array.numpy()
        for shape, row in rows.items():
            values[shape] = row
        array.assign(values)


def follow(mesh):
    """Lets a mesh follow the shapes of its model; returns the shape that it does not follow, counted from 1."""
    not_followed = wp.zeros(1, dtype=wp.int64, device=mesh.device)
    mesh.follow_shapes(not_followed)
    return int(not_followed.numpy()[0])


def all_shapes(device):
    """Every kind of shape, on a body and in all of two worlds, then three planes."""
    world = newton.ModelBuilder()
    body = world.add_body()
    for kind, options, *_ in SHAPES.values():
        getattr(world, f"add_shape_{kind}")(body, **options)
    world.add_shape_plane(width=1.0, length=2.0, body=body)
    builder = newton.ModelBuilder()
    builder.replicate(world, 2)
    builder.add_ground_plane(height=0.3)
    builder.add_shape_sphere(-1, radius=0.2)
    return builder.finalize(device=device)


def test_a_mesh_follows_poses_and_scales_bit_by_bit(device):
    """It is then that of the changed model, but for a barrel, whose scale stays."""
    model = all_shapes(device)
    mesh = ModelMesh(model)
    barrel = list(SHAPES).index("barrel")
    rng, count = np.random.default_rng(3), model.shape_count
    scale = model.shape_scale.numpy().copy()
    before = mesh.device_shape_vertices.position.numpy().copy()
    assert follow(mesh) == 0
    np.testing.assert_array_equal(mesh.device_shape_vertices.position.numpy(), before)
    turns = rng.normal(size=(count, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    model.shape_transform.assign(np.column_stack([rng.normal(size=(count, 3)), turns]).astype(np.float32))
    changed = scale * rng.uniform(0.5, 2.0, size=scale.shape).astype(np.float32)
    changed[scale == 0.0] = 0.0
    is_barrel = np.isin(np.arange(count), [barrel, barrel + count // 2 - 1])
    changed[is_barrel] = scale[is_barrel]
    model.shape_scale.assign(changed)
    assert follow(mesh) == 0
    fresh = ModelMesh(model)
    for found, expected in ((mesh.device_shape_vertices, fresh.shape_vertices), (mesh.device_planes, fresh.planes)):
        for array, values in zip(found, expected, strict=True):
            np.testing.assert_array_equal(array.numpy(), values)
    assert np.abs(fresh.shape_vertices.position - before).max(axis=1).min() > 1e-3
    with pytest.raises(ValueError, match="the model had"):
        model.shape_type, short = model.shape_type[:-1], model.shape_type
        follow(mesh)
    model.shape_type = short


def test_what_is_not_followed_is_named(device):
    """A shape then collides as it was, at its new pose."""
    changes = {
        "barrel": {"scale": (0.3, 0.3, 0.3)},
        "capsule": {"scale": (0.2, 0.0, 0.0)},
        "capsule without height": {"scale": (0.2, 0.1, 0.0)},
        "box": {"type": newton.GeoType.SPHERE},
        "sphere": {"flags": 0},
        "mesh": {"source_ptr": 1},
        "cone": {"body": 1},
    }
    for name, arrays in changes.items():
        model = all_shapes(device)
        mesh, shape = ModelMesh(model), list(SHAPES).index(name)
        before = mesh.device_shape_vertices.position.numpy().copy()
        change(model, transform={shape: pose(0.0, 0.0, 1.0)}, **{array: {shape: v} for array, v in arrays.items()})
        assert follow(mesh) == shape + 1, name
        moved = np.where((mesh.shape_vertices.shape == shape)[:, None], (0.0, 0.0, 1.0), 0.0)
        np.testing.assert_allclose(mesh.device_shape_vertices.position.numpy(), before + moved, atol=1e-6)
    model = all_shapes(device)
    mesh, plane = ModelMesh(model), len(SHAPES)
    change(model, scale={plane: (0.0, 0.0, 0.0)})
    assert follow(mesh) == plane + 1


def test_the_stage_warns_once_of_a_shape_that_it_does_not_follow(device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 2, 0.04, (0.0, 0.0, 0.0))
    builder.add_shape_box(-1, xform=pose(0.0, 0.0, -1.0), hx=0.1, hy=0.1, hz=0.1, label="table")
    model = builder.finalize(device=device)
    stage = bsc.SolverCCD(Changed(model), min_distance="model")
    states = model.state(), model.state()
    change(model, margin={0: 0.01})
    with pytest.warns(UserWarning, match=r"shape 0 \('table'\) has changed .*margin"):
        stage.notify_model_changed(SHAPES_CHANGED)
        stage.step(*states, None, None, DT)
        stage.step(*states, None, None, DT)
        assert stage.report.totals.steps == 2
    stage.notify_model_changed(SHAPES_CHANGED)
    stage.step(*states, None, None, DT)


def sheets_over_balls(device, radius, at=(0.0, 0.0, -0.05)):
    """In each of two worlds a sheet that falls on a ball."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for r in radius:
        builder.begin_world(gravity=(0.0, 0.0, 0.0))
        add_patch(builder, 8, 0.03, (0.003, 0.001, 0.02), velocity=(0.0, 0.0, -1.5))
        builder.add_shape_sphere(-1, xform=pose(*at), radius=r)
        builder.end_world()
    builder.color()
    return builder.finalize(device=device)


@pytest.mark.parametrize("graph", [None, "before", "within"])
def test_steps_after_a_change_are_those_of_a_stage_of_the_changed_model(graph, device):
    """Bit by bit, in the world whose ball grew and in the one whose ball stayed; also in a graph captured before."""
    expected = Rollout(sheets_over_balls(device, (0.02, 0.06)), None)
    expected.solver = bsc.SolverCCD(Changed(expected.model))  # as in graphs of a GPU behind Changed
    model = sheets_over_balls(device, (0.02, 0.02))
    stage, states = bsc.SolverCCD(Changed(model)), (model.state(), model.state())

    def step():
        if graph == "within":
            stage.notify_model_changed(SHAPES_CHANGED)
        for start, end in (states, states[::-1]):
            stage.step(start, end, None, None, DT)

    if graph is not None:
        with wp.ScopedCapture(device) as capture:
            step()
    change(model, scale={1: (0.06, 0.0, 0.0)})
    if graph != "within":
        stage.notify_model_changed(SHAPES_CHANGED)
    for _ in range(5):
        step() if graph is None else wp.capture_launch(capture.graph)
        expected.step()
        expected.step()
        assert states[0].particle_q.numpy().tobytes() == expected.positions.tobytes()
        assert states[0].particle_qd.numpy().tobytes() == expected.velocities.tobytes()
    assert expected.collisions == 0 and expected.solver.report.predicted_contacts > 0
    assert not expected.find_crossings(expected.vertices(states[0]))
    totals = stage.report.totals
    assert (totals.steps, totals.uncertified_steps, totals.crossing_steps) == (10, 0, 0)


def test_a_change_is_a_jump_that_nothing_sweeps(device):
    """What a ball holds or crosses after it is what the report counts at the start of the next step."""
    model = sheets_over_balls(device, (0.02, 0.02))
    rollout = Rollout(model, None)
    rollout.solver = stage = bsc.SolverCCD(Changed(model))
    start = rollout.states[0]
    start.particle_qd.zero_()
    rollout.step()
    change(model, transform={0: pose(0.0, 0.0, 0.2), 1: pose(0.0, 0.0, 0.01)})
    stage.notify_model_changed(SHAPES_CHANGED)
    before = rollout.positions
    rollout.states[0].particle_qd.zero_()
    with pytest.warns(UserWarning, match="edges pass through faces"):
        rollout.step()
        report = stage.report
        assert (report.certified, report.predicted_contacts) == (True, 0)
    np.testing.assert_array_equal(rollout.positions, before)
    rollout.mesh = ModelMesh(model)
    assert report.crossings == len(rollout.find_crossings(rollout.vertices(rollout.states[0]))) > 10
    distance = np.linalg.norm(before[81:] - (0.0, 0.0, 0.01), axis=1)
    np.testing.assert_array_equal(report.inside.particles, 81 + np.flatnonzero(distance < 0.0195))
    assert (report.inside.shapes == 1).all() and len(report.inside) > 0


def test_a_body_that_moves_while_its_shape_changes_is_swept_with_the_new_shape(device):
    """From where the last step left it, bit by bit as a ball that was large from the start."""
    ends = []
    for radius in (0.01, 0.05):
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        add_patch(builder, 8, 0.03, (0.003, 0.001, 0.0))
        ball = builder.add_body(xform=pose(0.0, 0.0, 0.1), is_kinematic=True)
        builder.add_shape_sphere(ball, radius=radius)
        model = builder.finalize(device=device)
        rollout = Rollout(model, bsc.SolverCCD(Changed(model)))
        rollout.step()
        change(model, scale={0: (0.05, 0.0, 0.0)})
        rollout.solver.notify_model_changed(SHAPES_CHANGED)
        rollout.states[0].body_q.assign([pose(0.0, 0.0, -0.1, (1.0, 0.0, 0.0), 1.0)])
        report = rollout.solver.report
        with pytest.warns(UserWarning, match="strained"):
            rollout.step()
            assert report.strain > 0.2
        assert report.certified and report.predicted_contacts > 10 and report.crossings == 0
        ends.append(rollout.positions)
    np.testing.assert_array_equal(*ends)
    assert np.linalg.norm(ends[0] - (0.0, 0.0, -0.1), axis=1).min() > 0.0495


def test_the_monitor_follows(device):
    model = sheets_over_balls(device, (0.02, 0.02))
    stage, states = bsc.CollisionMonitor(Changed(model)), (model.state(), model.state())
    change(model, transform={1: pose(0.0, 0.0, 0.0)})
    stage.notify_model_changed(SHAPES_CHANGED)
    expected = Rollout(model, None)
    stage.step(*states, None, None, DT)
    found = expected.find_collisions(expected.vertices(states[0]), expected.vertices(states[1]))
    assert stage.report.predicted_contacts == len(found) > 0
    assert all(vertex >= 81 and vertex not in range(162, 162 + 418) for pair in found for vertex in pair)


@pytest.mark.parametrize("replaced", [False, True])
def test_a_block_slides_once_friction_is_gone(replaced, device):
    """As gravity along the slope has it, where the coefficient held it before."""
    angle, steps = 0.3, 24
    tilt = pose(0.0, 0.0, 0.0, (0.0, 1.0, 0.0), angle)
    builder = newton.ModelBuilder()
    builder.add_shape_plane(xform=tilt, width=0.0, length=0.0, cfg=newton.ModelBuilder.ShapeConfig(mu=1.0))
    corner = wp.transform_point(tilt, wp.vec3(-0.02, -0.02, 1e-4))
    options = {"dim_x": 2, "dim_y": 2, "cell_x": 0.02, "cell_y": 0.02, "mass": 1e-3, "tri_ke": 1e3, "tri_ka": 1e3}
    builder.add_cloth_grid(pos=corner, rot=wp.transform_get_rotation(tilt), vel=wp.vec3(), **options)
    builder.color()
    model = builder.finalize(device=device)
    model.particle_mu = 1.0
    rollout = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model)))
    down = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    speeds = []
    for _ in range(2):
        for _ in range(steps):
            rollout.step()
        speeds.append((rollout.velocities @ down).mean())
        mu = np.zeros(1, dtype=np.float32)
        if replaced:
            model.shape_material_mu = wp.array(mu, dtype=float, device=device)
        else:
            model.shape_material_mu.assign(mu)
        rollout.solver.notify_model_changed(SHAPES_CHANGED)
    assert abs(speeds[0]) < 1e-3
    assert speeds[1] == pytest.approx(9.81 * np.sin(angle) * steps * DT, rel=0.01)
