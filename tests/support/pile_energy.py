"""Energy of a pile of sheets that falls on the ground: kinetic, potential and that of its membranes.

``python tests/support/pile_energy.py --sheets 50 --substeps auto`` prints it every fifteen steps of 1/600 s, and how
much it has gained at most since it was least. A pile of very many layers gains energy while it comes to rest, as
dividing planes stop layers that fall together.
"""

import argparse
import warnings

import newton
import numpy as np
import warp as wp

import warp_bsc as bsc

DT, GRAVITY, CELLS, CELL = 1.0 / 600.0, 9.81, 10, 0.01


def pile(sheets, device="cpu"):
    """Sheets of 200 triangles, each a millimetre above the other, 2 cm above the ground."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    mass = 0.3 * (CELLS * CELL) ** 2 / (CELLS + 1) ** 2
    size = {"dim_x": CELLS, "dim_y": CELLS, "cell_x": CELL, "cell_y": CELL, "mass": mass, "particle_radius": 0.002}
    material = {"tri_ke": 1e3, "tri_ka": 1e3, "tri_kd": 0.0, "edge_ke": 1e-3, "edge_kd": 1e-4}
    for sheet in range(sheets):
        at = wp.vec3(0.0, 0.0, 0.02 + 0.001 * sheet)
        builder.add_cloth_grid(pos=at, rot=wp.quat_identity(), vel=wp.vec3(), **size, **material)
    builder.color()
    return builder.finalize(device=device)


def energies(model, state):
    """Returns kinetic and potential energy, and that of the membranes above their rest [J]."""
    x, v = state.particle_q.numpy().astype(float), state.particle_qd.numpy().astype(float)
    motion = (model.particle_mass.numpy() * (0.5 * (v**2).sum(axis=1) + GRAVITY * x[:, 2])).sum()
    a, b, c = x[model.tri_indices.numpy()].transpose(1, 0, 2)
    gradient = np.stack([b - a, c - a], axis=2) @ model.tri_poses.numpy().astype(float)
    mu, lame = model.tri_materials.numpy()[:, :2].astype(float).T
    lame = lame + mu  # as in warp_bsc/implicit/energies.py
    area = np.linalg.norm(np.cross(gradient[:, :, 0], gradient[:, :, 1]), axis=1)
    density = 0.5 * mu * ((gradient**2).sum(axis=(1, 2)) - 2.0)
    density += 0.5 * lame * ((area - 1.0 - mu / lame) ** 2 - (mu / lame) ** 2)
    return motion, (model.tri_areas.numpy() * density).sum()


def rest(sheets, steps, *, substeps="auto", device="cpu", show=print):
    """Steps a pile, and returns its total energy after each step [J] and the report; ``show`` gets some lines."""
    model = pile(sheets, device)
    solver = bsc.SolverCCD(newton.solvers.SolverVBD(model, iterations=10), substeps=substeps)
    state, end, control, totals = model.state(), model.state(), model.control(), []
    for step in range(steps):
        state.clear_forces()
        solver.step(state, end, control, None, DT)
        state, end = end, state
        motion, membranes = energies(model, state)
        totals.append(motion + membranes)
        if step % 15 == 0 or step == steps - 1:
            show(f"step {step}: {totals[-1]:.4f} J, of which {membranes:.4f} J in membranes")
    return np.array(totals), solver.report


def gained(totals):
    """Returns the largest rise of the energy above its least value so far [J]."""
    return (totals - np.minimum.accumulate(totals)).max()


def main():
    """Steps a pile, and prints its energy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sheets", type=int, default=50)
    parser.add_argument("--steps", type=int, default=110)
    parser.add_argument("--substeps", choices=("auto", "none"), default="auto")
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    warnings.filterwarnings("ignore", "contacts strained")
    wp.config.quiet = True
    substeps = "auto" if arguments.substeps == "auto" else None
    options = {"substeps": substeps, "device": arguments.device, "show": lambda line: print(line, flush=True)}
    totals, report = rest(arguments.sheets, arguments.steps, **options)
    print(f"gained at most {gained(totals):.4f} J, begun with {totals[0]:.4f} J; {report}")


if __name__ == "__main__":
    main()
