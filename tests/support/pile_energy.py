"""A pile of sheets that falls on the ground: its kinetic, potential and membrane energy, and the time of its steps.

``python tests/support/pile_energy.py --sheets 50`` prints energies every fifteen steps of 1/600 s, how much they have
gained at most since they were least, the median time of a step, and the crossings at the end; ``--cells 69`` makes
sheets of 9,522 triangles. ``--solver`` is ``stage``, ``SolverCCD(SolverVBD)``; ``implicit``, ``SolverImplicit``; or
``vbd``, or ``vbd-self-contact``, which pushes sheets apart from 0.5 mm on. On CUDA, steps run in a graph.
"""

import argparse
import functools
import time
import warnings

import newton
import numpy as np
import warp as wp

import warp_bsc as bsc

DT, GRAVITY, CELLS, CELL = 1.0 / 600.0, 9.81, 10, 0.01


def pile(sheets, device="cpu", cells=CELLS):
    """Sheets of twice ``cells`` squared triangles, each a millimetre above the other, 2 cm above the ground."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    mass = 0.3 * (cells * CELL) ** 2 / (cells + 1) ** 2
    size = {"dim_x": cells, "dim_y": cells, "cell_x": CELL, "cell_y": CELL, "mass": mass, "particle_radius": 0.002}
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


class Steps:
    """Steps of a pile by a solver, in CUDA graphs on a GPU after the first two."""

    def __init__(self, model, solver):
        """Prepares steps."""
        self.solver = solver
        self.states, self.control, self._graphs = [model.state(), model.state()], model.control(), []
        self.device, self.times, self._steps = model.device, [], 0
        self.model, self._contacts = model, None
        if isinstance(solver, newton.solvers.SolverVBD):  # which has contact with the ground from Newton's contacts
            self._contacts = model.contacts()

    def _step(self):
        self.states[0].clear_forces()
        if self._contacts is not None:
            self.model.collide(self.states[0], self._contacts)
        self.solver.step(*self.states, self.control, self._contacts, DT)

    def take(self):
        """Takes a step, and keeps its time [s]; the end is ``states[0]``."""
        begin = time.perf_counter()
        if not self.device.is_cuda or self._steps < 2:
            self._step()
        else:
            if len(self._graphs) < 2:  # one from each of both states
                with wp.ScopedCapture(self.device) as capture:
                    self._step()
                self._graphs.append(capture.graph)
            wp.synchronize_device(self.device)
            begin = time.perf_counter()
            wp.capture_launch(self._graphs[self._steps % 2])
        wp.synchronize_device(self.device)
        self.times.append(time.perf_counter() - begin)
        self.states.reverse()
        self._steps += 1


_SELF_CONTACT = {"particle_self_contact_radius": 0.0005, "particle_self_contact_margin": 0.001}
_VBD = functools.partial(newton.solvers.SolverVBD, iterations=10)
SOLVERS = {
    "stage": lambda model: bsc.SolverCCD(_VBD(model)),
    "implicit": bsc.SolverImplicit,
    "vbd": _VBD,
    "vbd-self-contact": functools.partial(_VBD, particle_enable_self_contact=True, **_SELF_CONTACT),
}


def rest(sheets, steps, *, device="cpu", cells=CELLS, solver="stage", show=print):
    """Steps a pile, and returns its total energy after each step [J] and its steps; ``show`` gets some lines."""
    model = pile(sheets, device, cells)
    pile_steps, totals = Steps(model, SOLVERS[solver](model)), []
    for step in range(steps):
        pile_steps.take()
        motion, membranes = energies(model, pile_steps.states[0])
        totals.append(motion + membranes)
        if step % 15 == 0 or step == steps - 1:
            show(f"step {step}: {totals[-1]:.4f} J, of which {membranes:.4f} J in membranes")
    return np.array(totals), pile_steps


def gained(totals):
    """Returns the largest rise of the energy above its least value so far [J]."""
    return (totals - np.minimum.accumulate(totals)).max()


def main():
    """Steps a pile, and prints its energy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sheets", type=int, default=50)
    parser.add_argument("--cells", type=int, default=CELLS, help="cells along each side of a sheet")
    parser.add_argument("--steps", type=int, default=110)
    parser.add_argument("--solver", choices=SOLVERS, default="stage")
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    warnings.filterwarnings("ignore", "a step strained")
    wp.config.quiet = True
    options = {"device": arguments.device, "cells": arguments.cells, "solver": arguments.solver}
    totals, steps = rest(arguments.sheets, arguments.steps, **options, show=lambda line: print(line, flush=True))
    milliseconds = 1e3 * np.array(steps.times)
    print(f"gained at most {gained(totals):.4f} J, begun with {totals[0]:.4f} J")
    parts = ", ".join(f"{np.median(part):.1f}" for part in np.array_split(milliseconds[5:], 3))
    print(f"a step: median {np.median(milliseconds):.1f} ms, of each third {parts} ms")
    if hasattr(steps.solver, "report"):
        print(steps.solver.report.totals)
    model = steps.model
    mesh = bsc.CollisionMesh(model.tri_indices, model.particle_count, device=model.device)
    crossings = bsc.CollisionDetector(mesh).find_intersections(steps.states[0].particle_q)
    print(f"{len(crossings)} edges meet faces at the end")


if __name__ == "__main__":
    main()
