"""Gradients through steps that keep a distance, against central differences of the same steps."""

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import Still
from test_solver_gradients import crossing_triangles, on_the_ground, vertex_in_face

import warp_bsc as bsc

DT = 0.01


@pytest.mark.parametrize("projections", [40, 0])
@pytest.mark.parametrize("nearer", [False, True])
@pytest.mark.parametrize(
    "motion, distance", [(crossing_triangles, 0.015), (vertex_in_face, 0.015), (on_the_ground, 0.01)]
)
def test_gradient_of_a_step_is_that_of_central_differences(motion, distance, nearer, projections, device):
    """Of pairs that start farther apart than their distance, and of pairs that start nearer."""
    indices, start, wanted = motion()
    min_distance = 0.15 if nearer else distance
    builder = newton.ModelBuilder()
    builder.add_cloth_mesh(
        pos=wp.vec3(),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(),
        vertices=[wp.vec3(*vertex) for vertex in start],
        indices=indices,
        density=1.0,
    )
    if motion is on_the_ground:
        builder.add_ground_plane()
    model = builder.finalize(device=device, requires_grad=True)
    options = {"friction": 0.3, "restitution": 0.5, "min_distance": min_distance, "max_iterations": projections}
    solver = bsc.SolverCCD(Still(model), contact_layer=False, **options)
    random = np.random.default_rng(0)
    n = len(start)
    first = [np.array(start), wanted, (wanted - start) / DT + random.normal(scale=0.1, size=(n, 3))]
    first = [values.astype(np.float32).astype(float) for values in first]
    states = model.state(), model.state()
    arrays = states[0].particle_q, states[1].particle_q, states[1].particle_qd

    def end(values):
        for array, value in zip(arrays, values, strict=True):
            array.assign(value.astype(np.float32))
        solver.step(*states, None, None, DT)
        return [states[1].particle_q.numpy().astype(float), states[1].particle_qd.numpy().astype(float)]

    moved = end(first)[0]
    assert np.abs(moved - wanted).max() > 1e-3
    assert solver.report.certified and (solver.report.truncated > 0) == (projections == 0)
    for _ in range(3):
        cotangents = [random.normal(size=(n, 3)), DT * random.normal(size=(n, 3))]
        for array, value in zip(arrays, first, strict=True):
            array.assign(value.astype(np.float32))
        tape = wp.Tape()
        with tape:
            solver.step(*states, None, None, DT)
        arrays[0].grad.zero_()
        for array, cotangent in zip(arrays[1:], cotangents, strict=True):
            array.grad.assign(cotangent.astype(np.float32))
        tape.backward()
        gradients = [array.grad.numpy().astype(float) for array in arrays]
        for which, h in ((0, 2.0**-14), (1, 2.0**-14), (2, 2.0**-7)):
            direction = random.integers(-2, 3, size=(n, 3))
            sides = []
            for sign in (1.0, -1.0):
                values = [value.copy() for value in first]
                values[which] += sign * h * direction
                sides.append(sum((e * c).sum() for e, c in zip(end(values), cotangents, strict=True)))
            expected = (sides[0] - sides[1]) / (2.0 * h)
            scale = np.linalg.norm(gradients[which]) + 1e-3
            np.testing.assert_allclose((gradients[which] * direction).sum(), expected, rtol=2e-3, atol=5e-3 * scale)
