"""Measures steps a second by the number of worlds: VBD, VBD with self-contact, SolverCCD, and SolverImplicit.

    python tests/support/worlds_throughput.py --worlds 1 64
    torchrun --nproc-per-node 2 tests/support/worlds_throughput.py --worlds 4096  # so many on each of two GPUs

Each world has a cloth of 200 triangles that falls from its own place on a fixed sphere and the ground. VBD gets
Newton's contacts, the others none. The exact detector counts the edges that cross faces of cloth or sphere once a tenth
of the steps. On a GPU, a pair of steps is a CUDA graph, and the memory of a solver and its states is measured.
``--json`` writes the rows to a file as well.
"""

import argparse
import os
import time

import newton
import numpy as np
import warp as wp
from measured import write_measurement

import warp_bsc as bsc
from warp_bsc.bench.crossings import CrossingCounter

DT = 1.0 / 120.0  # [s]
CELLS, SIDE, RADIUS = 10, 0.5, 0.2  # m
CLOTH = {"tri_ke": 1e3, "tri_ka": 1e3, "tri_kd": 1e-1, "edge_ke": 1e-3, "edge_kd": 1e-4, "particle_radius": 0.005}


def build(worlds, *, requires_grad=False):
    """Returns a model of worlds in which cloths start at random places above spheres."""
    world, cell = newton.ModelBuilder(), SIDE / CELLS
    world.add_ground_plane()
    world.add_shape_sphere(-1, radius=RADIUS, xform=wp.transform(wp.vec3(0.0, 0.0, RADIUS), wp.quat_identity()))
    world.add_cloth_grid(
        pos=wp.vec3(-0.5 * SIDE, -0.5 * SIDE, 2.05 * RADIUS),
        rot=wp.quat_identity(),
        vel=wp.vec3(),
        dim_x=CELLS,
        dim_y=CELLS,
        cell_x=cell,
        cell_y=cell,
        mass=0.001,
        **CLOTH,
    )
    world.color()  # of one world: to colour all together takes long
    builder = newton.ModelBuilder()
    builder.replicate(world, worlds)
    positions = np.reshape(builder.particle_q, (worlds, -1, 3))
    positions[:, :, :2] += np.random.default_rng(0).uniform(-0.05, 0.05, (worlds, 1, 2))
    builder.particle_q = [wp.vec3(x) for x in positions.reshape(-1, 3)]
    return builder.finalize(requires_grad=requires_grad)


def vbd(model, self_contact=False):
    """Returns VBD with five iterations."""
    contact = {"particle_self_contact_margin": 0.01, "particle_self_contact_gap": 0.005} if self_contact else {}
    return newton.solvers.SolverVBD(model, iterations=5, particle_enable_self_contact=self_contact, **contact)


SOLVERS = {
    "VBD": vbd,
    "VBD, self-contact": lambda model: vbd(model, self_contact=True),
    "SolverCCD(VBD)": lambda model: bsc.SolverCCD(vbd(model)),
    "SolverImplicit": bsc.SolverImplicit,
}


class Run:
    """A simulation of worlds with a solver."""

    def __init__(self, make_solver, model):
        self.model = model
        self.solver = make_solver(model)
        self.states, self.control = [model.state(), model.state()], model.control()
        self.pipeline = self.contacts = self._graph = None
        if not isinstance(self.solver, bsc.SolverCCD):
            self.pipeline = newton.CollisionPipeline(model)
            self.contacts = self.pipeline.contacts()

    def take_pair(self):
        """Takes two steps, on a GPU from a CUDA graph after the first call."""
        device = self.model.device
        if self._graph is not None:
            wp.capture_launch(self._graph)
            return
        self._step_twice()
        if device.is_cuda:
            with wp.ScopedCapture(device) as capture:
                self._step_twice()
            self._graph = capture.graph

    def _step_twice(self):
        for start, end in (self.states, self.states[::-1]):
            start.clear_forces()
            if self.pipeline is not None:
                self.pipeline.collide(start, self.contacts)
            self.solver.step(start, end, self.control, self.contacts, DT)


def measure(make_solver, model, counter, steps):
    """Returns rates, bytes on a GPU or None, crossings found, and steps not certified or None.

    Rates are steps a second by the clock and by processor time.
    """
    device, memory = model.device, None
    used = wp.get_mempool_used_mem_current(device) if device.is_mempool_enabled else None
    run = Run(make_solver, model)
    run.take_pair()
    if used is not None:
        memory = wp.get_mempool_used_mem_current(device) - used
    crossings, clock, processor = 0, 0.0, 0.0
    for _ in range(10):
        wp.synchronize_device(device)
        begin = time.perf_counter(), time.process_time()
        for _ in range(steps // 20):
            run.take_pair()
        wp.synchronize_device(device)
        clock += time.perf_counter() - begin[0]
        processor += time.process_time() - begin[1]
        crossings += counter.count(run.states[0])
    taken = 20 * (steps // 20)
    uncertified = run.solver.report.totals.uncertified_steps if isinstance(run.solver, bsc.SolverCCD) else None
    return (taken / clock, taken / processor), memory, crossings, uncertified


def main():
    """Prints a row for each solver and number of worlds: steps a second by the clock and by processor time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 64], help="on a GPU, also 1024 4096")
    parser.add_argument("--steps", type=int, default=100, help="a multiple of 20")
    parser.add_argument("--solvers", nargs="+", choices=SOLVERS, default=list(SOLVERS))
    default = "that of torchrun's LOCAL_RANK, else the first GPU, else cpu"
    parser.add_argument("--device", help=f"Warp device, such as cpu or cuda:0 (default: {default})")
    parser.add_argument("--json", metavar="FILE", help="file to which the rows are written as well")
    options = parser.parse_args()
    if options.steps < 20 or options.steps % 20:
        parser.error(f"--steps must be a multiple of 20, not {options.steps}")
    wp.config.log_level = wp.LOG_WARNING
    rank = os.environ.get("LOCAL_RANK")
    of_rank = None if rank is None else f"cuda:{rank}"
    with wp.ScopedDevice(options.device or of_rank or wp.get_preferred_device()):
        rows = []
        head = f"{'solver':20}{'worlds':>7}{'steps/s':>10}{'by processor':>14}{'MB/world':>10}{'crossings':>11}"
        print(f"{head}{'uncertified':>13}")
        for worlds in options.worlds:
            model = build(worlds)
            counter = CrossingCounter(model)
            for name in options.solvers:
                (by_clock, by_processor), memory, crossings, uncertified = measure(
                    SOLVERS[name], model, counter, options.steps
                )
                of_world = "-" if memory is None else f"{memory / worlds / 1e6:.3g}"
                row = f"{name:20}{worlds:>7}{by_clock:>10.3g}{by_processor:>14.3g}{of_world:>10}{crossings:>11}"
                rates = {"clock": by_clock, "processor": by_processor}
                rows.append({"solver": name, "worlds": worlds, "steps_per_second": rates, "bytes": memory})
                rows[-1] |= {"crossings": crossings, "uncertified_steps": uncertified}
                print(f"{row}{'-' if uncertified is None else uncertified:>13}", flush=True)
        if options.json:
            found = {"benchmark": "worlds_throughput", "steps": options.steps, "rows": rows}
            write_measurement(options.json, found, [wp.get_device()])


if __name__ == "__main__":
    main()
