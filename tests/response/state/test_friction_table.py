"""Friction by pair of materials: each pair slides as its coefficient says, in graphs, and on tapes."""

import itertools

import newton
import numpy as np
import pytest
import warp as wp
from body_scenes import add_body, free
from body_scenes import finalize as finalize_bodies
from newton_scenes import DT, SOLVERS, add_patch
from style3d_scenes import drape

import warp_bsc as bsc

GRAVITY, ANGLE = 9.81, 0.5
PAIRS = [(0, 2), (1, 2), (0, 3), (1, 3), (0, 4), (1, 4), (5, 2), (6, 2)]
"""Materials of what slides, and of the box, the plane and the sheet on which it does: cloths 0 and 1, boxes 5 and 6."""
FRICTION = np.array([0.1, 0.4, 0.15, 0.45, 0.2, 0.35, 0.25, 0.3], dtype=np.float32)


def table_of(friction):
    """Coefficients of the pairs, as a table of all materials in which others have none."""
    table = np.full((7, 7), -1.0, dtype=np.float32)
    for (a, b), value in zip(PAIRS, friction, strict=True):
        table[a, b] = table[b, a] = value
    return table


def ramps(device):
    """Ramps that are tilted about the y axis: a box, a plane and a held sheet; two cloths and two boxes slide down."""
    builder = newton.ModelBuilder(gravity=(GRAVITY * np.sin(ANGLE), 0.0, -GRAVITY * np.cos(ANGLE)))
    at = wp.transform(wp.vec3(0.0, 0.0, -0.1), wp.quat_identity())
    builder.add_shape_box(-1, hx=1.0, hy=2.0, hz=0.1, xform=at)
    builder.add_shape_plane(-1, xform=wp.transform(wp.vec3(0.0, 0.0, -1.0), wp.quat_identity()), width=0.0, length=0.0)
    for y, height in ((0.0, 0.0), (4.0, -1.0), (-4.0, 0.5)):
        for side in (-0.2, 0.2):
            add_patch(builder, 2, 0.05, (0.0, y + side, height + 0.0005), velocity=(0.5, 0.0, 0.0))
    material = np.tile(np.repeat([0, 1], 9), 3)
    first = builder.particle_count
    add_patch(builder, 4, 0.4, (0.0, -4.0, 0.5))
    for i in range(first, builder.particle_count):
        builder.particle_mass[i] = 0.0
    material = np.concatenate([material, np.full(builder.particle_count - first, 4)])
    box = {"hx": 0.1, "hy": 0.1, "hz": 0.01, "inertia": (4e-3, 4e-3, 7e-3)}
    for y in (-1.0, 1.0):
        add_body(builder, "box", (0.0, y, 0.0102), **box)
    model = finalize_bodies(builder, 2 * [[0.5, 0.0, 0.0, 0.0, 0.0, 0.0]], device)
    return model, material


def speeds(state):
    """Speeds downhill, of each cloth and box."""
    of_cloths = state.particle_qd.numpy()[:54, 0].reshape(6, 9).mean(axis=1)
    return np.concatenate([of_cloths, state.body_qd.numpy()[:, 0]]).astype(float)


def test_each_pair_slides_by_its_friction_and_a_graph_reads_the_table_again(device):
    model, material = ramps(device)
    table = wp.array(table_of(FRICTION), dtype=float, device=device)
    materials = {"particle_material": material, "shape_material": [2, 3, 5, 6]}
    solver = bsc.SolverCCD(
        free(model),
        friction=bsc.FrictionTable(table, particle_mu=0.2, **materials),
        bodies="separated",
    )
    states, control = [model.state(), model.state()], model.control()

    def step_twice():
        for start, end in (states, states[::-1]):
            start.clear_forces()
            solver.step(start, end, control, None, DT)

    def friction_of(pairs):
        """Mean ratio of friction to normal force in pairs of steps."""
        before = speeds(states[0])
        for _ in range(pairs):
            wp.capture_launch(capture.graph)
        gained = (speeds(states[0]) - before) / (2 * pairs * DT)
        assert solver.report.certified
        return (GRAVITY * np.sin(ANGLE) - gained) / (GRAVITY * np.cos(ANGLE))

    step_twice()
    with wp.ScopedCapture(device) as capture:
        step_twice()
    friction_of(4)  # until they lie on the ramps
    np.testing.assert_allclose(friction_of(10), FRICTION, rtol=0.02)
    table.assign(table_of(0.5 - FRICTION))
    np.testing.assert_allclose(friction_of(10), 0.5 - FRICTION, rtol=0.02)
    table.fill_(-1.0)
    of_shapes = model.shape_material_mu.numpy()
    means = np.sqrt([*np.repeat(0.2 * of_shapes[:2], 2), 0.2 * 0.2, 0.2 * 0.2, *(of_shapes[0] * of_shapes[2:])])
    np.testing.assert_allclose(friction_of(10), means, rtol=0.02)
    assert solver.report.totals.uncertified_steps == 0


def falling(device, mu, requires_grad=False):
    """Cloth that falls askew on a plane, a box and a held sheet, whose shapes have a coefficient of friction."""
    builder = newton.ModelBuilder()
    builder.default_shape_cfg.mu = mu
    builder.add_ground_plane()
    builder.add_shape_box(-1, hx=0.1, hy=0.1, hz=0.05, xform=wp.transform(wp.vec3(1.0, 0.0, 0.05), wp.quat_identity()))
    for x, height in ((0.0, 0.0), (1.0, 0.1), (2.0, 0.1)):
        add_patch(builder, 2, 0.05, (x, 0.0, height + 0.005), velocity=(1.0, 0.5, -2.0))
    first = builder.particle_count
    add_patch(builder, 2, 0.2, (2.0, 0.0, 0.1))
    for i in range(first, builder.particle_count):
        builder.particle_mass[i] = 0.0
    builder.color()
    return builder.finalize(device=device, requires_grad=requires_grad)


@pytest.mark.parametrize("inner", ["vbd", "style3d"])
def test_a_table_of_one_coefficient_is_that_coefficient(inner, device):
    """Bit for bit, as its geometric mean with itself is itself."""
    if inner == "style3d" and device.is_cuda:
        pytest.skip(
            "on a GPU Style3D adds up forces in any order, which the first contact magnifies as much as friction"
        )
    ends = []
    for mu, friction in ((0.25, 0.25), (0.0, bsc.FrictionTable([[0.25]], particle_mu=0.0)), (0.0, 0.0)):
        model = drape(device, cells=6) if inner == "style3d" else falling(device, mu)
        model.shape_material_mu.fill_(mu)
        options = {"friction": friction}
        if inner == "style3d":
            solver = newton.solvers.SolverStyle3D(model)
            solver.collision = None  # its own contacts, which need those of Newton
        else:
            solver = SOLVERS["vbd"](model)
        solver, states = bsc.SolverCCD(solver, **options), [model.state(), model.state()]
        for _ in range(10):
            solver.step(*states, model.control(), None, 1.0 / 60.0 if inner == "style3d" else DT)
            states.reverse()
        ends.append([states[0].particle_q.numpy(), states[0].particle_qd.numpy()])
    np.testing.assert_array_equal(ends[0], ends[1])
    apart = np.abs(ends[0][1] - ends[2][1]).max(axis=1)
    if inner == "style3d":
        assert apart.max() > 0.01
    else:
        assert (apart[:27].reshape(3, 9).max(axis=1) > 0.1).all()


def test_gradients_reach_the_table(device):
    """That of one material is the sum of those of the coefficients of all sides, whose geometric mean it stands for."""
    gradients = []
    for mu in (0.25, 0.0):
        model = falling(device, mu, requires_grad=True)
        numbers = {"dtype": float, "device": device, "requires_grad": True}
        friction, table = wp.array([mu], **numbers), wp.array([[0.25]], **numbers)
        given = bsc.FrictionTable(table, particle_mu=friction) if mu == 0.0 else friction
        solver, states = bsc.SolverImplicit(model, friction=given), [model.state() for _ in range(5)]
        with wp.Tape() as tape:
            for start, end in itertools.pairwise(states):
                solver.step(start, end, None, None, 1e-3)
        states[-1].particle_q.grad.fill_(wp.vec3(1.0, -2.0, 0.5))
        tape.backward()
        assert solver.report.totals.uncertified_steps == 0
        sides = friction.grad.numpy().sum() + model.shape_material_mu.grad.numpy().sum()
        gradients.append((sides, float(table.grad.numpy()[0, 0])))
        tape.zero()
        assert table.grad.numpy()[0, 0] == 0.0
    (of_sides, none), (of_none, of_table) = gradients
    assert none == of_none == 0.0 and abs(of_sides) > 1e-3
    assert of_table == pytest.approx(of_sides, rel=1e-4)
