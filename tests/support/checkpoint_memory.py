"""Measures memory and time of gradients through many steps of a soft body, with checkpoints and without.

    python tests/support/checkpoint_memory.py
    python tests/support/checkpoint_memory.py --every 300 --steps 300

A block of 4,000 tetrahedra falls on a sphere, and slides off it onto the ground. A row is measured in a process of its
own: megabytes that steps, gradients and their states take at most, beside what the solver has after its first step;
milliseconds a step of a run without a tape, of the way forward on a tape and of the way back, on a CPU of all its
threads, so that other processes matter little; and the last one as a multiple of the first.
"""

import argparse
import multiprocessing
import resource
import sys
import time

import newton
import numpy as np
import warp as wp

import warp_bsc as bsc

DT = 1.0 / 60.0


def build(device):
    """A block of 4,000 tetrahedra above a sphere and the ground."""
    builder = newton.ModelBuilder()
    at = wp.transform(wp.vec3(0.02, 0.01, 0.2), wp.quat_identity())
    builder.add_shape_sphere(-1, radius=0.2, xform=at)
    builder.add_ground_plane()
    block = {"dim_x": 10, "dim_y": 10, "dim_z": 8, "cell_x": 0.04, "cell_y": 0.04, "cell_z": 0.04}
    block |= {"density": 200.0, "k_mu": 2e4, "k_lambda": 2e4, "k_damp": 0.0, "particle_radius": 0.0}
    place = {"pos": wp.vec3(-0.2, -0.2, 0.41), "rot": wp.quat_identity(), "vel": wp.vec3(0.0, 0.0, -1.0)}
    builder.add_soft_grid(**place, **block)
    return builder.finalize(device=device, requires_grad=True)


def used(device):
    """Returns the most memory so far [MB]."""
    if device.is_cuda:
        return wp.get_mempool_used_mem_high(device) / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def measure(device, steps, every):
    """Prints a row: for steps that the tape keeps where ``every`` is 0, else with checkpoints."""
    wp.config.log_level = wp.LOG_WARNING
    with wp.ScopedDevice(device):
        model = build(device)
        solver = bsc.SolverImplicit(model, friction=0.2)
        device, first, last = model.device, model.state(), model.state()

        def step(k, start, end):
            solver.step(start, end, None, None, DT)

        clock = time.perf_counter if device.is_cuda else time.process_time

        def timed(function):
            wp.synchronize_device(device)
            begin = clock()
            function()
            wp.synchronize_device(device)
            return 1e3 * (clock() - begin) / steps

        def run(count, states):
            solver.reset(first)
            for k in range(count):
                step(k, states[k % len(states)], states[(k + 1) % len(states)])

        def record(count):
            """Takes steps on a tape, and returns it."""
            between = [] if every else [model.state() for _ in range(count - 1)]
            with wp.Tape() as tape:
                if every:
                    solver.reset(first)
                    bsc.checkpointed(solver, step, first, last, count, every=every)
                else:
                    run(count, [first, *between, last])
            return tape

        record(2).backward()  # loads kernels
        run(steps, [model.state(), model.state()])  # makes buffers as large as they have to be
        without = timed(lambda: run(steps, [model.state(), model.state()]))
        before = used(device)
        tapes = []
        forward = timed(lambda: tapes.append(record(steps)))
        last.particle_q.grad.fill_(wp.vec3(0.0, 0.0, 1.0 / model.particle_count))
        back = timed(tapes[0].backward)
        is_finite = np.isfinite(first.particle_qd.grad.numpy()).all()
        row = f"{every or '-':>5} {used(device) - before:9.1f} {without:9.1f} {forward:9.1f} {back:7.1f}"
        print(f"{row} {back / without:6.2f}   {is_finite}  {solver.report.gradient_counts}", flush=True)


def main():
    """Prints the rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--every", type=int, nargs="+", default=[0, 1, 18, 75], help="0: the tape keeps all steps")
    parser.add_argument("--device", help="Warp device, such as cpu or cuda:0 (default: the first GPU, else cpu)")
    options = parser.parse_args()
    print("every   MB more   without   forward    back  ratio   finite  counts")
    for every in options.every:
        process = multiprocessing.get_context("spawn").Process(
            target=measure, args=(options.device, options.steps, every)
        )
        process.start()
        process.join()


if __name__ == "__main__":
    sys.exit(main())
