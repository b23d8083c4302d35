"""Gradients through steps of SolverImplicit against central differences of the same steps, solved in float64.

Along a random way of each input, the change of a weighted sum of the positions and velocities at the end is that which
the gradients tell. Inputs are moved by 1e-5 of their size, or 1e-3, and rounded to float32; what is left is rounding.
"""

import numpy as np
import pytest
from gradient_scenes import (
    SCENES,
    block_on_plane,
    cloth_on_edge,
    cloth_on_sheet,
    cloth_on_sphere,
    marks_of,
)

LIMIT = 5e-5
"""Largest deviation of a change, relative to those of all components, added as independent ones are."""
OF_ROUNDED = {"shape_material_mu": 3e-4, "friction": 3e-4}
"""The same of inputs from which the coefficient of a pair is computed in float32."""
OF_SOLVER = 0.03
"""Largest deviation of gradients of the solver's own steps."""
SOLVED = cloth_on_sphere, cloth_on_edge, block_on_plane, cloth_on_sheet
"""Scenes whose steps the solver ends within 1% of the reach of barriers of where they are solved."""


def parameters(scenes):
    return [pytest.param(scene, id=scene.__name__, marks=marks_of(scene)) for scene in scenes]


@pytest.fixture(scope="module", params=parameters(SCENES))
def scene(request, device):
    """A scene, and gradients of it: of the steps of the solver, and of those that are solved in float64."""
    program = request.param(device)
    of_solver = program.gradients()
    program.refine()
    return program, of_solver, program.gradients()


def test_gradients_are_those_of_central_differences(scene):
    """With loads and elasticities held constant, as the adjoint holds them, see ``Held``."""
    program, _, gradients = scene
    held = program.reference.held
    assert min(program.reference.contacts) > 0 and program.reference.residual < 1e-9
    deviations = {}
    for name, gradient in gradients.items():
        change, way = program.difference(name, held)
        deviation = abs((gradient * way).sum() - change) / np.linalg.norm(gradient * way)
        if not deviation < OF_ROUNDED.get(name, LIMIT):
            deviations[name] = deviation
    assert not deviations


@pytest.mark.parametrize("scene", parameters(SOLVED), indirect=True)
def test_gradients_of_the_solver_are_as_exact_as_it_solves(scene):
    """It ends a step where nothing changes by more than 1 mm/s: 17 micrometres, where barriers reach 5 mm."""
    _, of_solver, gradients = scene
    for name in ("x", "v"):
        assert np.linalg.norm(of_solver[name] - gradients[name]) < OF_SOLVER * np.linalg.norm(gradients[name])
