"""The matrix of a step against differences of its forces, and linear solves with it against dense ones in NumPy."""

import functools

import newton
import numpy as np
import pytest
import warp as wp
from gradient_scenes import DT, OF_PARTICLES, add_cloth, marks_of
from step_forces import forces_of

import warp_bsc as bsc
from warp_bsc.implicit.contact.rows import make_rows
from warp_bsc.implicit.gradients.contact_forces import RecordedContacts, contact_forces, contact_jacobians
from warp_bsc.implicit.gradients.elements import Elements
from warp_bsc.implicit.gradients.linear import LinearSolver
from warp_bsc.implicit.gradients.step_gradients import StartArrays
from warp_bsc.kernels.polynomials import VERTEX_FACE
from warp_bsc.response.state.motion import arrays_of

TOLERANCE = 1e-9


class System:
    """The equations of a step, at positions that are moved at random from its end, and a right-hand side."""

    def __init__(self, model, solver, states, scale):
        rng, n = np.random.default_rng(5), model.particle_count
        start, end = states
        solver.step(start, end, None, None, DT)
        self.equations = solver.gradients.equations
        step = solver.gradients.record(
            solver.gradients.add_step(wp.Tape())[0], DT, StartArrays.of(start), arrays_of(end)
        ).step
        self.contacts = int((step.contacts.kind.numpy() >= 0).sum())
        x = step.x1.numpy().copy()
        x[:n] += scale * rng.normal(size=(n, 3)) * (solver.mesh.inverse_masses.numpy()[:n] > 0.0)[:, None]
        step.x1.assign(x)
        self.step, self.of_worlds = step, solver.newton_method.problem.unknowns.of_worlds
        free = step.is_fixed.numpy() == 0
        self.free = np.repeat(free, 3)
        self.b = wp.array(rng.normal(size=(len(free), 3)) * free[:, None], dtype=wp.vec3d, device=model.device)

    def dense(self):
        """The matrix, by central differences of the forces."""
        step, equations = self.step, self.equations
        unknown, x, h = equations.unknown.numpy(), step.x1.numpy().copy(), 1e-8
        matrix = np.eye(3 * equations.count)
        for p, c in zip(*np.nonzero(self.free.reshape(-1, 3)[unknown]), strict=True):
            forces = []
            for sign in (1.0, -1.0):
                moved = x.copy()
                moved[p, c] += sign * h
                step.x1.assign(moved)
                equations.load(step)
                forces.append(forces_of(equations).ravel())
            matrix[:, 3 * unknown[p] + c] = (forces[1] - forces[0]) / (2.0 * h)
        step.x1.assign(x)
        return matrix

    def solve(self, *, transposed=False, max_iterations=2000, b=None):
        """The solution, and the solver."""
        equations = self.equations
        solver = LinearSolver(self.of_worlds, tolerance=TOLERANCE, max_iterations=max_iterations)
        equations.load(self.step)
        matrix = equations.differentiate(transposed=transposed)
        return solver.solve(matrix, self.b if b is None else b).numpy(), solver


def in_contact(scene, device):
    """The second step of a scene."""
    program = scene(device)
    states = program.begin(program.inputs)[:2]
    program.write(states[0], program.inputs, 0)
    program.solver.step(*states, None, None, DT)
    program.write(states[1], program.inputs, 1)
    return System(program.model, program.solver, states[::-1], 2e-5)


def hanging(scale, device, worlds=1):
    """A cloth in each world that one side holds, moved so far from the end of a step."""
    builder = newton.ModelBuilder()
    for world in range(worlds):
        each = newton.ModelBuilder()
        add_cloth(each, (0.0, 0.0, 1.0), fix_left=True, cell=0.05 + 0.01 * world)
        builder.add_world(each)
    builder.color()
    model = builder.finalize(device=device, requires_grad=True)
    return System(model, bsc.SolverImplicit(model), [model.state(), model.state()], scale)


SYSTEMS = {
    "hanging": functools.partial(hanging, 2e-4),
    "compressed": functools.partial(hanging, 1e-2),
    "worlds": functools.partial(hanging, 2e-4, worlds=3),
    **{scene.__name__: functools.partial(in_contact, scene) for scene in OF_PARTICLES[1:]},
}
"""Systems by name; that of a sphere has more contacts than is fast."""
MARKS = {scene.__name__: marks_of(scene) for scene in OF_PARTICLES}


@pytest.mark.parametrize("name", [pytest.param(name, marks=MARKS.get(name, [])) for name in SYSTEMS])
def test_solutions_are_those_of_dense_solves(name, device):
    system = SYSTEMS[name](device)
    matrix, b, is_symmetric = system.dense(), system.b.numpy().ravel(), name not in MARKS
    assert (system.contacts == 0) == is_symmetric
    scale = np.abs(matrix).max()
    assert (np.abs(matrix - matrix.T).max() < 1e-6 * scale) == is_symmetric
    if is_symmetric:
        assert (np.linalg.eigvalsh(matrix).min() < -1.0) == (name == "compressed")
    for transposed in (False, True):
        x, solver = system.solve(transposed=transposed)
        assert not solver.failed.numpy().any()
        expected = np.linalg.solve(matrix.T if transposed else matrix, b)
        np.testing.assert_allclose(x.ravel(), expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["cloth_on_sheet", "cloth_on_body"])
def test_jacobians_of_contacts_are_those_of_adjoints(name, device):
    """Pairs at random, of all places of closest points, and edges that are nearly parallel."""
    system, rng, count = SYSTEMS[name](device), np.random.default_rng(3), 4000
    step = system.step
    reach = step.settings.reach.numpy()
    small = float(reach[np.isfinite(reach)].min())
    x1 = 20.0 * small * rng.normal(size=(count, 4, 3))
    kind = rng.integers(2, size=count)  # vertex and face, or edges
    place, across = rng.uniform(-0.2, 1.2, size=(count, 2)), small * rng.uniform(0.05, 1.0, size=count)
    place[::4] = place[::4].clip(0.02, 0.45)
    u, v = x1[:, 1] - x1[:, 0], x1[:, 3] - x1[:, 2]
    near = rng.random(count) < 0.3
    v[near] = u[near] + 0.02 * v[near]
    faces = kind == VERTEX_FACE
    u[faces], v[faces] = (x1[:, 2] - x1[:, 1])[faces], (x1[:, 3] - x1[:, 1])[faces]
    normal = np.cross(u, v)
    off = across[:, None] * normal / np.linalg.norm(normal, axis=1, keepdims=True)
    x1[faces, 0] = (x1[:, 1] + place[:, :1] * u + place[:, 1:] * v + off)[faces]
    first = (x1[:, 0] + place[:, :1] * u + off)[~faces] - place[~faces, 1:] * v[~faces]
    x1[~faces, 2], x1[~faces, 3] = first, first + v[~faces]
    x0 = x1 + 0.3 * small * rng.normal(size=x1.shape)
    corners = rng.choice(np.flatnonzero(step.motion.inverse_mass.numpy() > 0.0), size=(count, 4))

    def array(values, dtype):
        return wp.array(values, dtype=dtype, device=device)

    contacts = RecordedContacts()
    contacts.kind, contacts.plane = array(kind, int), array(np.zeros(count), int)
    contacts.fall = step.contacts.fall
    parameters = [array(corners, int), contacts, step.motion, step.planes, step.settings]
    vertices = array(np.arange(4 * count).reshape(-1, 4), int)

    def jacobians(kernel):
        elements = Elements(contact_forces, vertices, vertices, jacobians=kernel)
        elements.parameters = parameters
        elements.load(array(x1.reshape(-1, 3), wp.vec3d), array(x0.reshape(-1, 3), wp.vec3d))
        elements.differentiate(DT)
        return elements.jacobian.numpy()

    found, expected = jacobians(contact_jacobians), jacobians(None)
    size = np.abs(expected).max(axis=(1, 2, 3))
    assert (size[faces] > 0.0).sum() > 300
    assert (size[~faces] > 0.0).sum() > 300
    worst = np.abs(found - expected).max(axis=(1, 2, 3)) / np.maximum(size, 1e-300)
    assert worst.max() < 1e-6


def test_each_world_fails_for_itself(device):
    system = SYSTEMS["worlds"](device)
    b, first, second = system.b.numpy(), *system.of_worlds.numpy()[1:3]
    alone, _ = system.solve()
    alone = alone.copy()
    b[first:second] = 0.0
    b[second:] = np.nan
    x, solver = system.solve(b=wp.array(b, dtype=wp.vec3d, device=device))
    np.testing.assert_array_equal(solver.failed.numpy(), [0, 0, 1])
    np.testing.assert_allclose(x[:first], alone[:first], rtol=1e-9, atol=1e-12)
    assert not x[first:second].any()
    assert np.isnan(x[second:]).all()


@pytest.mark.parametrize("name", ["hanging", "cloth_on_edge"])
def test_iterations_are_limited(name, device):
    x, solver = SYSTEMS[name](device).solve(max_iterations=3)
    assert solver.failed.numpy().all()
    assert np.isnan(x).all()


def test_rows_of_many_unknowns_are_those_of_few(device):
    """Of springs in a ring of more unknowns than have a product that fits into 32 bits."""
    count, springs = 50_000, [np.zeros((0, n), dtype=np.int32) for n in (3, 4, 4)]
    ring = np.arange(count, dtype=np.int32)
    springs.append(np.stack([ring, np.roll(ring, -1)], axis=1))
    rows = make_rows(springs, ring, count, device)
    np.testing.assert_array_equal(rows.first.numpy(), 3 * np.arange(count + 1))
    columns = rows.column.numpy().reshape(-1, 3)
    np.testing.assert_array_equal(columns[:, 0], ring)
    np.testing.assert_array_equal(columns[1:-1, 1:], np.stack([ring[1:-1] - 1, ring[1:-1] + 1], axis=1))
