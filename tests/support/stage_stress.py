"""Random steps of the collision stage, judged by exact detection.

Half of them are single steps from random positions to random ones, most of them degenerate. The others are those of
simulations: the scenes of ``random_scenes.py``, with VBD, XPBD and Style3D, with contacts passed on and not. With
``--implicit`` all steps are those of ``SolverImplicit``.

``python tests/support/stage_stress.py --steps 10000`` prints a line for each kind of scene, and the seed of each step
that a certificate was wrong about. The exit status is then 1.
"""

import argparse
import contextlib
import io
import sys
from dataclasses import dataclass

import newton
import numpy as np
import warp as wp
from newton_scenes import DT, DistanceRollout, Rollout, Still
from random_scenes import KINDS, Settings
from random_scenes import Scene as Simulation
from rich.console import Console
from rich.table import Table

import warp_bsc as bsc
from warp_bsc.implicit.solver_implicit import SolverImplicit

_CELLS = 3


@dataclass
class Scene:
    """Sheets side by side along x at random, and how far they move.

    Attributes:
        gap: Distance between sheets [m].
        path: Length of the longest motion of a vertex along each axis [m].
        noise: Standard deviation of heights [m]; 0 for one plane.
        tilted: Whether the sheets are turned at random, so that coordinates are rounded.
        lattice: Whether sheets lie on or near each other, and all coordinates, at the end too, are multiples of half a
            cell, so that many pairs touch.
        crossing: Whether the middle sheet is turned through the others.
        held: Share of vertices that the stage cannot move.
        min_distance: Minimum distance of the stage [m].
    """

    gap: float
    path: float
    noise: float = 0.0
    tilted: bool = False
    lattice: bool = False
    crossing: bool = False
    held: float = 0.0
    min_distance: float | None = None


SCENES = {
    "one plane, gap 1e-12 m, path 1 mm": Scene(1e-12, 1e-3),
    "one plane, gap 1e-8 m, path 5 cm": Scene(1e-8, 0.05),
    "one plane, gap 1e-7 m, path 1 m": Scene(1e-7, 1.0),
    "one plane, gap 1e-5 m, path 100 m": Scene(1e-5, 100.0),
    "one plane, gap 1e-6 m, some held": Scene(1e-6, 0.2, held=0.1),
    "near planes, gap 1e-8 m": Scene(1e-8, 0.05, noise=1e-8),
    "near planes, gap 1e-12 m": Scene(1e-12, 1e-3, noise=1e-12),
    "tilted plane, gap 1e-8 m": Scene(1e-8, 0.05, tilted=True),
    "tilted plane, gap 1e-6 m, path 10 m": Scene(1e-6, 10.0, tilted=True),
    "touching, on a lattice": Scene(0.0, 0.5, lattice=True),
    "crossing": Scene(1e-3, 0.3, crossing=True, noise=1e-2),
    "crossing, some held": Scene(1e-3, 0.3, crossing=True, noise=1e-2, held=0.3),
    "minimum distance, one plane, gap 1e-6 m": Scene(1e-6, 0.05, min_distance=1e-3),
    "minimum distance, near planes": Scene(5e-3, 0.2, noise=1e-3, min_distance=2e-3),
    "minimum distance, gap 1e-12 m": Scene(1e-12, 1e-3, min_distance=1e-3),
    "minimum distance, touching": Scene(0.0, 0.3, lattice=True, min_distance=1e-3),
}


@dataclass
class Judged:
    """Counts of steps.

    Attributes:
        steps: All steps.
        touching: Steps that excluded contacts, or at whose start something crossed.
        changed: Steps in which the path of a vertex was cut or a vertex was frozen.
        uncertified: Steps that were not certified.
        wrong: Collisions of pairs that neither touched nor crossed at the start, and of which the report names no
            vertex; in certified steps also pairs that came nearer than they may.
    """

    steps: int = 0
    touching: int = 0
    changed: int = 0
    uncertified: int = 0
    wrong: int = 0

    def add(self, rollout: Rollout, approaches: int = 0) -> int:
        """Judges the last step of a rollout, in which pairs came nearer than they may; returns what was wrong."""
        report = rollout.solver.report
        named = set(report.uncertified_vertices.tolist())
        wrong = sum(named.isdisjoint(corners) for corners in rollout.new_collisions) + approaches * report.certified
        self.steps += 1
        self.touching += report.excluded > 0 or report.crossings > 0
        self.changed += report.truncated > 0 or report.frozen > 0
        self.uncertified += not report.certified
        self.wrong += wrong
        return wrong


class Stress:
    """Steps of the stage from random positions to random ones, for one kind of scene, in one model.

    Attributes:
        judged: Counts of steps so far.
    """

    def __init__(self, scene: Scene, rng: np.random.Generator, *, worlds: int = 1, implicit: bool = False, device=None):
        self._scene, self._rng, self._implicit = scene, rng, implicit
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        for _world in range(worlds):
            builder.begin_world()
            first = builder.particle_count
            faces = first + self._connect()
            for position in self._place_sheets().tolist():
                mass = 0.0 if rng.random() < scene.held else 1.0
                builder.add_particle(wp.vec3(*position), wp.vec3(), mass)
            for face in faces.tolist():
                builder.add_triangle(*face)
            builder.end_world()
        self._worlds = worlds
        self._model = builder.finalize(device=device)
        distance = scene.min_distance
        if implicit:
            solver = SolverImplicit(self._model, min_distance=distance)
        else:
            solver = bsc.SolverCCD(Still(self._model, self._end), min_distance=distance)
        self._rollout = (
            Rollout(self._model, solver) if distance is None else DistanceRollout(self._model, solver, distance)
        )
        self.judged = Judged()

    def _connect(self):
        """Returns the faces of three sheets, each cell divided along either diagonal."""
        corners = np.arange((_CELLS + 1) ** 2).reshape(_CELLS + 1, -1)
        cells = np.stack([corners[:-1, :-1], corners[1:, :-1], corners[1:, 1:], corners[:-1, 1:]], axis=-1)
        cells = np.concatenate([cells.reshape(-1, 4) + sheet * corners.size for sheet in range(3)])
        cells = np.where(self._rng.random((len(cells), 1)) < 0.5, cells, np.roll(cells, 1, axis=1))
        return np.concatenate([cells[:, :3], cells[:, [0, 2, 3]]])

    def _place(self):
        """Returns random positions of all vertices at the start."""
        return np.concatenate([self._place_sheets() for _world in range(self._worlds)]).astype(np.float32)

    def _place_sheets(self):
        scene, rng = self._scene, self._rng
        grid = np.stack(np.meshgrid(*2 * [np.arange(_CELLS + 1.0)], indexing="ij"), axis=-1).reshape(-1, 2)
        sheets, end = [], 0.0
        for _sheet in range(3):
            jitter = rng.uniform(-0.3, 0.3, grid.shape) * (rng.random() < 0.5) * (not scene.lattice)
            plane = (grid + jitter) / _CELLS
            if not scene.lattice:
                plane[:, 0] += end - plane[:, 0].min()
                end = plane[:, 0].max() + scene.gap
            sheets.append(np.concatenate([plane, np.zeros((len(plane), 1))], axis=1))
        x = np.concatenate(sheets)
        x[:, 0] -= sheets[0][:, 0].max()  # where the spacing of floats is finest
        if scene.lattice:
            shifts = rng.integers(-1, 2, (3, 1, 3)) * [2, 2, rng.random() < 0.5]
            x += shifts.repeat(len(grid), axis=1).reshape(-1, 3) / (2.0 * _CELLS)
        x[:, 2] += rng.normal(0.0, scene.noise, len(x))
        if scene.crossing:
            middle = slice(len(grid), 2 * len(grid))
            x[middle] = (x[middle] - x[middle].mean(axis=0)) @ _rotation(rng).T + (*rng.uniform(-0.4, 0.4, 2), 0.0)
        return x @ _rotation(rng).T if scene.tilted else x

    def _move(self, x):
        """Returns random positions at the end."""
        scene, rng = self._scene, self._rng
        moved = rng.random((len(x), 1)) < rng.choice([0.1, 0.5, 1.0])
        path = scene.path * rng.uniform(-1.0, 1.0, x.shape) * moved
        if rng.random() < 0.5:
            path[:, 2] = 0.0  # in the plane of flat sheets
        if scene.lattice:
            path = np.round(2.0 * _CELLS * path) / (2.0 * _CELLS)
        return (x + path).astype(np.float32)

    def _end(self, start, end):
        end.particle_q.assign(self._predicted)
        end.particle_qd.zero_()

    def step(self) -> bool:
        """Makes a step and judges it; returns whether its certificate was right."""
        rollout, judged = self._rollout, self.judged
        approaches = getattr(rollout, "approaches", 0)
        start = self._place()
        self._predicted = self._move(start)
        state = rollout.states[0]
        state.particle_q.assign(start)
        if self._implicit:  # where inertia leads, which the faces of these sheets, that are at rest as they are, resist
            state.particle_qd.assign((self._predicted - start) / DT)
        rollout.solver.reset(state)
        rollout.step(DT)
        return not judged.add(rollout, getattr(rollout, "approaches", 0) - approaches)


def simulate(seed: int, judged: dict[str, Judged], most: int, device, *, implicit: bool = False) -> bool:
    """Judges the steps of a simulation, and returns whether all certificates were right.

    Args:
        seed: Seed of the simulation.
        judged: Counts of steps so far, by kind of scene.
        most: Most steps.
        device: Warp device.
        implicit: Whether ``SolverImplicit`` makes the steps.
    """
    settings = Settings.draw(seed)
    simulation, counts = Simulation(settings, device), judged[settings.kind]
    with contextlib.redirect_stdout(io.StringIO()):  # Style3D prints how long it prepared
        solver = SolverImplicit(simulation.model) if implicit else simulation.make_solver()
    rollout, pipeline = Rollout(simulation.model, solver), newton.CollisionPipeline(simulation.model)
    contacts = pipeline.contacts() if settings.contacts or settings.inner == "style3d" else None
    wrong = 0
    for _ in range(min(most, settings.rate // 3)):
        if settings.contacts:
            pipeline.collide(rollout.states[0], contacts)
        rollout.step(1.0 / settings.rate, contacts)
        wrong += counts.add(rollout)
    return not wrong


def _rotation(rng):
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return rotation * np.sign(np.linalg.det(rotation))


def main() -> int:
    """Runs the program; returns 1 if a certificate was wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1400, help="steps in all; default: 1400")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first step; default: 0")
    parser.add_argument("--implicit", action="store_true", help="steps of SolverImplicit")
    parser.add_argument("--device", help="Warp device")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    table = Table("scene", "steps", "touching", "cut", "uncertified", "wrong")
    wrong = 0
    each = -(-options.steps // (2 * len(SCENES)))
    for name, scene in SCENES.items():
        stress = None
        for i in range(each):
            if i % 100 == 0:  # another mesh
                seed = options.seed + i
                judged = stress.judged if stress else Judged()
                stress = Stress(scene, np.random.default_rng(seed), implicit=options.implicit, device=options.device)
                stress.judged = judged
            if not stress.step():
                print(f"wrong: {name}, --seed {seed}, step {i % 100}", flush=True)
        table.add_row(name, *(str(count) for count in vars(stress.judged).values()))
        wrong += stress.judged.wrong
    simulated = {kind: Judged() for kind in KINDS}
    seed = options.seed
    while (left := options.steps // 2 - sum(judged.steps for judged in simulated.values())) > 0:
        if not simulate(seed, simulated, left, options.device, implicit=options.implicit):
            print(f"wrong: simulation, seed {seed} ({Settings.draw(seed)})", flush=True)
        seed += 1
    for kind, judged in simulated.items():
        table.add_row(f"simulation: {kind}", *(str(count) for count in vars(judged).values()))
        wrong += judged.wrong
    Console().print(table)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
