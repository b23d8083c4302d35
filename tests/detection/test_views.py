"""Positions that are views of other arrays: every entry takes them as it takes a copy, or refuses them."""

import newton
import numpy as np
import pytest
import warp as wp
from sample_sizes import cases

import warp_bsc as bsc


def interleaved(x, device):
    """Every second row of an array with other numbers between."""
    rows = np.full((2 * len(x), 3), 1e6, dtype=x.dtype)
    rows[::2] = x
    return wp.array(rows, dtype=vector(x), device=device)[::2]


def column(x, device):
    """A column of an array of two dimensions."""
    other = x[::-1] + x.dtype.type(7.0)
    return wp.array(np.stack([x, other], axis=1), dtype=vector(x), device=device)[:, 0]


def part(x, device):
    """The middle of a longer array."""
    return wp.array(np.pad(x, ((2, 3), (0, 0)), constant_values=1e6), dtype=vector(x), device=device)[2 : 2 + len(x)]


def overlapping(x, device):
    """One number on from vertex to vertex, so that each has two coordinates of the one before."""
    numbers = np.arange(len(x) + 2, dtype=x.dtype)
    numbers[::2] *= -1
    size = numbers.itemsize
    memory = wp.array(numbers, device=device)
    return wp.array(ptr=memory.ptr, dtype=vector(x), shape=(len(x),), strides=(size,), device=device), memory


def constant(x, device):
    """All vertices in one place."""
    memory = wp.array(x[:1], dtype=vector(x), device=device)
    return wp.array(ptr=memory.ptr, dtype=vector(x), shape=(len(x),), strides=(0,), device=device), memory


def vector(x):
    return wp.vec3 if x.dtype == np.float32 else wp.vec3d


def found(collisions):
    names = [f"{kind}{suffix}" for kind in ("vertex_face", "edge_edge") for suffix in ("", "_toi", "_coordinates")]
    return {name: getattr(collisions, name) for name in names}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("method", ["float", "conservative", "exact"])
@pytest.mark.parametrize("view", [interleaved, column, part])
def test_collisions_of_views_are_those_of_copies(view, method, dtype, device):
    rng = np.random.default_rng(3)
    collisions = 0
    for _ in range(cases(20)):
        x0 = rng.uniform(-1.0, 1.0, (14, 3)).astype(dtype)
        x1 = x0 + rng.uniform(-0.5, 0.5, (14, 3)).astype(dtype)
        faces = rng.permuted(np.tile(np.arange(14), (10, 1)), axis=1)[:, :3]
        detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, 14), method=method)
        expected = found(detector.detect(x0, x1))
        for start, end in ((view(x0, device), x1), (x0, view(x1, device)), (view(x0, device), view(x1, device))):
            actual = found(detector.detect(start, end))
            for name, values in expected.items():
                np.testing.assert_array_equal(actual[name], values)
        np.testing.assert_array_equal(detector.find_intersections(view(x1, device)), detector.find_intersections(x1))
        collisions += len(expected["vertex_face"]) + len(expected["edge_edge"])
    assert collisions > cases(100)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("view", [overlapping, constant])
def test_views_that_overlap_themselves(view, dtype, device):
    rng = np.random.default_rng(4)
    x = rng.uniform(-1.0, 1.0, (30, 3)).astype(dtype)
    faces = rng.permuted(np.tile(np.arange(30), (40, 1)), axis=1)[:, :3]
    start, memory = view(x, device)
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, 30), method="exact")
    expected = found(detector.detect(start.numpy(), x))
    actual = found(detector.detect(start, wp.array(x, dtype=vector(x), device=device)))
    assert len(expected["vertex_face"]) and len(expected["edge_edge"])
    for name, values in expected.items():
        np.testing.assert_array_equal(actual[name], values)
    del memory  # lives as long as the view


@pytest.mark.parametrize("view", [interleaved, column])
def test_gradients_of_views_are_those_of_copies(view, device):
    x0 = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, 1], [2, 1, 2], [1, 2, 2]], dtype=np.float32)
    x1 = x0 + np.array([0, 0, -4], dtype=np.float32) * (np.arange(6) >= 3)[:, None].astype(np.float32)
    detector = bsc.CollisionDetector(bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6), method="exact")
    gradients = []
    for make in (lambda x: wp.array(x, dtype=wp.vec3, device=device), lambda x: view(x, device)):
        start, end = make(x0), make(x1)
        for x in (start, end):
            x.requires_grad = True
        with wp.Tape() as tape:
            toi = detector.detect(start, end).arrays.vertex_face_toi
        tape.backward(grads={toi: wp.ones_like(toi)})
        gradients.append((start.grad.numpy(), end.grad.numpy()))
    assert all(np.abs(gradient).max() > 0.01 for gradient in gradients[0])
    np.testing.assert_array_equal(gradients[0], gradients[1])


@pytest.mark.parametrize("query", [bsc.query_vertex_face, bsc.query_edge_edge])
def test_queries_of_views_are_those_of_copies(query, device):
    points = np.random.default_rng(5).uniform(-1.0, 1.0, (200, 8, 3))
    both = wp.array(np.stack([points, points[::-1]], axis=1), dtype=wp.float64, device=device)
    expected, actual = query(points), query(both[:, 0])
    assert expected.hit.any()
    np.testing.assert_array_equal(actual.hit, expected.hit)
    np.testing.assert_array_equal(actual.toi, expected.toi)


def test_indexed_arrays_are_refused(device):
    x = wp.zeros(6, dtype=wp.vec3, device=device)
    indexed = wp.indexedarray(x, [wp.array(np.arange(6), dtype=int, device=device)])
    detector = bsc.CollisionDetector(bsc.CollisionMesh([[0, 1, 2], [3, 4, 5]], 6))
    with pytest.raises(TypeError, match="x0 must be"):
        detector.detect(indexed, x)


@pytest.mark.parametrize("view", [interleaved, column])
def test_the_stage_takes_states_that_are_views(view, device):
    ends = []
    for make in (lambda x: wp.array(x, dtype=wp.vec3, device=device), lambda x: view(x, device)):
        builder = newton.ModelBuilder()
        cloth = {"dim_x": 4, "dim_y": 4, "cell_x": 0.05, "cell_y": 0.05, "mass": 0.001}
        cloth |= {"rot": wp.quat_identity(), "particle_radius": 0.001}
        builder.add_cloth_grid(pos=wp.vec3(0.0, 0.0, 0.0), vel=wp.vec3(), fix_left=True, fix_right=True, **cloth)
        builder.add_cloth_grid(pos=wp.vec3(0.01, 0.02, 0.05), vel=wp.vec3(0.0, 0.0, -20.0), **cloth)
        builder.color()
        model = builder.finalize()
        solver = bsc.SolverCCD(newton.solvers.SolverVBD(model, iterations=2, particle_enable_self_contact=False))
        states = [model.state(), model.state()]
        for state in states:
            state.particle_q, state.particle_qd = make(state.particle_q.numpy()), make(state.particle_qd.numpy())
        hits = 0
        for _ in range(6):
            solver.step(*states, model.control(), None, 1.0 / 600.0)
            hits += solver.report.predicted_contacts
            assert solver.report.certified
            states.reverse()
        assert hits > 0
        ends.append(states[0].particle_q.numpy())
    np.testing.assert_array_equal(ends[0], ends[1])
