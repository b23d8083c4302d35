"""Compares the gradient with respect to every input of SolverImplicit with central differences, by kind of contact.

    python tests/support/gradient_table.py
    python tests/support/gradient_table.py --scenes rope_over_bar --inputs friction spring_stiffness --json table.json

The scenes are those of ``gradient_scenes.py``: a few steps on a tape, and a weighted sum of positions and velocities at
their end. The steps are solved in float64, until forces balance to 1e-9 of a particle's weight, see
``gradient_reference.py``. Each input is moved along a random way by 1e-4, 1e-5 and 1e-6 of its size, back and forth:
0.1 m, 1 m/s, 0.1 N, 1 mN m, an angle of 1 rad, or its values; gravity and coefficients of friction, from which the
solver computes something in float32, by 1e-2, 1e-3 and 1e-4. The deviation is the difference between how the sum
changes and how its gradient says, as a share of the changes by all components, added as independent ones are. Columns
of materials, places and rotations, and forces and moments are moved one after the other, and the worst counts.

A cell has the digits to which both agree, by size of the difference: "4 6 7" are deviations below 1e-4, 1e-6 and 1e-7.
They grow by two each time until rounding limits them; those of a wrong gradient do not. "-" is an input that does not
act in a scene: its gradient is 0, and so is each difference. First come the numbers of contacts that push at the ends
of steps. The program fails where a kind of contact is missing, a step does not converge, or no difference agrees.
"""

import collections
import sys

import numpy as np
import warp as wp
from gradient_reference import BETWEEN_BODIES, KINDS
from gradient_scenes import INPUTS, SCENES, STEPS, marks_of
from measured import options_of, report

from warp_bsc.bench.tables import Column

LIMIT = 5e-5
"""Largest deviation of a gradient."""
OF_ROUNDED = {"shape_material_mu": 3e-4, "friction": 3e-4}
"""The same of inputs from which the coefficient of a pair is computed in float32."""
_NOISE = 1e-9
"""Difference of two runs that begin alike, on a GPU, where an input does not act."""
_POSE = slice(3), slice(3, None)
PARTS = dict.fromkeys(("poses", "body_q", "body_qd", "body_f"), _POSE)
PARTS |= {"tri_materials": (0, 1, 2), "tet_materials": (0, 1, 2), "edge_bending_properties": (0, 1)}
"""Parts of the last dimension of inputs that are moved by themselves."""
TITLES = {
    "places": "particle_q, kinematic",
    "poses": "body_q, kinematic",
    "friction": "friction of particles",
}
"""Names of inputs where those of a program are not those of arrays."""


def contacts_of(program):
    """Returns how many contacts push in a run of a program, by kind.

    Raises:
        RuntimeError: If one of the kinds that it is for is missing, or a step has none.
    """
    steps = program.reference.contacts
    found = dict(sum(map(collections.Counter, steps), collections.Counter()))
    if not found.keys() >= set(program.kinds) or not all(any(step.values()) for step in steps):
        raise RuntimeError(f"contacts are missing: {steps} by step")
    return found


def deviations(program, gradients, names, steps=STEPS, parts=PARTS):
    """Returns the deviations of gradients by input and size of the difference, None where the input does not act."""
    held, found = program.reference.held, {}
    for name in names:
        by_part = []
        for part in parts.get(name, (slice(None),)):
            moves = [program.difference(name, held, step, part) for step in steps]
            by_part.append([_deviation(gradients[name] * way, change) for change, way in moves])
        found[name] = np.max(by_part, axis=0).tolist() if np.any(by_part) else None
    return found


def _deviation(changes, change):
    size = np.linalg.norm(changes)
    if not size:
        return 0.0 if abs(change) < _NOISE else np.inf
    return abs(changes.sum() - change) / size


def limit_of(name):
    """Returns the largest deviation of an input."""
    return OF_ROUNDED.get(name, LIMIT)


def digits(found):
    """Returns the text of a cell."""
    return " ".join(str(int(np.clip(-np.log10(max(each, 1e-9)), 0, 9))) for each in found)


def judge(scene, device, names):
    """Returns the cells of a scene by row, plain data: deviations, and what is shown of them."""
    program = scene(device)
    program.refine()
    gradients = program.gradients()
    cells = {f"{kind} contacts": {"shown": str(n)} for kind, n in contacts_of(program).items()}
    for name, found in deviations(program, gradients, [name for name in names if name in gradients]).items():
        fails = found is not None and not min(found) < limit_of(name)
        cells[name] = {"deviations": found, "fails": fails, "shown": "-" if found is None else digits(found)}
    return cells


def main():
    """Prints a row for each input, and fails if a gradient is wrong."""
    scenes = {scene.__name__: scene for scene in SCENES if not any(mark.args[0] for mark in marks_of(scene))}
    parser = options_of(__doc__, device="cpu")
    parser.add_argument("--scenes", nargs="+", choices=scenes, default=list(scenes), metavar="SCENE")
    parser.add_argument("--inputs", nargs="+", choices=INPUTS, default=INPUTS, metavar="INPUT")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    device = wp.get_device(options.device)
    cells = {name: judge(scenes[name], device, options.inputs) for name in options.scenes}
    inputs = [*(f"{kind} contacts" for kind in (*KINDS, BETWEEN_BODIES)), *options.inputs]
    rows = [{"input": TITLES.get(row, row)} | {name: of.get(row) for name, of in cells.items()} for row in inputs]
    rows = [row for row in rows if any(row[name] for name in cells)]
    columns = [Column(name.replace("_", " "), f"{name}.shown", kind="text") for name in cells]
    first = Column("input", kind="word")
    report(options, "gradients", first, columns, rows, [device], name="input", scenes=options.scenes, steps=STEPS)
    return int(any(cell.get("fails") for of in cells.values() for cell in of.values()))


if __name__ == "__main__":
    sys.exit(main())
