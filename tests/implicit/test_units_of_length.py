"""A model in other units of length, such as centimetres, moves as the same one in metres."""

import newton
import numpy as np
import pytest
import warp as wp

from warp_bsc.implicit.solver_implicit import SolverImplicit

SMALL_UNITS, STEPS = 128.0, 8


def scene(device, metre, *, falls):
    """A cloth and a soft block that hit a ball, and slide on it, with lengths in units of which a metre has many."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -9.81 * metre if falls else 0.0))
    builder.default_particle_radius = 0.01 * metre
    at = wp.transform(wp.vec3(0.01 * metre, 0.0, -0.151 * metre), wp.quat_identity())
    builder.add_shape_sphere(-1, radius=0.15 * metre, xform=at)
    cloth = {"dim_x": 5, "dim_y": 4, "cell_x": 0.05 * metre, "cell_y": 0.05 * metre, "mass": 0.001}
    cloth |= {"pos": wp.vec3(-0.12 * metre, -0.1 * metre, 0.01 * metre), "rot": wp.quat_identity()}
    cloth |= {"tri_ke": 1e3, "tri_ka": 1e3, "tri_kd": 1e-3, "edge_ke": 1e-2 * metre, "edge_kd": 1e-4 * metre}
    builder.add_cloth_grid(vel=wp.vec3(0.0, 0.0, -metre), **cloth)
    soft = {"density": 200.0 / metre**3, "k_mu": 5e3 / metre, "k_lambda": 5e3 / metre, "k_damp": 1.0 / metre}
    cells = {f"{kind}_{axis}": (2, 0.05 * metre)[kind == "cell"] for kind in ("dim", "cell") for axis in "xyz"}
    ball = wp.transform(wp.vec3(0.2 * metre, 0.0, 0.03 * metre), wp.quat_identity())
    body = builder.add_body(xform=ball)
    cfg = newton.ModelBuilder.ShapeConfig(density=300.0 / metre**3)
    builder.add_shape_sphere(body, radius=0.04 * metre, cfg=cfg)
    at = {"pos": wp.vec3(-0.05 * metre, -0.05 * metre, 0.03 * metre), "rot": wp.quat_identity()}
    builder.add_soft_grid(vel=wp.vec3(0.0, 0.0, -metre), **at, **cells, **soft)
    return builder.finalize(device=device)


@pytest.mark.parametrize("falls, most_steps", [(True, 4), (False, 30)])
def test_a_model_in_small_units_moves_as_in_metres(falls, most_steps, device):
    """Bit for bit with a power of two of them in a metre, with gravity or without, and with as many Newton steps."""
    found = []
    for metre in (1.0, SMALL_UNITS):
        model = scene(device, metre, falls=falls)
        solver, states = SolverImplicit(model, max_iterations=most_steps), [model.state(), model.state()]
        for _ in range(STEPS):
            solver.step(*states, None, None, 1.0 / 60.0)
            states.reverse()
            found.append((solver.report.newton_steps, solver.report.converged, states[0].particle_q.numpy() / metre))
        assert solver.report.totals.uncertified_steps == 0
    for expected, same in zip(found[:STEPS], found[STEPS:], strict=True):
        assert same[:2] == expected[:2]
        np.testing.assert_array_equal(same[2], expected[2])
