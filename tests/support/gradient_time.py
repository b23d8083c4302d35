"""Measures what gradients through the solver with contact inside cost: steps forward and back, by number of worlds.

    python tests/support/gradient_time.py --worlds 64 1024

The worlds are those of ``worlds_throughput.py``, cloths of 200 triangles that fall on spheres. A tape records steps in
contact, and goes back through them. On a GPU, both are CUDA graphs; a row has milliseconds a step: of a model without
gradients, of one with them, of the same on a tape, and back.
"""

import argparse
import sys
import time

import numpy as np
import warp as wp
import worlds_throughput

import warp_bsc as bsc

DT, FALLING = worlds_throughput.DT, 40


def timed(run, device, repeat=3):
    """Returns the shortest time of several runs [s], on a GPU of a graph."""
    run()
    graph = None
    if device.is_cuda:
        with wp.ScopedCapture(device) as capture:
            run()
        graph = capture.graph
    found = []
    for _ in range(repeat):
        wp.synchronize_device(device)
        start = time.perf_counter()
        if graph is None:
            run()
        else:
            wp.capture_launch(graph)
        wp.synchronize_device(device)
        found.append(time.perf_counter() - start)
    return min(found)


class Steps:
    """Steps of worlds in contact, each with states of its own."""

    def __init__(self, worlds, steps, *, requires_grad):
        """Lets cloths fall until they touch, and prepares steps from there."""
        self.model = model = worlds_throughput.build(worlds, requires_grad=requires_grad)
        self.solver = bsc.SolverImplicit(model)
        self.states = [model.state() for _ in range(steps + 1)]
        first, second = model.state(), model.state()
        for _ in range(FALLING // 2):
            self.solver.step(first, second, None, None, DT)
            self.solver.step(second, first, None, None, DT)
        self.begin = first
        self.loss = wp.zeros(1, dtype=float, device=model.device, requires_grad=requires_grad)

    def forward(self):
        """Takes the steps."""
        for name in ("particle_q", "particle_qd"):
            wp.copy(getattr(self.states[0], name), getattr(self.begin, name))
        self.solver.reset(self.states[0])
        for start, end in zip(self.states, self.states[1:], strict=False):
            self.solver.step(start, end, None, None, DT)

    def forward_and_back(self, *, backward=True):
        """Takes the steps on a tape, and goes back through them."""
        with wp.Tape() as tape:
            self.forward()
        if backward:
            self.states[-1].particle_q.grad.fill_(wp.vec3(1.0, 0.3, 0.7))
            tape.backward()
        self.tape = tape


def measure(worlds, steps):
    """Returns milliseconds a step: without gradients, with them, on a tape, and back; and whether all are finite."""
    plain = Steps(worlds, steps, requires_grad=False)
    device = plain.model.device
    without = timed(plain.forward, device)
    del plain
    found = Steps(worlds, steps, requires_grad=True)
    times = [without, timed(found.forward, device), timed(lambda: found.forward_and_back(backward=False), device)]
    both = timed(found.forward_and_back, device)
    finite = np.isfinite(found.begin.particle_qd.grad.numpy()).all(axis=1).mean()
    return [1e3 * t / steps for t in (*times, both - times[2])], finite, found.solver.report.gradient_counts


def main():
    """Prints a row for each number of worlds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 8], help="on a GPU, also 64 1024")
    parser.add_argument("--steps", type=int, default=8)
    parser.add_argument("--device", help="Warp device, such as cpu or cuda:0 (default: the first GPU, else cpu)")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    print("worlds  without  forward  on a tape  back [ms a step]  finite  counts")
    with wp.ScopedDevice(options.device):
        for worlds in options.worlds:
            (without, forward, taped, back), finite, counts = measure(worlds, options.steps)
            print(
                f"{worlds:6} {without:8.3g} {forward:8.3g} {taped:10.3g} {back:6.3g} {finite:16.0%}  {counts}",
                flush=True,
            )


if __name__ == "__main__":
    sys.exit(main())
