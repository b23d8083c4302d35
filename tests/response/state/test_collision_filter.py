"""Filters of a stage by particle and shape: what they leave out is not pushed, is counted, and is not certified."""

import functools

import newton
import numpy as np
import pytest
import warp as wp
from body_scenes import add_body, boxes, free
from body_scenes import finalize as finalize_bodies
from filtered_models import judge
from newton_scenes import DT, SOLVERS, Changed, Rollout, add_patch, bullet
from small_queues import stage

import warp_bsc as bsc
from warp_bsc.response.state.mesh import ModelMesh

ITSELF = bsc.CollisionFilter(particle_group=2, particle_mask=1)
"""Cloth does not collide with cloth."""


def finalized(builder, device):
    builder.color()
    model = builder.finalize(device=device)
    model.particle_mu = 0.5
    return model


@pytest.fixture(autouse=True)
def on_cpu(device):
    if device.is_cuda:
        pytest.skip("random models are judged on the CPU")


@pytest.mark.parametrize("options", [{}, {"min_distance": 0.004}], ids=["touching", "distance"])
@pytest.mark.parametrize("seed", [1, 9])
def test_random_models(seed, options):
    result = judge(seed, **options)
    assert result.failures == []
    assert result.hits > 10 and result.filtered > 100 and result.passed > 10 and result.moved > 10


@pytest.mark.parametrize("seed", [1, 9])
def test_random_models_without_queues(seed, monkeypatch):
    def without_queues(inner, **options):
        return stage(inner.model, monkeypatch, tiny=True, inner=inner, **options)

    result = judge(seed, without_queues)
    assert result.failures == [] and result.hits > 10 and result.passed > 10


@pytest.mark.parametrize("bits", [None, {"particle_mask": 0}], ids=["no filter", "everything filtered"])
def test_the_judge_notices_another_filter(bits):
    """Without the filter, filtered pairs are pushed; where everything is filtered, others collide."""

    def wrong(inner, *, collision_filter, **options):
        return bsc.SolverCCD(inner, collision_filter=bits and bsc.CollisionFilter(**bits), **options)

    assert judge(1, wrong).failures


def test_filtered_cloth_passes_bit_for_bit(device):
    model = bullet(10.0, device=device)
    ends = []
    for make in (lambda inner: inner, lambda inner: bsc.SolverCCD(inner, collision_filter=ITSELF)):
        solver, states = make(SOLVERS["vbd"](model)), [model.state(), model.state()]
        for _ in range(6):
            solver.step(*states, model.control(), None, DT)
            states.reverse()
        ends.append(states[0].particle_q.numpy().tobytes() + states[0].particle_qd.numpy().tobytes())
    assert ends[0] == ends[1]
    assert solver.report.certified and solver.report.filtered > 100 and solver.report.crossings == 0
    assert "filtered pairs" in str(solver.report)
    assert len(solver.report.intersections) == 0


def test_a_monitor_does_not_watch_filtered_pairs(device):
    model = bullet(60.0, device=device)
    hits = []
    for collision_filter in (None, ITSELF):
        monitor = bsc.CollisionMonitor(Changed(model), collision_filter=collision_filter)
        states = [model.state(), model.state()]
        hits.append(0)
        for _ in range(2):
            monitor.step(*states, None, None, DT)
            states.reverse()
            hits[-1] += monitor.report.predicted_contacts
        assert (monitor.report.filtered > 0) == (collision_filter is not None)
    assert hits[0] > 10 and hits[1] == 0


def test_filtered_solids_hold_nothing(device):
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    builder.add_shape_box(-1, xform=wp.transform((1.0, 0.0, 0.1), wp.quat_identity()), hx=0.1, hy=0.1, hz=0.1)
    for at in ((0.0, 0.0, -0.1), (1.0, 0.0, 0.1)):
        add_patch(builder, 2, 0.02, at)
    model = finalized(builder, device)
    for shape_mask, shapes in ((-1, {0, 1}), ([0, -1], {1}), ([-1, 0], {0})):
        solver = bsc.SolverCCD(Changed(model), collision_filter=bsc.CollisionFilter(shape_mask=shape_mask))
        solver.step(model.state(), model.state(), None, None, 1e-4)
        assert set(solver.report.inside.shapes.tolist()) == shapes
        # particles in the ground; no pair of cloth and box is near, and those of static shapes do not count
        assert solver.report.filtered == (0 if 0 in shapes else 9)


@pytest.mark.parametrize("pairs", [False, True], ids=["together", "filtered"])
def test_newtons_pairs_of_shapes(pairs, device):
    """Shapes that ``shape_collision_filter_pairs`` has pass each other, counted; others are kept apart."""
    positions, velocities = [(-0.25, 0.01, 0.02), (0.0, 0.0, 0.0)], [(0, 0, 0), (-3.0, 0, 0)]
    model = boxes(device, positions=positions, velocities=velocities, filtered=[(0, 1)] if pairs else [])
    rollout, filtered = Rollout(model, bsc.SolverCCD(free(model), bodies="separated")), 0
    for _ in range(8):
        rollout.step()
        filtered += rollout.solver.report.filtered
        assert rollout.solver.report.certified
    assert (filtered > 0) == pairs
    assert (rollout.states[0].body_q.numpy()[1, 0] < -0.09) == pairs


@pytest.mark.parametrize("bodies", ["separated", "pushed"])
def test_shapes_that_only_shapes_meet(bodies, device):
    """A static box that collides with shapes alone stops a box where the stage separates bodies, and never cloth."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    config = newton.ModelBuilder.ShapeConfig(has_particle_collision=False)
    for x in (0.0, 1.0):
        at = wp.transform((x, 0.0, 0.0), wp.quat_identity())
        builder.add_shape_box(-1, xform=at, hx=0.1, hy=0.1, hz=0.1, cfg=config)
    add_body(builder, "box", (0.013, 0.017, 0.19), hx=0.07, hy=0.07, hz=0.07)
    add_patch(builder, 4, 0.04, (1.0, 0.0, 0.12), velocity=(0.0, 0.0, -3.0))
    model = finalize_bodies(builder, [[0.0, 0.0, -3.0, 0.0, 0.0, 0.0]], device)
    solver = bsc.SolverCCD(free(model), bodies=bodies)
    states, filtered = [model.state(), model.state()], 0
    for _ in range(8):
        solver.step(*states, None, None, DT)
        states.reverse()
        filtered += solver.report.filtered
        assert solver.report.certified and len(solver.report.inside) == 0
    assert (states[0].body_q.numpy()[0, 2] > 0.169) == (bodies == "separated") == (filtered > 0)
    np.testing.assert_allclose(states[0].particle_q.numpy()[:, 2], 0.12 - 8 * DT * 3.0, atol=1e-5)
    many = bsc.CollisionFilter(particle_group=2**17 - 1)
    if bodies == "separated":
        with pytest.raises(ValueError, match="collision_filter must have at most 16 groups, not 17: shape 0"):
            bsc.SolverCCD(free(model), bodies=bodies, collision_filter=many)


def test_sixteen_groups_beside_shapes_that_only_shapes_meet(device):
    """Their bits are numbered anew; what meets is the same."""
    builder = newton.ModelBuilder()
    for flags in (True, True, False):
        config = newton.ModelBuilder.ShapeConfig(has_particle_collision=flags)
        builder.add_shape_box(builder.add_body(), cfg=config, hx=0.1, hy=0.1, hz=0.1)
    add_patch(builder, 3, 0.1, (0.0, 0.0, 1.0))
    model, rng = finalized(builder, device), np.random.default_rng(0)
    groups = 1 << (2 * rng.integers(0, 16, 19))
    masks = rng.integers(0, 2**32, 19) & rng.integers(0, 2**32, 19)
    names = "particle_group", "particle_mask", "shape_group", "shape_mask"
    bits = dict(zip(names, (groups[:16], masks[:16], groups[16:], masks[16:]), strict=True))
    mesh = ModelMesh(model, collision_filter=bsc.CollisionFilter(**bits), separates_bodies=True)
    rows = np.concatenate([np.arange(16), 16 + np.flatnonzero(np.diff(mesh.shape_vertices.shape, prepend=-1))])
    assert len(rows) == 19
    group, mask = mesh.group[rows], mesh.mask[rows]
    found = ((group[:, None] & mask) != 0) & ((mask[:, None] & group) != 0)
    expected = ((groups[:, None] & masks) != 0) & ((masks[:, None] & groups) != 0)
    expected[18, :16] = expected[:16, 18] = False
    np.testing.assert_array_equal(found, expected)
    assert 0 < expected.sum() < expected.size


@pytest.mark.parametrize("radius", [None, 0.0])
def test_the_thickness_of_the_model(radius, device):
    """Radii of particles and margins of shapes and planes, or given radii beside the margins."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    margin = newton.ModelBuilder.ShapeConfig(margin=0.02)
    builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(margin=0.03))
    at = wp.transform((1.0, 0.0, 0.1), wp.quat_identity())
    builder.add_shape_box(-1, xform=at, hx=0.1, hy=0.1, hz=0.1, cfg=margin)
    for at in ((0.0, 0.0, 0.06), (1.0, 0.0, 0.26)):
        add_patch(builder, 2, 0.04, at, velocity=(0.0, 0.0, -4.0))  # with radii of 5 mm
    model = finalized(builder, device)
    rollout = Rollout(model, bsc.SolverCCD(Changed(model), min_distance="model", particle_radius=radius))
    for _ in range(4):
        rollout.step()
        assert rollout.solver.report.certified
    heights = rollout.states[0].particle_q.numpy()[:, 2].reshape(2, 9)
    kept = np.array([0.03, 0.22]) + (0.005 if radius is None else 0.0)
    assert (heights.min(axis=1) > kept).all() and (heights.max(axis=1) < kept + 0.002).all()


def test_margins_must_be_distances(device):
    model = bullet(1.0, device=device)
    model.particle_radius.fill_(-1.0)
    with pytest.raises(ValueError, match=r"min_distance='model': model.particle_radius\[0\] must be finite"):
        bsc.SolverCCD(Changed(model), min_distance="model")


def test_filters_that_do_not_fit_are_refused(device):
    model = bullet(1.0, device=device)
    make = functools.partial(bsc.SolverCCD, Changed(model))
    with pytest.raises(ValueError, match=r"collision_filter.particle_group must be one integer or have shape \(370,\)"):
        make(collision_filter=bsc.CollisionFilter(particle_group=[1, 2]))
    with pytest.raises(TypeError, match="collision_filter must be a CollisionFilter"):
        make(collision_filter={"particle_group": 1})
