"""Parts what touches a shape at the start of a step, where a barrier would be infinite."""

import warp as wp

from ...response.state.structs import Step
from ...response.state.vectors import to_double
from .pairs import NO_FACE, BarrierSettings, Trial

wp.set_module_options({"enable_backward": False})

_PARTED = wp.constant(1e-3)
"""How far what touches a shape is moved off it, as a share of its reach."""
_PARTED_ROUNDED = wp.constant(2.0**-20)
"""The same at least, as a share of its largest coordinate."""


@wp.kernel
def part_touching(
    # in
    step: Step,
    settings: BarrierSettings,
    # in and out
    trial: Trial,
):
    """Moves particles that touch a face of a shape off it a little, to the side to which it faces."""
    v = wp.tid()
    face = trial.touched[v]
    if face == NO_FACE:
        return
    x, mesh = trial.x[v] + wp.vec3(), step.mesh
    a, b, c = trial.x[mesh.faces[face, 0]], trial.x[mesh.faces[face, 1]], trial.x[mesh.faces[face, 2]]
    off = wp.max(_PARTED * settings.reach[v], _PARTED_ROUNDED * wp.max(wp.abs(x)))
    parted = x + off * wp.normalize(wp.cross(b - a, c - a))
    trial.x[v] = parted
    trial.exact[v] = to_double(parted)
    trial.moved[v] = to_double(parted)
    trial.origin[v] = parted
