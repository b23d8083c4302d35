"""Linear solves with the matrix of a step, held against dense ones in NumPy."""

import newton
import numpy as np
import pytest
import warp as wp
from implicit_scenes import (
    DT,
    SELF_CONTACT,
    cloth_on_slope,
    colliding_cloths,
    exact_hessians,
    hanging_cloth,
    soft_block,
)

from warp_bsc.implicit.bodies import Poses
from warp_bsc.implicit.contacts import record_contacts, record_pairs
from warp_bsc.implicit.equations import Equations, Step
from warp_bsc.implicit.linear import LinearSolver
from warp_bsc.implicit.worlds import Worlds

TOLERANCE = 1e-9


class System:
    """The equations of a step of a scene whose end is moved at random, so that elements are compressed as well."""

    def __init__(self, model, scale, **options):
        solver, rng = newton.solvers.SolverVBD(model, iterations=5, **options), np.random.default_rng(5)
        start, end = model.state(), model.state()
        contacts = None
        if model.shape_count:
            normal = np.array(wp.quat_rotate(wp.quat(*model.shape_transform.numpy()[0, 3:]), wp.vec3(0.0, 0.0, 1.0)))
            x = start.particle_q.numpy()
            start.particle_q.assign((x - (x @ normal).min() * normal).astype(np.float32))
            pipeline = newton.CollisionPipeline(model, soft_contact_gap=0.1)
            contacts = pipeline.contacts()
            pipeline.collide(start, contacts)
        start.particle_qd.assign(np.tile((0.3, 0.1, -0.5), (model.particle_count, 1)))
        x0, v0 = wp.clone(start.particle_q), wp.clone(start.particle_qd)
        solver.step(start, end, None, contacts, DT)
        self.worlds = Worlds(model)
        self.equations = Equations(solver, self.worlds)
        x1 = end.particle_q.numpy()
        moves = (model.particle_mass.numpy() > 0.0)[:, None]
        x1 = wp.array(x1 + moves * rng.normal(scale=scale, size=x1.shape), dtype=wp.vec3, device=model.device)
        assert isinstance(x1, wp.array)
        pairs = record_pairs(solver, self.worlds)
        recorded = record_contacts(contacts, copies=True)
        self.equations.load(Step(DT, x0, v0, x1, start.particle_f, recorded, pairs, Poses(None, None)))
        b = rng.normal(size=(model.particle_count, 3)) * (self.equations.is_fixed.numpy() == 0)[:, None]
        self.b = wp.array(b, dtype=wp.vec3d, device=model.device)

    def dense(self):
        """The matrix, from the Hessians or Jacobians of all elements."""
        equations = self.equations
        fixed = equations.is_fixed.numpy() != 0
        mass = equations.model.particle_mass.numpy().astype(float)
        n = len(mass)
        matrix = np.zeros((n, 3, n, 3))
        matrix[np.arange(n), :, np.arange(n), :] = np.where(fixed, 1.0, mass / DT**2)[:, None, None] * np.eye(3)
        equations.differentiate(transposed=False)
        terms = list(exact_hessians(equations.elastic, equations.model))
        for elements in equations.elements():
            elements.differentiate(DT)  # unscaled
            jacobian, size = elements.jacobian.numpy()[: elements.count], elements.vertices.shape[1]
            vertices = elements.vertices.numpy()[: elements.count]
            terms.append((vertices, -jacobian.reshape(len(jacobian), size, 3, size, 3)))
        for vertices, hessian in terms:
            for e, i, j in np.ndindex(*vertices.shape, vertices.shape[1]):
                v, w = vertices[e, [i, j]]
                if min(v, w) >= 0 and not (fixed[v] or fixed[w]):
                    matrix[v, :, w, :] += hessian[e, i, :, j]
        return matrix.reshape(3 * n, 3 * n)

    def solve(self, *, transposed=False, max_iterations=2000, tolerance=TOLERANCE, b=None):
        """The solution, and the solver."""
        options = {"tolerance": tolerance, "max_iterations": max_iterations}
        solver = LinearSolver(self.equations, self.worlds, **options)
        self.equations.differentiate(transposed=transposed)
        return solver.solve(self.b if b is None else b).numpy(), solver


SYSTEMS = {
    "cloth": (lambda device: hanging_cloth(device, n=4), 0.002, {}, True),
    "compressed cloth": (lambda device: hanging_cloth(device, n=4), 0.01, {}, True),
    "worlds": (lambda device: hanging_cloth(device, worlds=3), 0.002, {}, True),
    "block": (soft_block, 0.01, {}, False),
    "cloth on a slope": (cloth_on_slope, 0.004, {}, False),
    "cloths on each other": (colliding_cloths, 0.001, SELF_CONTACT, False),
}


@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("name", SYSTEMS)
def test_solutions_are_those_of_dense_solves(device, name, transposed):
    scene, scale, options, is_symmetric = SYSTEMS[name]
    system = System(scene(device), scale, **options)
    matrix, b = system.dense(), system.b.numpy().ravel()
    assert (np.abs(matrix - matrix.T).max() < 1e-9 * np.abs(matrix).max()) == is_symmetric
    if name == "compressed cloth":
        assert np.linalg.eigvalsh(matrix).min() < -1.0
    x, solver = system.solve(transposed=transposed)
    assert not solver.failed.numpy().any()
    if is_symmetric:
        assert solver.indefinite.numpy().any() == (np.linalg.eigvalsh(matrix).min() < 0.0)
    matrix = matrix.T if transposed else matrix
    assert np.linalg.norm(matrix @ x.ravel() - b) <= 1.1 * TOLERANCE * np.linalg.norm(b)
    expected = np.linalg.solve(matrix, b)
    np.testing.assert_allclose(x.ravel(), expected, atol=1e-6 * np.abs(expected).max())


def test_each_world_fails_for_itself(device):
    system = System(hanging_cloth(device, worlds=3), 0.002)
    b, first, second = system.b.numpy(), *system.worlds.offsets.numpy()[1:3]
    alone, _ = system.solve()
    b[first:second] = 0.0
    b[second:] = np.nan
    x, solver = system.solve(b=wp.array(b, dtype=wp.vec3d, device=device))
    np.testing.assert_array_equal(solver.failed.numpy(), [0, 0, 1])
    np.testing.assert_allclose(x[:first], alone[:first], rtol=1e-9, atol=1e-12)
    assert not x[first:second].any()
    assert np.isnan(x[second:]).all()


@pytest.mark.parametrize("name", ["cloth", "cloth on a slope"])
def test_iterations_are_limited(device, name):
    scene, scale, options, _ = SYSTEMS[name]
    system = System(scene(device), scale, **options)
    x, solver = system.solve(max_iterations=3)
    assert solver.failed.numpy().all()
    assert np.isnan(x).all()
