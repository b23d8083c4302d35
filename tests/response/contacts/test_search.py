"""Detection without queues: where they are too small and cannot grow, every contact is found all the same."""

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import DT, SOLVERS, STIFF, Rollout, bullet, crossing_sheets
from pile_energy import DT as PILE_DT
from pile_energy import pile
from sheets import crumpled
from small_queues import stage

import warp_bsc as bsc
from warp_bsc.response.contacts import proximities
from warp_bsc.response.contacts.detect import inspect
from warp_bsc.response.contacts.proximities import add_proximities
from warp_bsc.response.state.motion import arrays_of
from warp_bsc.response.state.status import Result
from warp_bsc.response.state.structs import NEVER
from warp_bsc.response.state.workspace import pairs_of


def test_static_faces_have_little_room_in_queues(device):
    """And a body that a program moves as much as cloth has."""
    builder = newton.ModelBuilder()
    builder.add_cloth_grid(
        pos=wp.vec3(), rot=wp.quat_identity(), vel=wp.vec3(), dim_x=2, dim_y=2, cell_x=0.1, cell_y=0.1, mass=0.01
    )
    builder.add_shape_box(-1, hx=0.1, hy=0.1, hz=0.1)
    builder.add_shape_box(builder.add_body(is_kinematic=True), hx=0.1, hy=0.1, hz=0.1)
    work = bsc.SolverImplicit(builder.finalize(device=device)).work
    assert pairs_of(work.mesh, work.can_move.numpy()) == 96 * (8 + 12) + 2 * 12


@pytest.mark.parametrize("speed", [10.0, 60.0])
def test_a_bullet(speed, device, monkeypatch):
    """It is stopped, every step is certified, and a second run has the same bits."""
    model = bullet(speed, device=device)
    ends = []
    for _ in range(2):
        rollout = Rollout(model, stage(model, monkeypatch, tiny=True))
        hits = 0
        for _ in range(12 if speed < 50.0 else 8):
            rollout.step()
            hits += rollout.solver.report.predicted_contacts
            assert rollout.solver.report.certified
        assert rollout.collisions == 0 and hits > 50
        assert rollout.solver.report.totals.frozen_steps == 0
        ends.append(rollout.positions.tobytes() + rollout.velocities.tobytes())
    assert ends[0] == ends[1]


def test_crossing_sheets(device, monkeypatch):
    """What crosses at the start comes apart without queues too."""
    model = crossing_sheets(3.0, device=device)
    rollout = Rollout(model, stage(model, monkeypatch, tiny=True))
    excluded = 0
    for _ in range(50):
        rollout.step()
        excluded += rollout.solver.report.excluded
        assert rollout.solver.report.certified
    assert excluded > 0 and rollout.collisions == 0
    assert not rollout.find_crossings(rollout.positions)


def crumpled_cloth(seed, device):
    """A model of a sheet before it passes through itself, and its positions after that."""
    start, end, faces = crumpled(seed, 16)
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    at = {"pos": wp.vec3(), "rot": wp.quat_identity(), "scale": 1.0, "vel": wp.vec3()}
    points = [wp.vec3(*point) for point in start.tolist()]
    builder.add_cloth_mesh(**at, vertices=points, indices=faces.ravel().tolist(), density=0.1, **STIFF)
    builder.color()
    return builder.finalize(device=device), end


@pytest.mark.parametrize("seed", range(3))
def test_contacts_are_those_of_a_detection_with_queues(seed, device, monkeypatch):
    """As many, with the same vertices at the same times."""
    model, end = crumpled_cloth(seed, device)
    found = []
    for tiny in (False, True):
        solver = stage(model, monkeypatch, tiny=tiny, max_iterations=0)  # so that first contacts are found at once
        work, motion = solver.work, solver.work.motion
        arrays = arrays_of(model)
        motion.set_start(arrays)
        arrays.particle_q = wp.array(end, dtype=wp.vec3, device=device)
        motion.set_end(arrays, DT)
        inspect(work)
        keys = work.vertices.first_contact.numpy()
        times = np.where(keys == int(NEVER), np.inf, (keys >> 32) / 2.0**30)
        numbers = [
            int(work.results[Result[name.upper()]].numpy()[0])
            for name in ("remaining", "first_hits", "excluded", "certified")
        ]
        found.append((times, numbers, work.dividing.count.numpy()[0], work.vertices.changed.numpy()))
    queued, queueless = found
    assert queued[1] == queueless[1] and queued[1][0] > 100
    assert queued[2] == queueless[2] > 0
    np.testing.assert_array_equal(queued[3], queueless[3])
    np.testing.assert_array_equal(queued[0], queueless[0])


@pytest.mark.slow
def test_proximities_of_the_hierarchy_are_those_of_trees(monkeypatch):
    """With the nearest faces found among pairs of faces, constraints are the same, and layers fall to the same ends."""
    monkeypatch.setattr("warp_bsc.response.step.proximities.add_proximities", record_proximities(found := []))
    model = pile(12)
    solvers = stage(model, monkeypatch, tiny=False), bsc.SolverCCD(SOLVERS["vbd"](model))
    control, most = model.control(), 0
    starts, ends = ([model.state() for _ in solvers] for _ in range(2))
    for _ in range(50):
        for solver, start, end in zip(solvers, starts, ends, strict=True):
            solver.step(start, end, control, None, PILE_DT)
        np.testing.assert_array_equal(*(end.particle_q.numpy() for end in ends))
        np.testing.assert_array_equal(*(end.particle_qd.numpy() for end in ends))
        assert len(found) in (0, 2) and (not found or found[0] == found[1])
        most = max(most, *(len(rows) for rows in found), 0)
        found.clear()
        for start in starts:
            start.assign(ends[0])
    assert most > 3000


def test_paths_that_overlap_too_many_others_have_no_proximities(device, monkeypatch):
    """As those of fast elements do; what such a step finds is resolved all the same."""
    monkeypatch.setattr("warp_bsc.response.step.proximities.add_proximities", record_proximities(found := []))
    model = pile(3, device=device, cells=8)
    for most in (512, 0):
        monkeypatch.setattr(proximities, "MOST_PAIRS_PER_FACE", most)
        rollout = Rollout(model, stage(model, monkeypatch, tiny=False))
        for _ in range(60):
            rollout.step(PILE_DT)
            assert rollout.solver.report.certified
        assert rollout.collisions == 0
        assert any(found) == (most > 0)
        found.clear()


def record_proximities(found):
    """Returns ``add_proximities`` such that the constraints it adds are listed, sorted, in ``found``."""

    def recorded(work, **options):
        add_proximities(work, **options)
        first, last = (int(count.numpy()[0]) for count in (work.kept, work.constraints.count))
        names = "vertices", "normal", "separation", "kind"
        columns = [getattr(work.constraints, name).numpy()[first:last].tolist() for name in names]
        found.append(sorted(map(str, zip(*columns, strict=True))))

    return recorded


@pytest.mark.gpu
def test_a_graph_captured_before_anything_touches(device, monkeypatch):
    """Its queues hold four pairs of faces, and yet each of its replays is certified."""
    if not wp.is_conditional_graph_supported():
        pytest.skip("needs conditional nodes")
    model = bullet(60.0, device=device)
    rollout = Rollout(model, stage(model, monkeypatch, tiny=True))
    start, end = rollout.states
    rollout.step()  # loads kernels
    rollout.states = start, end = model.state(), model.state()
    with wp.ScopedCapture(device) as capture:
        start.clear_forces()
        rollout.solver.step(start, end, rollout.control, None, DT)
    hits = 0
    for _ in range(12):
        before = rollout.vertices(start)
        wp.capture_launch(capture.graph)
        assert not rollout.find_collisions(before, rollout.vertices(end))
        assert rollout.solver.report.certified
        hits += rollout.solver.report.predicted_contacts
        wp.copy(start.particle_q, end.particle_q)
        wp.copy(start.particle_qd, end.particle_qd)
    assert hits > 100
