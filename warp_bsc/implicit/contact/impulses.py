"""Publishes the impulses of barriers and friction, as those of the collision stage are."""

import warp as wp

from ...kernels.polynomials import EDGE_EDGE
from ...response.report.forces.emit import publish_contact
from ...response.report.forces.structs import ContactRows, ImpulseSums, Sides
from ...response.state.structs import ContactKind, Step
from ...response.state.vectors import ZERO, to_double, to_single
from . import barrier
from .pairs import BarrierSettings, Trial
from .system import AT_PLANE, Contacts, end_of_contacts, kind_of_key, second_of_key

wp.set_module_options({"enable_backward": False})


@wp.kernel
def publish_contacts(
    # in
    contacts: Contacts,
    settings: BarrierSettings,
    trial: Trial,
    step: Step,
    sides: Sides,
    centres: wp.array[wp.vec3d],
    threads: int,
    # out
    sums: ImpulseSums,
    rows: ContactRows,
):
    """Adds the impulses of contacts at the end of a solve to all sums, and writes a row for each.

    So many threads share those of a world, in a launch over threads and worlds.
    """
    thread, world = wp.tid()
    for i in range(contacts.start[world] + thread, end_of_contacts(contacts, world), threads):
        corners, load = contacts.corners[i], wp.float64(contacts.load[i])
        weights, normal = wp.vec4d(), to_double(contacts.normal[i])
        slid, predicted = wp.vec3d(), wp.vec3d()
        for j in range(4):
            weights[j] = wp.float64(contacts.weights[i][j])
            x0 = to_double(step.motion.x0[corners[j]])
            slid += weights[j] * (trial.exact[corners[j]] - x0)
            predicted += weights[j] * (to_double(trial.goal[corners[j]]) - x0)
        slid -= wp.dot(slid, normal) * normal
        limit = wp.float64(contacts.limit[i])
        impulse = load * normal - limit * barrier.friction_slope(wp.length(slid), settings.smoothing) * slid
        impulse *= settings.dt
        plane = int(-1)
        kind = int(ContactKind.VERTEX_FACE)
        if kind_of_key(contacts.key[i]) == AT_PLANE:
            plane = second_of_key(contacts.key[i])
            kind = int(ContactKind.PLANE)
        elif kind_of_key(contacts.key[i]) == EDGE_EDGE:
            kind = int(ContactKind.EDGE_EDGE)
        publish_contact(
            step,
            sides,
            centres,
            kind,
            corners,
            weights,
            plane,
            impulse,
            settings.dt * load,
            normal,
            to_single(predicted / settings.dt),
            ZERO,
            sums,
            rows,
        )
