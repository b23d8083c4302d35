"""Chooses how the inner solver takes the steps of a stage."""

from typing import Any

from newton.solvers import SolverStyle3D, SolverVBD

from ..layer.contact_layer import ContactLayer
from ..state.workspace import Workspace
from .inner_steps import InnerSteps, WholeSteps
from .style3d_springs import SpringSteps
from .substeps import Substeps
from .wrapped_solver import innermost


def choose_steps(stage: Any, work: Workspace, substeps: int) -> InnerSteps:
    """Returns how the ``solver`` of a stage takes its steps: whole or in substeps, and Style3D with springs.

    With gradients a contact layer pushes before the stage, and Style3D has its own contacts.
    """
    solver, integrator = stage.solver, innermost(stage.solver)
    if isinstance(solver, SolverStyle3D) and not stage.model.requires_grad:
        steps = SpringSteps(stage, work)
    else:
        steps = WholeSteps(stage)
        if isinstance(solver, ContactLayer):
            steps.pushes_before = "the contact layer pushes before the stage"
        elif isinstance(integrator, SolverVBD) and integrator.particle_enable_self_contact:
            steps.pushes_before = "SolverVBD has self-contact"
    return steps if substeps == 1 else Substeps(steps, work.motion, substeps, integrator=integrator)
