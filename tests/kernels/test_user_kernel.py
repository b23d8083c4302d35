"""Device functions called in a user's own kernel, with that module's own compile options."""

import sys

import numpy as np
import pytest
import warp as wp
from generators import GENERATORS
from outputs import filled_with_nan

from warp_bsc import query_edge_edge, query_vertex_face
from warp_bsc.kernels import HIT, UNSURE, ccd_edge_edge, ccd_vertex_face, impact_vertex_face


@wp.kernel
def ask_vertex_face(p: wp.array2d[wp.vec3], status: wp.array[int], toi: wp.array[wp.float64]):
    i = wp.tid()
    status[i] = ccd_vertex_face(p[i, 0], p[i, 1], p[i, 2], p[i, 3], p[i, 4], p[i, 5], p[i, 6], p[i, 7])
    impact = impact_vertex_face(
        p[i, 0], p[i, 1], p[i, 2], p[i, 3], p[i, 4], p[i, 5], p[i, 6], p[i, 7], wp.float64(9.5367431640625e-07)
    )
    toi[i] = impact.toi


@wp.kernel(enable_backward=False)
def ask_edge_edge(p: wp.array2d[wp.vec3d], status: wp.array[int]):
    i = wp.tid()
    status[i] = ccd_edge_edge(p[i, 0], p[i, 1], p[i, 2], p[i, 3], p[i, 4], p[i, 5], p[i, 6], p[i, 7])


@pytest.mark.parametrize("name", ["uniform", "mostly_hits", "integer_lattice"])
def test_single_precision_answers_are_those_of_the_query(name, device):
    points = GENERATORS[name](np.random.default_rng(11), 300, "vertex_face", np.float32)
    status = wp.zeros(len(points), dtype=int)
    toi = filled_with_nan(len(points), wp.float64)
    wp.launch(ask_vertex_face, len(points), inputs=[wp.array(points, dtype=wp.vec3), status, toi])
    expected = query_vertex_face(points, method="conservative")
    # the user's module may fuse multiply and add: certified answers agree, and little else is left open
    certified = (status.numpy() != 2) & (expected.status != 2)
    np.testing.assert_array_equal(status.numpy()[certified], expected.status[certified])
    assert ((status.numpy() == 2) == (expected.status == 2)).mean() > 0.98
    np.testing.assert_allclose(toi.numpy()[certified], expected.toi[certified], atol=2.0**-20)


def test_double_precision_answers_are_those_of_the_query(device):
    points = GENERATORS["uniform"](np.random.default_rng(12), 300, "edge_edge", np.float64)
    status = wp.zeros(len(points), dtype=int)
    wp.launch(ask_edge_edge, len(points), inputs=[wp.array(points, dtype=wp.vec3d), status])
    np.testing.assert_array_equal(status.numpy(), query_edge_edge(points).status)


def test_times_of_impact_in_a_user_kernel_have_gradients(device):
    """A vertex that falls from 1 m to -1 m onto a triangle: raised by dz at either end, it arrives dz / 4 m later."""
    triangle = [[-1.0, -1.0, 0.0], [2.0, -1.0, 0.0], [-1.0, 2.0, 0.0]]
    points = np.array([[[0.0, 0.0, 1.0], *triangle, [0.0, 0.0, -1.0], *triangle]], dtype=np.float32)
    p = wp.array(points, dtype=wp.vec3, requires_grad=True)
    status, toi = wp.zeros(1, dtype=int), filled_with_nan(1, wp.float64, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(ask_vertex_face, 1, inputs=[p], outputs=[status, toi])
    tape.backward(toi)
    np.testing.assert_allclose(p.grad.numpy()[0, [0, 4]], [[0.0, 0.0, 0.25]] * 2)
    np.testing.assert_allclose(p.grad.numpy()[0].sum(axis=0), 0.0, atol=1e-6)


@wp.kernel(enable_backward=False, module="unique", module_options={"fast_math": True, "mode": "release"})
def ask_fast(p: wp.array2d[wp.vec3], status: wp.array[int]):
    i = wp.tid()
    status[i] = ccd_vertex_face(p[i, 0], p[i, 1], p[i, 2], p[i, 3], p[i, 4], p[i, 5], p[i, 6], p[i, 7])


@pytest.mark.skipif(sys.platform == "darwin", reason="no CUDA compiler")
def test_conversions_to_double_precision_keep_subnormal_numbers_with_fast_math(tmp_path):
    wp.compile_aot_module(ask_fast.module, arch=90, module_dir=tmp_path, use_ptx=True)
    (code,) = (path.read_text() for path in tmp_path.rglob("*.ptx"))
    assert code.count("cvt.f64.f32") == 24
    assert "cvt.ftz" not in code


def test_subnormal_numbers_count_in_single_precision_with_fast_math(device):
    """Which takes them for zero on a GPU."""
    points = GENERATORS["mostly_hits"](np.random.default_rng(13), 2000, "vertex_face", np.float64)
    points = np.ldexp(points, [-130, 0, 0]).astype(np.float32)
    status = wp.zeros(len(points), dtype=int)
    wp.launch(ask_fast, len(points), inputs=[wp.array(points, dtype=wp.vec3), status])
    truth = query_vertex_face(points).hit
    assert truth.mean() > 0.9
    assert (status.numpy() != UNSURE).mean() > 0.9
    assert np.array_equal((status.numpy() == HIT)[status.numpy() != UNSURE], truth[status.numpy() != UNSURE])
