"""Forces of a step on the unknowns of the solver with contact inside, whose derivatives it goes back by."""

import numpy as np
import warp as wp

from warp_bsc.implicit.gradients.bodies import ContactsOnBodies
from warp_bsc.implicit.gradients.energies import elastic_forces, inertial_forces


def forces_of(equations):
    """Returns the forces of the step that equations have loaded [N], float64, shape [count, 3]; 0 on what is fixed.

    They vanish where the step is solved.
    """
    step = equations.step
    inertia = wp.empty(equations.count, dtype=wp.vec3d, device=equations.device)
    inputs = equations.inertial(step.x1, step.x0, step.v0)
    wp.launch(inertial_forces, equations.count, inputs=inputs, outputs=[inertia], device=equations.device)
    forces = inertia.numpy() + forces_of_elastic(equations.elastic, equations.count, step.dt, step.x1, step.x0)
    for elements in equations.elements():
        elements.compute_forces(step.dt)
        of_corners, rows = (array.numpy()[: elements.count] for array in (elements.forces, elements.rows))
        of_corners = of_corners[:, 0]
        if isinstance(elements, ContactsOnBodies):
            moments = np.cross(elements.arms.numpy()[: elements.count], of_corners)
            of_corners = np.concatenate([of_corners, moments], axis=1)
        np.add.at(forces, rows[rows >= 0], of_corners[rows >= 0])
    forces[step.is_fixed.numpy() != 0] = 0.0
    return forces


def forces_of_elastic(elastic, count, dt, x1, x0):
    """Returns the forces of elements on so many unknowns, at positions at the end and at the start of a step, vec3d."""
    corners, forces = elastic.corners.numpy()[:, 0], np.zeros((count, 3))
    of_corners = wp.zeros(len(corners), dtype=wp.vec3d, device=elastic.device)
    inputs = [elastic.elements, wp.float64(dt), x1, x0]
    wp.launch(elastic_forces, elastic.count, inputs=inputs, outputs=[of_corners], device=elastic.device)
    np.add.at(forces, corners[corners >= 0], of_corners.numpy()[corners >= 0])
    return forces
