"""Strain by contacts is measured, and warned of."""

import warnings

import newton
import numpy as np
import warp as wp
from newton_scenes import SOLVERS, Rollout, add_patch, bullet

import warp_bsc as bsc
from warp_bsc.response.report.strain import edges_at_rest


def test_lengths_at_rest_are_those_of_the_material(device):
    """Edges of cloth and of a soft body, apart from where they are now."""
    builder = newton.ModelBuilder()
    add_patch(builder, 2, 0.05, (0.0, 0.0, 1.0))
    sizes = {"dim_x": 1, "dim_y": 1, "dim_z": 1, "cell_x": 0.1, "cell_y": 0.2, "cell_z": 0.3}
    material = {"density": 100.0, "k_mu": 1e4, "k_lambda": 1e4, "k_damp": 0.0}
    builder.add_soft_grid(pos=wp.vec3(), rot=wp.quat_identity(), vel=wp.vec3(), **sizes, **material)
    x = np.array(builder.particle_q)
    builder.particle_q = [wp.vec3(*row) for row in 2.0 * x]
    edges, lengths, is_solid = edges_at_rest(builder.finalize(device=device))
    assert np.allclose(lengths, np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1), rtol=1e-5)
    assert is_solid.tolist() == (edges >= 9).all(axis=1).tolist()
    assert len(edges) == 16 + 18


def test_strain_is_reported_and_warned_of_once(device):
    """A patch at 20 m/s stretches a sheet far in a step as a whole; in substeps it does not."""
    for substeps in (1, 16):
        model = bullet(20.0, device=device)
        rollout = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), substeps=substeps))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            strains = []
            for _ in range(5):
                rollout.step()
                strains.append(rollout.solver.report.strain)
                assert rollout.solver.report.certified
        of_strain = [str(warning.message) for warning in caught if "strained an edge" in str(warning.message)]
        strained = rollout.solver.report.totals.strained_steps
        assert strained == np.count_nonzero(np.array(strains) > 0.2)
        assert len(of_strain) == min(strained, 1)
        if substeps == 1:
            assert strained > 0 and "raise substeps" in of_strain[0]
        else:
            assert 0.0 < max(strains) < 0.2
