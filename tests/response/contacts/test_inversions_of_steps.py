"""Steps that invert tetrahedra: the stage counts them as the exact checker does, and prevents them on request."""

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import DT, SOLVERS, Changed, Rollout

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.response.state.structs import UNCONSTRAINED

CELL = 0.05
MATERIAL = {"density": 100.0, "k_mu": 1e3, "k_lambda": 1e3, "k_damp": 0.0, "particle_radius": 0.002}


def add_block(builder, at, *, n=2, velocity=(0.0, 0.0, 0.0), turn=(0.3, 0.2, 0.1)):
    """A soft block of n^3 cells, five tetrahedra each, with its corner at a place."""
    size = {"dim_x": n, "dim_y": n, "dim_z": n, "cell_x": CELL, "cell_y": CELL, "cell_z": CELL}
    rotation = wp.quat_rpy(*turn)
    builder.add_soft_grid(pos=wp.vec3(*at), rot=rotation, vel=wp.vec3(*velocity), **size, **MATERIAL)


def finalized(world, device, worlds=1):
    builder = world
    if worlds > 1:
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        builder.replicate(world, worlds)
    builder.color()
    return builder.finalize(device=device)


def shaken_model(device, worlds=1, held=False):
    """Two blocks near each other and a static box, without gravity; a layer of the first one can be held."""
    world = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    world.add_shape_box(-1, hx=0.5, hy=0.5, hz=0.05, xform=wp.transform((0.0, 0.0, -0.1), wp.quat_identity()))
    for at in ((0.0, 0.0, 0.0), (0.0, 0.0, 0.16)):
        add_block(world, at)
    for particle in range(9) if held else ():
        world.particle_mass[particle] = 0.0
    return finalized(world, device, worlds)


class Inverting(Rollout):
    """Steps a stage, and asks the exact checker which tetrahedra each step inverts, as it is stored.

    Attributes:
        inverting: Tetrahedra that the last step inverts and that were not inverted at its start.
        inverted: Tetrahedra that were inverted at its start.
    """

    def step(self, dt=DT, contacts=None):
        super().step(dt, contacts)
        tets = self.model.tet_indices.numpy().reshape(-1, 4)
        tets = tets[(self.mesh.inverse_masses.numpy()[tets] > 0.0).any(axis=1)]
        before, after = self.start[tets], self.vertices(self.states[0])[tets]
        at_start = checker.tetrahedron(np.concatenate([before, before], axis=1))
        in_step = checker.tetrahedron(np.concatenate([before, after], axis=1))
        self.inverting, self.inverted = np.count_nonzero(in_step & ~at_start), np.count_nonzero(at_start)


def shaken(seed, size, held=0):
    """A function that moves the ends of particles at random, by up to a size [m]; the next call by other vectors."""
    rng = np.random.default_rng(seed)

    def change(state):
        by = rng.uniform(-size, size, (len(state.particle_q), 3))
        by[:held] = 0.0
        state.particle_q.assign((state.particle_q.numpy() + by).astype(np.float32))

    return change


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("size", [0.04, 0.1])
def test_random_steps_are_counted_and_made_free_of_inversions(size, held, device):
    """At 0.04 m some tetrahedra invert; at 0.1 m, two cells, nearly all, and the blocks collide all over as well."""
    model = shaken_model(device, held=held)
    for seed in range(2):
        solver = bsc.SolverCCD(
            Changed(model, shaken(seed, size, 9 * held)), inversions="prevented", report=["contacts"]
        )
        rollout, cut = Inverting(model, solver), 0
        for _ in range(2):
            rollout.step()
            report = solver.report
            assert (rollout.inverting, rollout.inverted) == (0, 0) == (report.inverting, report.inverted_at_start)
            assert report.certified
            cut += report.truncated
            moved = (rollout.start != rollout.vertices(rollout.states[0])).any(axis=1)
            assert moved[: model.particle_count].any()
        assert cut > 5 and rollout.collisions == 0 and solver.report.totals.inverting_steps == 0
    with pytest.warns(UserWarning, match="inversions='prevented'"):
        solver = bsc.SolverCCD(Changed(model, shaken(3, size, 9 * held)), inversions="reported")
        rollout, counts = Inverting(model, solver), []
        for _ in range(3):
            rollout.step()
            counts.append((solver.report.inverting, solver.report.inverted_at_start))
            assert counts[-1] == (rollout.inverting, rollout.inverted)
    assert counts[0][0] > 5 and counts[-1][1] > 5
    assert solver.report.totals.inverting_steps == sum(count > 0 for count, _ in counts)
    assert f"{solver.report.totals.inverting_steps} that inverted tetrahedra" in str(solver.report)


def wall(device):
    """A block flies at a wall at 20 m/s."""
    builder = newton.ModelBuilder()
    builder.add_shape_box(-1, hx=0.5, hy=0.5, hz=0.05, xform=wp.transform((0.0, 0.0, -0.05), wp.quat_identity()))
    add_block(builder, (0.0, 0.0, 0.05), n=3, velocity=(0.0, 0.0, -20.0))
    return finalized(builder, device)


def press(device):
    """A block lies between two plates that a program moves."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for height in (-0.011, 2 * CELL + 0.011):
        body = builder.add_body(xform=wp.transform((0.0, 0.0, height), wp.quat_identity()), is_kinematic=True)
        builder.add_shape_box(body, hx=0.3, hy=0.3, hz=0.01)
    add_block(builder, (-CELL, -CELL, 0.0), turn=(0.0, 0.0, 0.2))
    return finalized(builder, device)


@pytest.mark.parametrize(("scene", "substeps"), [(wall, 1), (wall, 3), (press, 1)])
def test_a_block_that_is_thrown_or_pressed_inverts_nowhere(scene, substeps, device):
    """Without prevention it does, in whole steps against a wall."""
    seen = {}
    for inversions in ("reported", "prevented"):
        model = scene(device)
        inner = newton.solvers.SolverVBD(model, iterations=2, integrate_with_external_rigid_solver=True)
        solver = bsc.SolverCCD(inner, substeps=substeps, inversions=inversions)
        rollout, seen[inversions] = Inverting(model, solver), 0
        for i in range(5):
            if scene is press:
                state, step = rollout.states[1], 0.012 * min(i, 4)  # where VBD leaves them
                heights = np.float32([[0.0, 0.0, -0.011 + step], [0.0, 0.0, 2 * CELL + 0.011 - step]])
                state.body_q.assign(np.hstack([heights, np.float32([[0, 0, 0, 1]] * 2)]))
            rollout.step(1.0 / 60.0)
            report = solver.report
            seen[inversions] += rollout.inverting
            if substeps == 1:  # whose way is straight
                assert (report.inverting, report.inverted_at_start) == (rollout.inverting, rollout.inverted)
            assert report.certified and (inversions == "reported" or report.inverting == 0)
        assert substeps > 1 or rollout.collisions == 0  # as above
    assert seen["prevented"] == 0
    if scene is wall:
        assert seen["reported"] > 0


def test_cut_vertices_have_the_velocity_of_their_path(device):
    """The impulses that the report has are the change of momentum that follows."""
    model = shaken_model(device)
    solver = bsc.SolverCCD(Changed(model, shaken(0, 0.03)), inversions="prevented", report=["contacts"])
    rollout = Inverting(model, solver)
    rollout.step()
    count = model.particle_count
    velocities = (rollout.positions - rollout.start[:count]) / DT
    moved = solver.report.step_results.of_vertices.numpy()[:count] & int(UNCONSTRAINED) != 0
    assert 5 < np.count_nonzero(moved) < count
    np.testing.assert_allclose(rollout.velocities[moved], velocities[moved], rtol=1e-5, atol=1e-4)
    momentum = model.particle_mass.numpy()[:, None] * rollout.velocities
    np.testing.assert_allclose(solver.report.forces.particle_impulse.numpy(), momentum, rtol=1e-5, atol=1e-7)


def test_where_cuts_do_not_suffice_vertices_are_frozen(device):
    model = shaken_model(device)
    solver = bsc.SolverCCD(Changed(model, shaken(0, 0.1)), inversions="prevented")
    solver.work.status.max_divisions = 0  # so that no iteration cuts
    rollout = Inverting(model, solver)
    rollout.step()
    report = solver.report
    assert (rollout.inverting, rollout.collisions, report.inverting) == (0, 0, 0)
    assert report.certified and report.frozen > 20
    stands = (rollout.positions == rollout.start[: model.particle_count]).all(axis=1)
    assert np.count_nonzero(stands) == report.frozen and not rollout.velocities[stands].any()


def test_what_is_not_asked_for_changes_nothing(device):
    model, ends = shaken_model(device), []
    for inversions in ("allowed", "reported"):
        solver = bsc.SolverCCD(Changed(model, shaken(1, 0.02)), inversions=inversions)
        rollout = Rollout(model, solver)
        for _ in range(2):
            rollout.step()
        ends.append([rollout.positions.tobytes(), rollout.velocities.tobytes()])
    assert ends[0] == ends[1]
    solver = bsc.SolverCCD(Changed(model))
    for name in ("inverting", "inverted_at_start"):
        with pytest.raises(RuntimeError, match="inversions='reported'"):
            getattr(solver.report, name)


def test_a_step_that_inverts_nothing_is_the_same_bit_by_bit(device):
    """Looking for inversions changes nothing, and the cut begins only where there is one."""
    ends = []
    for inversions in ("allowed", "prevented"):
        model = wall(device)
        solver = bsc.SolverCCD(newton.solvers.SolverVBD(model, iterations=5), inversions=inversions)
        rollout = Inverting(model, solver)
        rollout.states[0].particle_qd.assign(np.tile(np.float32([0.0, 0.0, -1.0]), (model.particle_count, 1)))
        contacts = 0
        for _ in range(16):
            rollout.step()
            assert rollout.inverting == 0
            contacts += solver.report.predicted_contacts
        ends.append([rollout.positions.tobytes(), rollout.velocities.tobytes()])
    assert contacts > 0 and ends[0] == ends[1]


def test_what_is_inverted_at_the_start_is_left(device):
    """It is counted apart, and the others are kept from it."""
    model = shaken_model(device)
    solver = bsc.SolverCCD(Changed(model, shaken(5, 0.01)), inversions="prevented")
    rollout = Inverting(model, solver)
    start = rollout.positions
    start[13] += np.float32([0.06, 0.0, 0.0])  # the middle of the first block, into the next cell
    rollout.states[0].particle_q.assign(start)
    for _ in range(3):
        rollout.step()
        assert rollout.inverting == 0 and rollout.inverted >= 2
        assert (solver.report.inverting, solver.report.inverted_at_start) == (0, rollout.inverted)
    assert solver.report.totals.uncertified_steps == 0


def test_held_particles_that_invert_are_not_certified(device):
    """A program moves the held layer of a block past the next one, whose vertices can only stop."""
    model = shaken_model(device, held=True)
    solver = bsc.SolverCCD(Changed(model), inversions="prevented")
    rollout = Inverting(model, solver)
    start = rollout.positions
    start[:9] += (start[18:27] - start[:9]).mean(axis=0)  # by two layers
    rollout.states[0].particle_q.assign(start)
    with pytest.warns(UserWarning, match="not certified.* or invert a tetrahedron: particle"):
        rollout.step()
        assert not solver.report.certified
    report = solver.report
    tets, before = model.tet_indices.numpy().reshape(-1, 4), model.particle_q.numpy()  # the program moves in the step
    points = np.concatenate([before[tets], rollout.positions[tets]], axis=1)
    moves = (tets >= 9).any(axis=1)
    assert report.inverting == np.count_nonzero(checker.tetrahedron(points)[moves]) > 0
    assert set(range(9)) <= set(report.uncertified_vertices.tolist()) <= set(range(27))
    assert report.frozen >= 9


def test_worlds_are_alone_and_may_take_no_part(device):
    """Each world is what it is alone; of one that takes no part, nothing is counted or moved."""
    worlds = 3
    shakes = [np.random.default_rng(seed).uniform(-0.04, 0.04, (2, 54, 3)) for seed in range(worlds)]

    def run(of_worlds, masks):
        model, steps = shaken_model(device, worlds=len(of_worlds)), iter(range(2))

        def change(state):
            step = next(steps)
            by = np.concatenate([shakes[world][step] for world in of_worlds])
            state.particle_q.assign((state.particle_q.numpy() + by).astype(np.float32))

        options = {"inversions": "prevented", "report": ["worlds"], "separation": 2e-4}
        solver = bsc.SolverCCD(Changed(model, change), **options)
        start, end, ends = model.state(), model.state(), []
        for mask in masks:
            taken = None if mask is None else wp.array([*mask, True], dtype=bool, device=device)
            solver.step(start, end, None, None, DT, world_mask=taken)
            start, end = end, start
            ends.append(start.particle_q.numpy().reshape(len(of_worlds), -1, 3).copy())
            report = solver.report.worlds.numpy()
            assert report["certified"].all() and not report["inverting"].any() and not report["inverted_at_start"].any()
            assert report["truncated"].sum() == solver.report.truncated
            assert mask is None or not report["truncated"][~np.array(mask)].any()
        return ends

    together = run(range(worlds), [None, None])
    for world in range(worlds):
        alone = run([world], [None, None])
        for a, b in zip(together, alone, strict=True):
            assert a[world].tobytes() == b[0].tobytes()
    masked = run(range(worlds), [None, [True, False, True]])
    assert masked[1][1].tobytes() == masked[0][1].tobytes()
    for world in (0, 2):
        assert masked[1][world].tobytes() == together[1][world].tobytes()


def test_worlds_report_their_inversions(device):
    model = shaken_model(device, worlds=2)

    def change(state):
        x = state.particle_q.numpy()
        x[54 + 13] += np.float32([0.06, 0.0, 0.0])  # in the second world
        state.particle_q.assign(x)

    solver = bsc.SolverCCD(Changed(model, change), inversions="reported", report=["worlds"])
    rollout = Inverting(model, solver)
    rollout.step()
    assert solver.report.worlds.inverting.numpy().tolist() == [0, rollout.inverting]
    assert rollout.inverting >= 2
    rollout.step()
    assert solver.report.worlds.inverted_at_start.numpy().tolist() == [0, rollout.inverted]
    assert solver.report.worlds.certified.numpy().all()


def test_steps_in_a_graph_are_those_without():
    ends, cpu = [], wp.get_device("cpu")
    for in_graph in (True, False):
        model = wall(cpu)
        solver = bsc.SolverCCD(SOLVERS["vbd"](model), inversions="prevented")
        states = model.state(), model.state()

        def step(solver=solver, states=states):
            start, end = states
            start.clear_forces()
            solver.step(start, end, None, None, 1.0 / 60.0)
            start.assign(end)

        run = step
        if in_graph:
            with wp.ScopedCapture(cpu) as capture:  # before anything touches
                step()

            def run(graph=capture.graph):
                wp.capture_launch(graph)

        counts = []
        for _ in range(4):
            run()
            counts.append((solver.report.truncated, solver.report.inverting))
        ends.append([states[0].particle_q.numpy().tobytes(), states[0].particle_qd.numpy().tobytes(), counts])
    assert ends[0] == ends[1]
    assert any(truncated for truncated, _ in counts) and not any(inversions for _, inversions in counts)
