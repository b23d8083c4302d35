"""Energies of SolverImplicit and their derivatives: against what Warp differentiates, and against differences."""

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import DT
from step_forces import forces_of_elastic

from warp_bsc.implicit.contact.assembly import add_blocks
from warp_bsc.implicit.contact.barrier import (
    CURVATURE_AT_HALF,
    barrier_curvature,
    barrier_energy,
    barrier_slope,
    friction_curvature,
    friction_energy,
    friction_slope,
)
from warp_bsc.implicit.contact.flow import Place, Problem
from warp_bsc.implicit.contact.matrix import make_matrix
from warp_bsc.implicit.contact.rows import Rows, make_rows, sum_of_corners
from warp_bsc.implicit.contact.system import Contacts, Unknowns
from warp_bsc.implicit.elasticity.derivatives import Derivatives, element_energy, find_derivatives, make_derivatives
from warp_bsc.implicit.elasticity.elements import SIZES, ElementKind, Elements, elements_of_model, kind_of
from warp_bsc.implicit.gradients.arrays import with_gradient
from warp_bsc.implicit.gradients.elastic import Elastic
from warp_bsc.response.state.structs import allocate


@wp.kernel(enable_backward=False)
def _differentiate(
    elements: Elements,
    x: wp.array[wp.vec3d],
    x0: wp.array[wp.vec3],
    dt: wp.float64,
    is_convex: bool,
    out: Derivatives,
    energy: wp.array[wp.float64],
):
    i = wp.tid()
    kind = kind_of(elements, i)
    energy[i] = find_derivatives(i, kind, elements, x, x0, dt, is_convex, out)


@wp.kernel(enable_backward=False)
def _add_blocks(problem: Problem, threads: int):
    """Without inertia: no unknown is free."""
    at = Place()
    at.thread = wp.tid()
    at.threads = threads
    add_blocks(at, problem)


@wp.kernel(enable_backward=False)
def _energies(
    elements: Elements, x: wp.array[wp.vec3d], x0: wp.array[wp.vec3], dt: wp.float64, energy: wp.array[wp.float64]
):
    i = wp.tid()
    energy[i] = element_energy(elements, i, kind_of(elements, i), x, x0, dt)


@wp.kernel(enable_backward=False)
def _evaluate_barrier(gap: wp.array[wp.float64], reach: wp.float64, values: wp.array2d[wp.float64]):
    i = wp.tid()
    values[i, 0] = barrier_energy(gap[i], reach)
    values[i, 1] = barrier_slope(gap[i], reach)
    values[i, 2] = barrier_curvature(gap[i], reach)
    values[i, 3] = friction_energy(gap[i], reach)
    values[i, 4] = friction_slope(gap[i], reach) * gap[i]
    values[i, 5] = friction_curvature(gap[i], reach)


@wp.kernel(enable_backward=False)
def _sum_corners(rows: Rows, derivatives: Derivatives, gradient: wp.array[wp.vec3]):
    u = wp.tid()
    gradient[u] = sum_of_corners(rows, derivatives, rows.first_corner[u], rows.first_corner[u + 1], 0, 1)


class Scene:
    """A cloth, a block, a rope and a spring across, crumpled at random, with all kinds of elements and of damping."""

    def __init__(self, device, seed=0):
        rng = np.random.default_rng(seed)
        builder = newton.ModelBuilder()
        still = {"rot": wp.quat_identity(), "vel": wp.vec3()}
        builder.add_cloth_grid(
            pos=wp.vec3(), dim_x=3, dim_y=2, cell_x=0.1, cell_y=0.1, mass=0.01, tri_ke=100.0, tri_ka=120.0,
            tri_kd=0.02, edge_ke=0.5, edge_kd=0.01, **still,
        )  # fmt: skip
        builder.add_soft_grid(
            pos=wp.vec3(1.0, 0.0, 0.0), dim_x=1, dim_y=1, dim_z=1, cell_x=0.1, cell_y=0.1, cell_z=0.1, density=100.0,
            k_mu=1e3, k_lambda=2e3, k_damp=0.3, **still,
        )  # fmt: skip
        for a, b in ((0, 12), (3, 17), (5, 6)):
            builder.add_spring(a, b, 10.0, 0.1, 0)
        self.model = builder.finalize(device=device)
        self.elements, self.vertices = elements_of_model(self.model)
        self.count = sum(map(len, self.vertices))
        q = self.model.particle_q.numpy()
        self.x0 = (q + rng.normal(0.0, 0.02, q.shape)).astype(np.float32)
        self.x = (self.x0 + rng.normal(0.0, 0.02, q.shape)).astype(np.float32)

    def array(self, values, dtype=wp.vec3):
        return wp.array(values, dtype=dtype, device=self.model.device)

    def differentiate(self, *, convex=False):
        """Returns the derivatives of all elements, on the device, and keeps their energies."""
        device = self.model.device
        out = make_derivatives(self.vertices, device)
        self.energy = wp.zeros(self.count, dtype=wp.float64, device=device)
        inputs = [self.elements, self.array(self.x, wp.vec3d), self.array(self.x0), wp.float64(DT), convex]
        wp.launch(_differentiate, self.count, inputs=inputs, outputs=[out, self.energy], device=device)
        return out

    def differentiated(self):
        """Returns the elements, with their exact Hessians."""
        count = self.model.particle_count
        elastic = Elastic(self.model, np.arange(count), count)
        elastic.differentiate(DT, self.array(self.x, wp.vec3d), self.array(self.x0, wp.vec3d))
        return elastic

    def exact_hessians(self, elastic):
        """Yields the particles of elements of each kind, -1 for none, and the Hessians that ``elastic`` has."""
        blocks, bends, place = elastic.blocks.numpy(), elastic.bends.numpy(), 0
        for kind, v in enumerate(self.vertices):
            n, size = v.shape
            if kind == ElementKind.BENDING:
                hessian = bends
            else:
                hessian, place = blocks[place : place + n * size * size], place + n * size * size
            yield v, hessian.reshape(n, size, size, 3, 3).transpose(0, 1, 3, 2, 4)

    def by_kind(self, out):
        """Returns gradients, shape [n, size, 3], and Hessians, shape [n, size, 3, size, 3], of each kind."""
        gradient, block, corner, place = out.gradient.numpy(), out.block.numpy(), 0, 0
        for kind, (v, size) in enumerate(zip(self.vertices, SIZES, strict=True)):
            of_corners = gradient[corner : corner + v.size].reshape(len(v), size, 3)
            corner += v.size
            if kind == ElementKind.BENDING:
                turn = out.turn.numpy().reshape(len(v), size, 4)[:, :, :3]
                hessian = np.einsum("eia,ejb->eiajb", turn, turn)
            else:
                blocks = block[place : place + v.size * size, :, :3].reshape(len(v), size, size, 3, 3)
                hessian = blocks.transpose(0, 1, 3, 2, 4)
                place += v.size * size
            yield of_corners, hessian

    def energies(self, x):
        out = wp.zeros(self.count, dtype=wp.float64, device=self.model.device)
        inputs = [self.elements, self.array(x, wp.vec3d), self.array(self.x0), wp.float64(DT)]
        wp.launch(_energies, self.count, inputs=inputs, outputs=[out], device=self.model.device)
        return np.split(out.numpy(), np.cumsum([len(v) for v in self.vertices])[:-1])


@pytest.fixture(scope="module")
def scene(device):
    return Scene(device)


def test_exact_hessians_are_those_that_warp_computes(scene):
    elastic, way = scene.differentiated(), np.random.default_rng(1).normal(size=scene.x.shape)
    x1, x0, multipliers = (scene.array(a, wp.vec3d) for a in (scene.x, scene.x0, way))
    gradient = wp.zeros_like(x1)
    elastic.add_gradients(DT, with_gradient(x1, gradient), x0, multipliers)
    expected, product = -gradient.numpy(), np.zeros_like(way)
    for v, hessian in scene.exact_hessians(elastic):
        along = np.where(v[..., None] >= 0, way[v], 0.0)
        np.add.at(product, v, np.einsum("eiajb,ejb->eia", hessian, along) * (v >= 0)[..., None])
    np.testing.assert_allclose(product, expected, atol=1e-12 * np.abs(expected).max())


def test_forces_in_float64_are_minus_the_derivatives_of_the_energies(scene):
    elastic, way, h = scene.differentiated(), np.random.default_rng(1).normal(size=scene.x.shape), 1e-6
    x1, x0 = (scene.array(a, wp.vec3d) for a in (scene.x, scene.x0))
    forces = forces_of_elastic(elastic, len(way), DT, x1, x0)
    above, below = (np.concatenate(scene.energies(scene.x + sign * h * way)).sum() for sign in (1.0, -1.0))
    assert (forces * way).sum() == pytest.approx((below - above) / (2.0 * h), rel=1e-7)


def test_hessians_in_float32_are_the_exact_ones(device, scene):
    flat = Scene(device)
    flat.x = flat.model.particle_q.numpy()
    flat.x[:, :2] += np.random.default_rng(3).normal(0.0, 0.01, (len(flat.x), 2))
    flat.x0 = flat.x
    for each in (scene, flat):
        exact = each.exact_hessians(each.differentiated())
        for kind, (_, hessian), (_, expected) in zip(
            ElementKind, each.by_kind(each.differentiate()), exact, strict=True
        ):
            if kind != ElementKind.BENDING or each is flat:  # without moments that of Gauss and Newton is exact
                np.testing.assert_allclose(hessian, expected, atol=1e-5 * np.abs(expected).max())


def test_gradients_are_those_of_the_energies(scene):
    found = [gradient for gradient, _ in scene.by_kind(scene.differentiate())]
    np.testing.assert_array_equal(scene.energy.numpy(), np.concatenate(scene.energies(scene.x)))
    way = 1e-4 * np.random.default_rng(1).normal(size=scene.x.shape)
    ends = (scene.x + way).astype(np.float32), (scene.x - way).astype(np.float32)
    between = ends[0].astype(float) - ends[1]
    above, below = map(scene.energies, ends)
    for gradient, v, more, less in zip(found, scene.vertices, above, below, strict=True):
        taken = np.where(v[..., None] >= 0, between[v], 0.0)
        expected = (gradient * taken).sum(axis=(1, 2))
        np.testing.assert_allclose(more - less, expected, atol=2e-3 * np.abs(expected).max())


def test_convex_hessians_have_no_negative_eigenvalue(scene):
    def least(hessian):
        n = 3 * hessian.shape[1]
        values = np.linalg.eigvalsh(hessian.reshape(-1, n, n).astype(float))
        return (values[:, 0] / np.abs(values).max(axis=1).clip(1e-30)).min()

    whole = [least(hessian) for _, hessian in scene.by_kind(scene.differentiate())]
    convex = [least(hessian) for _, hessian in scene.by_kind(scene.differentiate(convex=True))]
    assert min(whole) < -1e-3
    assert convex[ElementKind.MEMBRANE] > -1e-5
    assert convex[ElementKind.SPRING] > -1e-5
    assert convex[ElementKind.TETRAHEDRON] >= whole[ElementKind.TETRAHEDRON]


def test_rows_are_the_sums_of_elements(scene):
    derivatives, count, device = scene.differentiate(), scene.model.particle_count, scene.model.device
    unknown = np.random.default_rng(2).permutation(count)
    rows = make_rows(scene.vertices, unknown, count, device)
    first, column = rows.first.numpy(), rows.column.numpy()
    row, problem = np.repeat(np.arange(count), np.diff(first)), Problem()
    problem.derivatives, problem.rows, problem.parts = derivatives, rows, 4
    problem.unknowns, problem.contacts = allocate(Unknowns, count, device), allocate(Contacts, count, device)
    problem.unknowns.of_worlds = scene.array([0, count], int)
    problem.matrix = blocks_of = make_matrix(rows, np.array([0, count]), parts=2, device=device)
    numbers = -(-count // 32) * 32 + len(row)  # blocks of the diagonal are in warps of their own
    wp.launch(_add_blocks, numbers, inputs=[problem, numbers], device=device)
    if wp.get_device(device).is_cuda:  # the same sums by four threads for each block
        values = blocks_of.value.numpy()
        wp.launch(_add_blocks, 4 * numbers, inputs=[problem, 4 * numbers], device=device)
        np.testing.assert_array_equal(blocks_of.value.numpy(), values)
    gradient = wp.zeros(count, dtype=wp.vec3, device=device)
    wp.launch(_sum_corners, count, inputs=[rows, derivatives], outputs=[gradient], device=device)
    matrix, vector = np.zeros((count, 3, count, 3)), np.zeros((count, 3))
    for (of_corners, blocks), v in zip(scene.by_kind(derivatives), scene.vertices, strict=True):
        for e, i in zip(*np.nonzero(v >= 0), strict=True):
            u = unknown[v[e, i]]
            vector[u] += of_corners[e, i]
            for j in np.flatnonzero(v[e] >= 0):
                matrix[u, :, unknown[v[e, j]]] += blocks[e, i, :, j]
    found = np.zeros_like(matrix)
    place = blocks_of.place.numpy()[:, None] + blocks_of.width * np.arange(9)
    found[row, :, column] = blocks_of.value.numpy()[place].reshape(-1, 3, 3)
    np.testing.assert_allclose(found, matrix, atol=1e-5 * np.abs(matrix).max())
    np.testing.assert_allclose(gradient.numpy(), vector, atol=1e-5 * np.abs(vector).max())
    assert (column[first[:-1]] == np.arange(count)).all()  # the diagonal is the first of its row


def test_elements_without_finite_positions_have_no_forces(device):
    scene = Scene(device)
    scene.x[4] = np.nan
    for v, (gradient, hessian), energy in zip(
        scene.vertices, scene.by_kind(scene.differentiate()), scene.energies(scene.x), strict=True
    ):
        hurt = (v == 4).any(axis=1)
        assert not gradient[hurt].any()
        assert not hessian[hurt].any()
        assert not energy[hurt].any()
        assert np.isfinite(energy).all()
        assert np.isfinite(gradient).all()


def test_derivatives_of_barriers_and_of_friction(device):
    reach, step = 0.002, 1e-9
    gap = np.array([1e-5, 3e-4, 1e-3, 1.9e-3])
    gaps = np.concatenate([gap - step, gap, gap + step])
    values = wp.zeros((len(gaps), 6), dtype=wp.float64, device=device)
    inputs = [wp.array(gaps, dtype=wp.float64, device=device), wp.float64(reach)]
    wp.launch(_evaluate_barrier, len(gaps), inputs=inputs, outputs=[values], device=device)
    before, here, after = values.numpy().reshape(3, len(gap), 6)
    slopes = (after - before) / (2.0 * step)
    for first in (0, 3):  # of the barrier, then of friction
        for column in (first, first + 1):
            np.testing.assert_allclose(here[:, column + 1], slopes[:, column], rtol=1e-5)
    assert here[2, 2] == pytest.approx(CURVATURE_AT_HALF, rel=1e-12)
    assert (np.diff(here[:, 0]) < 0.0).all()  # it pushes apart
