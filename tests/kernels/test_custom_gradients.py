"""Gradients are registered without building functions, and in Warp's own way where that is not possible."""

import pytest
import warp as wp

from warp_bsc.kernels import ccd, distance_gradients, gradients
from warp_bsc.kernels.custom_gradients import func_grad


@pytest.mark.parametrize(
    "function",
    [ccd._find_impact, gradients.with_gradients, distance_gradients.with_distance_gradients],
    ids=lambda function: function.key,
)
def test_functions_have_gradients(function):
    assert function.custom_grad_func is not None


@pytest.mark.parametrize("returned", [float, int], ids=["known type", "wrong type"])
def test_a_gradient_is_the_registered_one(returned, device):
    @wp.func
    def square(x: float) -> float:
        return x * x

    @func_grad(square, returned)
    def adjoint_of_square(x: float, adj_ret: float):
        wp.adjoint[x] += 3.0 * adj_ret

    assert hasattr(square.adj, "return_var") is (returned is not float)  # built

    @wp.kernel(module="unique")
    def square_all(x: wp.array[float], y: wp.array[float]):
        y[wp.tid()] = square(x[wp.tid()])

    x = wp.array([5.0], dtype=float, device=device, requires_grad=True)
    y = wp.zeros_like(x)
    with wp.Tape() as tape:
        wp.launch(square_all, 1, [x, y], device=device)
    tape.backward(grads={y: wp.ones_like(y)})
    assert y.numpy() == 25.0 and x.grad.numpy() == 3.0
