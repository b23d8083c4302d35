"""Gradients through steps of SolverImplicit: cells of the table of ``tests/support/gradient_table.py``.

Differences have one size and move whole inputs; those of the elasticity of cloth are of one scene.
"""

import numpy as np
import pytest
from gradient_scenes import SCENES, STEPS, cloth_on_sheet, marks_of
from gradient_table import contacts_of, deviations, limit_of

OF_SOLVER = 5e-3
"""Largest deviation of gradients of the solver's own steps."""


@pytest.fixture(
    scope="module", params=[pytest.param(scene, id=scene.__name__, marks=marks_of(scene)) for scene in SCENES]
)
def scene(request, device):
    """A scene, and gradients of it: of the steps of the solver, and of those that are solved in float64."""
    program = request.param(device)
    of_solver = program.gradients()
    program.refine()
    gradients = program.gradients()
    names = [name for name in gradients if request.param is cloth_on_sheet or not name.startswith(("tri_", "edge_"))]
    return program, of_solver, gradients, names


def test_gradients_are_those_of_central_differences(scene):
    """With loads and elasticities held constant, as the adjoint holds them, see ``Held``."""
    program, _, gradients, names = scene
    contacts_of(program)
    found = deviations(program, gradients, names, STEPS[1:2], parts={})
    assert not {name: each for name, each in found.items() if each and not max(each) < limit_of(name)}


def test_gradients_of_the_solver_are_as_exact_as_it_solves(scene):
    """They fail as well where the equations are not those of the solver."""
    _, of_solver, gradients, _ = scene
    wrong = {}
    for name, expected in gradients.items():
        deviation = np.linalg.norm(of_solver[name] - expected)
        if not deviation <= OF_SOLVER * np.linalg.norm(expected):
            wrong[name] = deviation
    assert not wrong
