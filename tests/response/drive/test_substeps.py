"""Substeps: a number of smaller steps, each with its contacts, of which the report hides nothing."""

import contextlib
import warnings

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import DT, SOLVERS, STIFF, Changed, Rollout, add_patch, add_plates, bullet, place_plates

import warp_bsc as bsc

NUMBER = 4


class Pair:
    """Steps of a stage in substeps, and as many steps of another stage that are as long as those."""

    def __init__(self, make, **options):
        options |= {"report": ["contacts", "worlds"]}
        self.together, self.apart = (bsc.SolverCCD(make(), **options, **more) for more in ({"substeps": NUMBER}, {}))
        self.model = self.together.model
        self.states, self.others = ([self.model.state() for _ in range(2)] for _ in range(2))

    def step(self, dt=DT):
        """Takes a step; returns a list of what the reports of the smaller steps say, by name."""
        for solver, states in ((self.together, self.states), (self.apart, self.others)):
            steps = 1 if solver is self.together else NUMBER
            said = []
            for _ in range(steps):
                solver.step(*states, None, None, dt / steps)
                states.reverse()
                said.append(read(solver.report))
            if solver is self.together:
                (whole,) = said
        for name in ("particle_q", "particle_qd"):
            found, expected = (getattr(states[0], name).numpy() for states in (self.states, self.others))
            assert found.tobytes() == expected.tobytes(), name
        return whole, said


NUMBERS = "predicted_contacts", "remaining", "excluded", "filtered", "iterations", "body_contacts"
LISTS = "uncertified_vertices", "uncertified_bodies"


def read(report):
    """What a report says of a step."""
    said = {
        name: getattr(report, name) for name in ("certified", "strain", "crossings", "not_finite", *NUMBERS, *LISTS)
    }
    said |= {f"worlds.{name}": values.copy() for name, values in report.worlds.numpy().items()}
    said |= {
        name: getattr(report.forces, name).numpy().copy() for name in ("particle_impulse", "unpaired_particle_impulse")
    }
    return said | {
        "contacts": report.forces.contacts.numpy(),
        "bits": report.outcomes.find(0xFFFF),
        "cut": report.truncated,
    }


def check(whole, said):
    """Checks that the report of a step in substeps is that of all of them."""
    assert whole["certified"] == all(part["certified"] for part in said)
    assert whole["worlds.certified"].tolist() == np.all([part["worlds.certified"] for part in said], axis=0).tolist()
    for name in NUMBERS:
        assert whole[name] == sum(part[name] for part in said), name
    for name in ("predicted_contacts", "remaining", "filtered"):
        expected = np.sum([part[f"worlds.{name}"] for part in said], axis=0)
        assert whole[f"worlds.{name}"].tolist() == expected.tolist(), name
    for name in ("strain", "crossings", "worlds.strain", "worlds.crossings", "worlds.max_impulse"):
        np.testing.assert_array_equal(whole[name], np.max([part[name] for part in said], axis=0), name)
    for name in LISTS:
        assert set(whole[name]) == set().union(*(part[name] for part in said)), name
    assert whole["bits"].tolist() == np.any([part["bits"] for part in said], axis=0).tolist()
    for name in ("particle_impulse", "unpaired_particle_impulse"):
        expected = np.sum([part[name] for part in said], axis=0)
        np.testing.assert_allclose(whole[name], expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max(), err_msg=name)
    times = [(i + part["contacts"]["toi"]) / NUMBER for i, part in enumerate(said)]
    np.testing.assert_allclose(np.sort(whole["contacts"]["toi"]), np.sort(np.concatenate(times)), atol=1e-6)


@pytest.mark.filterwarnings("ignore:a step")
@pytest.mark.parametrize("inner", ["vbd", "xpbd"])
def test_a_step_is_that_many_smaller_ones_and_its_report_is_of_all(inner, device):
    model, hits = bullet(60.0, device=device, worlds=2), 0
    if inner == "xpbd" and device.is_cuda:
        pytest.skip("XPBD adds up in any order on a GPU")
    pair = Pair(lambda: SOLVERS[inner](model))
    for _ in range(4):
        whole, said = pair.step()
        check(whole, said)
        hits += whole["predicted_contacts"] > max(part["predicted_contacts"] for part in said)
    assert hits and pair.together.report.totals.steps == 4


@pytest.mark.filterwarnings("ignore:a step")
def test_a_substep_that_is_not_certified_is_not_hidden(device):
    """Plates leave no space in the second of four substeps; the last is certified."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_plates(builder, 0.05)
    model, calls = builder.finalize(device=device), []

    def squeeze(state):
        place_plates(state, -0.02 if len(calls) % NUMBER == 1 else 0.05)
        calls.append(0)

    pair = Pair(lambda: Changed(model, squeeze), max_iterations=0)
    whole, said = pair.step()
    check(whole, said)
    assert [part["certified"] for part in said][-1] and not whole["certified"] and whole["remaining"] > 0
    assert len(whole["uncertified_vertices"])
    totals = pair.together.report.totals
    assert (totals.steps, totals.uncertified_steps, totals.penetrated_steps) == (1, 1, 1)
    assert totals.remaining == whole["remaining"] and pair.together.report.penetrated
    whole, said = pair.step()  # the next step begins anew


def test_a_drape_in_substeps_stretches_less(device):
    """As in steps that are as short."""
    builder = newton.ModelBuilder()
    builder.add_shape_sphere(body=-1, radius=0.15)
    add_patch(builder, 10, 0.05, (0.0, 0.0, 0.16))
    builder.color()
    model, strains = builder.finalize(device=device), []
    for substeps in (1, 8):
        rollout = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), friction=0.5, substeps=substeps))
        strains.append(0.0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for _ in range(12):
                rollout.step(1.0 / 60.0)
                strains[-1] = max(strains[-1], rollout.solver.report.strain)
        assert rollout.solver.report.totals.uncertified_steps == 0
    assert strains[1] < 0.3 * strains[0]


def seen_by(inner_type, log):
    """A solver that notes where the first body, and the first particle, are at both ends of its steps."""

    class Seen(inner_type):
        def step(self, state_in, state_out, *arguments, **options):
            start = state_in.body_q.numpy()[0].copy(), state_in.particle_q.numpy()[0].copy()
            super().step(state_in, state_out, *arguments, **options)
            log.append((*start, state_out.body_q.numpy()[0].copy(), state_out.particle_q.numpy()[0].copy()))

    return Seen


def plate_and_patch(device):
    """A kinematic plate below a free patch, the first particle of which is kinematic."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_body(is_kinematic=True)
    builder.add_shape_box(body, hx=0.2, hy=0.2, hz=0.05)
    add_patch(builder, 4, 0.05, (0.0, 0.0, 0.051))
    builder.particle_mass[0] = 0.0
    builder.color()
    return builder.finalize(device=device)


@pytest.mark.parametrize("external", [False, True])
def test_what_a_program_moves_goes_a_share_of_its_way_in_each_substep(external, device):
    """It ends where the program puts it, turned evenly, by whichever state the inner solver reads."""
    model, log = plate_and_patch(device), []
    options = {"iterations": 3, "integrate_with_external_rigid_solver": external}
    solver = bsc.SolverCCD(seen_by(newton.solvers.SolverVBD, log)(model, **options), substeps=NUMBER)
    states, shift = [model.state(), model.state()], np.float32([0.0, 0.0, 0.004])
    for k in range(1, 4):
        states[0].clear_forces()
        half = 0.5 * 0.08 * k
        pose = np.float32([0.0, 0.0, 0.004 * k, 0.0, 0.0, np.sin(half), np.cos(half)])
        states[1 if external else 0].body_q.assign(pose[None])
        x = states[0].particle_q.numpy()
        x[0] += shift
        states[0].particle_q.assign(x)
        given = x[0].copy()
        solver.step(*states, None, None, DT)
        states.reverse()
        assert solver.report.certified
        np.testing.assert_array_equal(states[0].body_q.numpy()[0], pose)
        np.testing.assert_array_equal(states[0].particle_q.numpy()[0], given)
        ends = np.array([row[2] for row in log[-NUMBER:]])
        shares = np.arange(1, NUMBER + 1) / NUMBER
        np.testing.assert_allclose(ends[:, 2], 0.004 * (k - 1 + shares), atol=1e-7)
        np.testing.assert_allclose(2.0 * np.arctan2(ends[:, 5], ends[:, 6]), 0.08 * (k - 1 + shares), atol=1e-6)
        np.testing.assert_allclose([row[3][2] for row in log[-NUMBER:]], given[2] - 0.004 * (1 - shares), atol=1e-7)
    first = states[0].particle_q.numpy()
    solver.reset(states[0])  # the next step starts where its state is
    states[0].body_q.assign(np.float32([[0.0, 0.0, -0.1, 0.0, 0.0, 0.0, 1.0]]))
    states[1].body_q.assign(states[0].body_q)
    solver.step(*states, None, None, DT)
    np.testing.assert_allclose([row[2][2] for row in log[-NUMBER:]], -0.1, atol=1e-7)
    assert len(first) == model.particle_count


def test_a_moving_plate_carries_cloth_along(device):
    """A kinematic plate that rises at 20 m/s^2 does not throw it ahead."""
    model = plate_and_patch(device)
    inner = newton.solvers.SolverVBD(model, iterations=5, integrate_with_external_rigid_solver=True)
    solver = bsc.SolverCCD(inner, restitution=0.0, substeps=NUMBER)
    model.particle_inv_mass.assign(np.full(model.particle_count, 1e3, dtype=np.float32))
    solver.notify_model_changed(newton.ModelFlags.MODEL_PROPERTIES)
    start, end = model.state(), model.state()
    heights = 0.5 * 20.0 * (DT * np.arange(1, 13)) ** 2
    for height in heights:
        start.clear_forces()
        end.body_q.assign(np.float32([[0.0, 0.0, height, 0.0, 0.0, 0.0, 1.0]]))
        solver.step(start, end, model.control(), None, DT)
        assert solver.report.certified
        start, end = end, start
    above = start.particle_q.numpy()[1:, 2] - (0.05 + heights[-1])
    assert above.min() > 0.0 and above.max() < 0.002
    assert np.allclose(start.particle_qd.numpy()[1:, 2], 20.0 * 12 * DT, rtol=0.1)


def test_the_state_at_the_start_may_be_that_at_the_end(device):
    model = bullet(30.0, device=device)
    apart = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), substeps=3))
    state, solver = model.state(), bsc.SolverCCD(SOLVERS["vbd"](model), substeps=3)
    for _ in range(6):
        apart.step()
        state.clear_forces()
        solver.step(state, state, apart.control, None, DT)
    assert state.particle_q.numpy().tobytes() == apart.positions.tobytes()


def test_forces_of_the_program_act_in_all_substeps(device):
    """A patch on frictionless ground is pushed: it accelerates as force over mass."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=0.0))
    add_patch(builder, 4, 0.05, (0.0, 0.0, 0.001))
    builder.color()
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(SOLVERS["vbd"](model), friction=0.0, substeps=NUMBER)
    start, end = model.state(), model.state()
    for _ in range(24):
        start.particle_f.assign(model.particle_mass.numpy()[:, None] * np.float32([2.0, 0.0, 0.0]))
        solver.step(start, end, model.control(), None, DT)
        start, end = end, start
    velocity = start.particle_qd.numpy().mean(axis=0)
    assert np.allclose(velocity[0], 2.0 * 24 * DT, rtol=1e-3)
    assert abs(velocity[2]) < 9.81 * DT  # it falls within the separation


@pytest.mark.filterwarnings("ignore:a step strained")
def test_substeps_in_a_graph_are_those_without(device):
    if device.is_cuda and not wp.is_conditional_graph_supported():
        pytest.skip("needs conditional nodes")
    model, ends = bullet(30.0, device=device), []
    for in_graph in (True, False):
        solver = bsc.SolverCCD(SOLVERS["vbd"](model), substeps=3, report=["contacts", "worlds"])
        states = model.state(), model.state()

        def frame(solver=solver, states=states):
            for start, end in (states, states[::-1]):
                start.clear_forces()
                solver.step(start, end, None, None, DT)

        with wp.ScopedCapture(device) if in_graph else contextlib.nullcontext() as capture:
            frame()
        for _ in range(3 if in_graph else 2):
            wp.capture_launch(capture.graph) if in_graph else frame()
        said = read(solver.report)
        numbers = [said[name] for name in (*NUMBERS, "certified", "strain")] + [solver.report.totals]
        ends.append([numbers, states[0].particle_q.numpy().tobytes(), said["particle_impulse"].tobytes()])
    assert ends[0] == ends[1] and ends[0][0][-1].steps == 6 and ends[0][0][0] > 0


def test_contacts_of_the_program_go_to_the_inner_solver_as_they_are(device):
    model, seen = bullet(1.0, device=device), []

    class Seen(Changed):
        def step(self, state_in, state_out, control, contacts, dt, **options):
            seen.append(contacts)
            super().step(state_in, state_out, control, contacts, dt, **options)

    contacts = newton.CollisionPipeline(model).contacts()
    bsc.SolverCCD(Seen(model), substeps=2).step(model.state(), model.state(), None, contacts, DT)
    assert [given is contacts for given in seen] == [True, True]


def test_a_coupled_solver_takes_no_substeps_of_the_stage(device):
    model = bullet(1.0, device=device)
    solver = bsc.SolverCCD(SOLVERS["vbd"](model), substeps=2)
    with pytest.raises(NotImplementedError, match=r"substeps=2 .*SolverCoupled\.Entry"):
        solver.coupling_notify_iteration_restarts(False)


@pytest.mark.slow
def test_friction_holds_and_slides_in_substeps(device):
    """Cloth on a ramp slides as a rigid body would, without friction and with it."""
    angle, time = np.radians(20.0), 0.25
    tilt = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), float(angle))
    up, down = np.array([np.sin(angle), 0.0, np.cos(angle)]), np.array([np.cos(angle), 0.0, -np.sin(angle)])
    for friction in (0.0, 0.2, 0.6):
        builder = newton.ModelBuilder()
        material = newton.ModelBuilder.ShapeConfig(mu=friction)
        builder.add_shape_box(-1, xform=wp.transform(wp.vec3(), tilt), hx=2.0, hy=1.0, hz=0.1, cfg=material)
        cells = {"dim_x": 4, "dim_y": 4, "cell_x": 0.04, "cell_y": 0.04, "mass": 0.001}
        builder.add_cloth_grid(pos=wp.vec3(*(0.1003 * up - down)), rot=tilt, vel=wp.vec3(), **cells, **STIFF)
        builder.color()
        model = builder.finalize(device=device)
        rollout = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), friction=friction, substeps=NUMBER))
        start = rollout.positions.mean(axis=0)
        for _ in range(round(time / DT)):
            rollout.step()
        slid = (rollout.positions.mean(axis=0) - start) @ down
        expected = 0.5 * 9.81 * max(0.0, np.sin(angle) - friction * np.cos(angle)) * time**2
        assert abs(slid - expected) < 0.03 * expected + 1.5e-3
