"""Counts the tetrahedra that steps invert, by the exact detector, and measures the cost of reports and prevention.

    python tests/support/inverting_steps.py throw soft_bowl softbody_hanging --steps 60

Scenes with soft bodies of ``warp-bsc bench response`` at 1/60 s, examples of Newton that are given by their names, at
the length of their steps, and a block that is thrown at a ball at 20 m/s. Each is stepped by VBD alone, with Newton's
contacts, and with stages that leave, report and prevent inversions. Times are of the processor, without the first step.
``--json`` writes the rows to a file as well.
"""

import argparse
import importlib
import time

import newton
import newton.examples
import numpy as np
import warp as wp
from measured import write_measurement
from newton.viewer import ViewerNull

import warp_bsc as bsc
from warp_bsc.bench.scenes.contact import SCENES, build_scene
from warp_bsc.bench.scenes.simulation import Simulation
from warp_bsc.response.state.mesh import ModelMesh

MODES = "plain", "allowed", "reported", "prevented"
EXAMPLES = {"softbody_hanging": "softbody", "softbody_dropping_to_cloth": "multiphysics"}
BLOCK = {"density": 100.0, "k_mu": 1e4, "k_lambda": 1e4, "k_damp": 1e-3, "particle_radius": 0.002}


class Counted:
    """A solver whose steps are timed, and looked at by the exact detector.

    Attributes:
        seconds: Processor time of each step.
        inverting: Tetrahedra that each step inverts and that were not inverted at its start.
        inverted: Tetrahedra that were inverted at the end of the last step.
    """

    def __init__(self, solver, model):
        self._solver = solver
        self.detector = bsc.CollisionDetector(ModelMesh(model), method="exact")
        self.seconds, self.inverting, self.inverted = [], [], 0

    def __getattr__(self, name):
        return getattr(self._solver, name)

    def _positions(self, state):
        x = wp.empty(self.detector.mesh.vertex_count, dtype=wp.vec3)
        self.detector.mesh.positions(state.particle_q, state.body_q, x)
        return x

    def step(self, start, end, *arguments, **options):
        before = self._positions(start)
        begin = time.process_time()
        self._solver.step(start, end, *arguments, **options)
        self.seconds.append(time.process_time() - begin)
        after, detector = self._positions(end), self.detector
        was = detector.find_inversions(before)
        self.inverting.append(len(np.setdiff1d(detector.inversions(before, after).tets, was)))
        self.inverted = len(detector.find_inversions(after))


def stage_options(mode):
    return None if mode == "plain" else {"inversions": mode}


def run_scene_of_bench(name, mode, steps):
    """Takes steps of a scene of the bench, and returns its solver."""
    scene = build_scene(name, "vbd")
    simulation = Simulation(scene, "vbd", 60, has_contacts=mode == "plain", stage_options=stage_options(mode))
    solver = simulation.solver = Counted(simulation.solver, scene.model)
    simulation.run(steps / 60, lambda step, steps: None)
    return solver


def run_example_of_newton(name, mode, steps):
    """Takes steps of an example of Newton, and returns its solver."""
    module = importlib.import_module(f"newton.examples.{EXAMPLES[name]}.example_{name}")

    class Example(module.Example):
        def capture(self):
            self.graph = None

    example = Example(ViewerNull(), Example.create_parser().parse_args([]))
    solver = example.solver if mode == "plain" else bsc.SolverCCD(example.solver, **stage_options(mode))
    example.solver = Counted(solver, example.model)
    while len(example.solver.seconds) < steps:
        example.step()
    return example.solver


def run_throw(mode, steps):
    """Takes steps of a block that flies at a ball at 20 m/s, and returns its solver."""
    builder = newton.ModelBuilder()
    builder.add_shape_sphere(-1, radius=0.2)
    size = {"dim_x": 8, "dim_y": 8, "dim_z": 8, "cell_x": 0.05, "cell_y": 0.05, "cell_z": 0.05}
    turn = wp.quat_rpy(0.1, 0.2, 0.3)
    builder.add_soft_grid(pos=wp.vec3(-0.2, -0.2, 0.32), rot=turn, vel=wp.vec3(0.0, 0.0, -20.0), **size, **BLOCK)
    builder.color()
    model = builder.finalize()
    inner = newton.solvers.SolverVBD(model, iterations=10)
    pipeline = newton.CollisionPipeline(model) if mode == "plain" else None
    contacts = pipeline.contacts() if pipeline else None
    solver = Counted(inner if mode == "plain" else bsc.SolverCCD(inner, **stage_options(mode)), model)
    start, end = model.state(), model.state()
    for _ in range(steps):
        start.clear_forces()
        if pipeline:
            pipeline.collide(start, contacts)
        solver.step(start, end, None, contacts, 1.0 / 60.0)
        start, end = end, start
    return solver


def run(name, mode, steps):
    """Takes steps of a scene in a mode, and returns its solver."""
    if name == "throw":
        return run_throw(mode, steps)
    return (run_example_of_newton if name in EXAMPLES else run_scene_of_bench)(name, mode, steps)


def main():
    """Prints a row for each scene and mode."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = ["throw", *SCENES, *EXAMPLES]
    parser.add_argument("scenes", nargs="*", default=["throw"], choices=names, metavar="SCENE", help=", ".join(names))
    parser.add_argument("--steps", type=int, default=60, help="rounded up to pairs, or frames of examples")
    parser.add_argument("--json", metavar="FILE", help="file to which the rows are written as well")
    options = parser.parse_args()
    rows = []
    wp.config.log_level = wp.LOG_WARNING
    print(
        f"{'scene':28}{'mode':11}{'steps':>6}{'ms':>8}{'mean':>8}{'inverting steps':>17}{'tets':>8}{'left':>6}  report"
    )
    for name in options.scenes:
        for mode in MODES:
            solver = run(name, mode, options.steps)
            times, counts = 1e3 * np.array(solver.seconds[1:]), np.array(solver.inverting)
            rows.append({"scene": name, "mode": mode, "steps": len(counts), "milliseconds": float(times.mean())})
            rows[-1] |= {"inverting_steps": int(np.count_nonzero(counts)), "inverted": int(counts.sum())}
            rows[-1]["truncated_steps"] = None if mode == "plain" else solver.report.totals.truncated_steps
            row = f"{name:28}{mode:11}{len(counts):>6}{np.median(times):>8.1f}{times.mean():>8.1f}"
            row += f"{np.count_nonzero(counts):>17}{counts.sum():>8}{solver.inverted:>6}"
            print(f"{row}  {'' if mode == 'plain' else solver.report}", flush=True)
    if options.json:
        found = {"benchmark": "inverting_steps", "rows": rows}
        write_measurement(options.json, found, [wp.get_device()])


if __name__ == "__main__":
    main()
