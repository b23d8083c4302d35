"""Measures how fast a lone patch of cloth can fly in Newton's VBD: with self-contact, without, and with SolverCCD.

    python examples/speed_limit.py

Nothing is near the patch and no force acts on it, so it should keep its speed. With self-contact, VBD cuts the path of
every particle to ``0.5 * dat_conservative_bound_relaxation * (margin + gap)`` after a detection, near something or not.
``SolverCCD`` cuts only paths that end in a contact, and lifts the limit of VBD behind which it is put.
"""

import argparse

import newton
import numpy as np
import warp as wp
from rich.console import Console
from rich.table import Table

import warp_bsc as bsc

SPEEDS = (1.0, 10.0, 60.0)
"""The patch starts at these speeds [m/s]."""
DT, STEPS = 1.0 / 600.0, 60
MARGIN, GAP, RELAXATION = 0.002, 0.0015, 0.85
"""Those of Newton's example ``cloth_twist`` [m], and VBD's default."""
LIMIT = 0.5 * RELAXATION * (MARGIN + GAP) / DT
"""Speed of a particle that VBD with self-contact cuts in every step [m/s]."""


def vbd(model, self_contact=False):
    """Returns VBD with the settings of Newton's example ``cloth_twist``."""
    return newton.solvers.SolverVBD(
        model,
        iterations=4,
        particle_enable_self_contact=self_contact,
        particle_self_contact_margin=MARGIN,
        particle_self_contact_gap=GAP,
        particle_vertex_contact_buffer_size=64,
        particle_edge_contact_buffer_size=128,
    )


SOLVERS = {
    "VBD with self-contact": lambda model: vbd(model, self_contact=True),
    "VBD without self-contact": vbd,
    "SolverCCD(VBD without self-contact)": lambda model: bsc.SolverCCD(vbd(model)),
    "SolverCCD(VBD with self-contact)": lambda model: bsc.SolverCCD(vbd(model, self_contact=True)),
}


def measure_speed(make_solver, speed):
    """Returns the mean speed of the patch in the second half of its flight [m/s]."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    cloth = {"dim_x": 10, "dim_y": 10, "cell_x": 0.01, "cell_y": 0.01, "mass": 2.0e-5, "tri_ke": 1.0e3, "tri_ka": 1.0e3}
    cloth |= {"tri_kd": 2.0e-4, "edge_ke": 1.0e-3, "edge_kd": 1.0e-2}
    builder.add_cloth_grid(pos=wp.vec3(), rot=wp.quat_identity(), vel=wp.vec3(0.0, 0.0, speed), **cloth)
    builder.color()
    model = builder.finalize()
    solver = make_solver(model)
    state_0, state_1, control = model.state(), model.state(), model.control()
    heights = []
    for _ in range(STEPS):
        state_0.clear_forces()
        solver.step(state_0, state_1, control, None, DT)
        state_0, state_1 = state_1, state_0
        heights.append(state_0.particle_q.numpy()[:, 2].mean(dtype=np.float64))
    return np.diff(heights[STEPS // 2 :]).mean() / DT


def main():
    """Prints the speeds as a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", help="Warp device, such as cpu or cuda:0 (default: the first GPU, else cpu)")
    device = parser.parse_args().device
    wp.config.log_level = wp.LOG_WARNING
    table = Table(
        "started at",
        *SOLVERS,
        title=f"Speed of a lone patch after {STEPS} steps of 1/{1.0 / DT:.0f} s [m/s]",
        caption=f"0.5 x {RELAXATION} x ({MARGIN} m + {GAP} m) a step is {LIMIT:.2f} m/s",
    )
    with wp.ScopedDevice(device or wp.get_preferred_device()):
        for speed in SPEEDS:
            measured = [measure_speed(make_solver, speed) for make_solver in SOLVERS.values()]
            table.add_row(*(f"{value:.2f}" for value in (speed, *measured)))
    Console().print(table)


if __name__ == "__main__":
    main()
