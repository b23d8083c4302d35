"""Gradients through VBD over 40 steps of 1/60 s against central differences of the same program.

``python tests/support/implicit_accuracy.py`` prints, for each scene and number of iterations, the largest residual of a
step, and the error of the derivatives by velocities and materials, relative to the largest component. Each is that of
the best of three lengths of the central difference, as float32 rounds short ones and long ones are not linear.
``--json`` writes them to a file as well.
"""

import functools
import warnings

import newton
import numpy as np
import warp as wp
from implicit_scenes import Rollout, cloth_on_slope, hanging_cloth, soft_block
from measured import options_of, report

import warp_bsc as bsc
from warp_bsc.bench.tables import Column

LENGTHS = 3.0, 1.0, 0.3
"""Lengths of central differences, in units of each array."""

UNITS = {"velocity": 3e-3, "tri_materials": 1.0, "edge_bending_properties": 1e-4, "tet_materials": 30.0}
UNITS |= {"particle_mass": 2e-5, "shape_material_mu": 0.01}


def _add_patch(builder, n, at, **options):
    tilt = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.7, 0.2)), 0.2)
    material = {"tri_ke": 80.0, "tri_ka": 60.0, "tri_kd": 5e-3, "edge_ke": 5e-2, "edge_kd": 1e-3}
    size = {"dim_x": n, "dim_y": n, "cell_x": 0.05, "cell_y": 0.05, "mass": 0.002}
    builder.add_cloth_grid(pos=wp.vec3(*at), rot=tilt, vel=wp.vec3(), **size, **material, **options)


def _finished(builder, device):
    builder.color()
    return builder.finalize(device=device, requires_grad=True)


def draped_cloth(device):
    """A cloth of some bending stiffness that falls on a sphere, behind the stage in two substeps."""
    builder = newton.ModelBuilder()
    builder.add_shape_sphere(-1, radius=0.1)
    _add_patch(builder, 4, (-0.11, -0.09, 0.13))
    return _finished(builder, device)


def two_patches(device):
    """A patch thrown at another one that is held at a side, behind the stage."""
    builder = newton.ModelBuilder()
    _add_patch(builder, 3, (-0.05, -0.04, 0.06))
    _add_patch(builder, 4, (-0.1, -0.1, 0.0), fix_left=True)
    return _finished(builder, device)


SCENES = {
    "hanging": (hanging_cloth, None, ["tri_materials", "edge_bending_properties", "particle_mass"]),
    "slope": (cloth_on_slope, None, ["tri_materials", "shape_material_mu"]),
    "block": (soft_block, None, ["tet_materials"]),
    "drape": (draped_cloth, functools.partial(bsc.SolverCCD, substeps=2), ["tri_materials", "edge_bending_properties"]),
    "patches": (two_patches, bsc.SolverCCD, ["tri_materials", "edge_bending_properties"]),
}
"""Each scene with what is around its solver, and the arrays of the model that its gradients are compared for."""


def compare(scene, iterations, polish, steps, device):
    """Yields the name of an input, and its error relative to the largest component."""
    make, wrap, arrays = SCENES[scene]
    model = make(device)
    for name in arrays:
        getattr(model, name).requires_grad = True
    rollout = Rollout(model, steps=steps, iterations=iterations, polish=polish, start=(0.2, 0.1, -0.5), wrap=wrap)
    if wrap is not None:
        rollout.contacts = [None] * steps
    states, rng = rollout.backward(), np.random.default_rng(5)
    yield "residual", float(rollout.adjoint.report.largest_residuals.max())
    if wrap is not None:
        report = rollout.solver.report
        if report.totals.uncertified_steps or report.gradient_counts.layer_passed_steps:
            raise RuntimeError(f"a step is not certified, or contacts passed the layer: {report}")
    free = (model.particle_inv_mass.numpy() > 0.0)[:, None]
    directions = [axis * free for axis in np.eye(3)] + [rng.normal(size=free.shape) * free for _ in range(3)]
    of_velocity = states[0].particle_qd.grad.numpy()
    gradients = np.array([(of_velocity * direction).sum() for direction in directions])
    central = np.array([[_by_velocity(rollout, d, UNITS["velocity"] * h) for h in LENGTHS] for d in directions])
    yield "velocity", np.abs(central - gradients[:, None]).min(axis=1).max() / np.abs(gradients[:3]).max()
    for name in arrays:
        array = getattr(model, name)
        direction = rng.uniform(0.5, 1.0, size=array.numpy().shape) * (array.numpy() != 0.0)
        if direction.ndim == 2:
            direction[:, 2 if name != "edge_bending_properties" else 1 :] = 0.0  # damping has other magnitudes
        gradient = (array.grad.numpy() * direction).sum()
        found = [rollout.central(array, direction, UNITS[name] * h) for h in LENGTHS]
        yield name, min(abs(value - gradient) for value in found) / abs(gradient)


def _by_velocity(rollout, direction, h):
    ends = [rollout.loss(rollout.velocity + sign * h * direction) for sign in (1.0, -1.0)]
    return (ends[0] - ends[1]) / (2.0 * h)


INPUTS = ("iterations", "polish", "residual")


def _describe(row):
    return ", ".join(f"{name} {100.0 * row[name]:.2g}%" for name in row if name not in ("scene", *INPUTS))


COLUMNS = (
    *(Column(name, name, "" if name != "residual" else ".1e") for name in INPUTS),
    Column("errors", _describe, kind="text"),
)


def main():
    """Prints the table."""
    parser = options_of(__doc__, device="cpu")
    parser.add_argument("scenes", nargs="*", default=list(SCENES), help=f"of {', '.join(SCENES)}; default: all")
    parser.add_argument("--steps", type=int, default=40)
    arguments = parser.parse_args()
    warnings.filterwarnings("ignore", "a step of VBD|a step strained|contacts passed")
    wp.config.quiet = True
    rows = []
    for scene in arguments.scenes:
        for iterations, polish in ((10, 0), (20, 0), (20, 3)):
            row = {"scene": scene, "iterations": iterations, "polish": polish}
            found = compare(scene, iterations, polish, arguments.steps, arguments.device)
            rows.append(row | {name: float(value) for name, value in found})
            print(f"{scene} {iterations} {polish}: {rows[-1]['residual']:.1e}; {_describe(rows[-1])}", flush=True)
    devices = [wp.get_device(arguments.device)]
    report(arguments, "implicit_accuracy", "scene", COLUMNS, rows, devices, steps=arguments.steps)


if __name__ == "__main__":
    main()
