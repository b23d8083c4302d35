"""Repairs the starts of random Newton models, and checks each: never worse, no bit changed in vain, a legal start.

Run it as ``python tests/support/tangled_starts.py [FIRST] [LAST]``, by default 0 to 200. Each model has up to two
pieces of cloth, soft bodies, rigid shapes and the ground, placed at random without regard to each other. Cloth may be
held at one side; every fourth model is repaired with a minimum distance.
"""

import collections
import sys
import warnings

import newton
import numpy as np
import warp as wp
from newton_scenes import grid
from rich.progress import track

import warp_bsc as bsc
from warp_bsc.bench.crossings import CrossingCounter

MIN_DISTANCE = 0.003
"""Minimum distance of every fourth model [m]."""


def place(rng, low, high):
    """Returns a random transform."""
    turn = rng.standard_normal(4)
    return wp.transform(wp.vec3(*rng.uniform(low, high, 3)), wp.quat(*(turn / np.linalg.norm(turn))))


def random_model(seed, device="cpu"):
    """Returns a model whose parts are placed without regard to each other."""
    rng = np.random.default_rng(seed)
    builder = newton.ModelBuilder()
    if rng.random() < 0.5:
        builder.add_ground_plane(height=rng.uniform(-0.3, 0.05))
    for _ in range(rng.integers(0, 3)):
        kind = rng.choice(["sphere", "box", "capsule", "cylinder"])
        if kind == "box":
            size = dict(zip(("hx", "hy", "hz"), rng.uniform(0.03, 0.2, 3), strict=True))
        else:
            size = {"radius": rng.uniform(0.03, 0.12)}
            size |= {} if kind == "sphere" else {"half_height": rng.uniform(0.05, 0.2)}
        getattr(builder, f"add_shape_{kind}")(body=-1, xform=place(rng, -0.3, 0.3), **size)
    pieces = rng.integers(0, 3)
    for _ in range(pieces):
        cells, size, where = int(rng.integers(6, 20)), rng.uniform(0.3, 0.8), place(rng, -0.4, 0.1)
        options = grid(cells, size / cells) | {"mass": 0.001, "fix_left": bool(rng.random() < 0.3)}
        builder.add_cloth_grid(pos=where.p, rot=where.q, vel=wp.vec3(), **options)
    for _ in range(rng.integers(0, 2) if pieces else rng.integers(1, 3)):
        cells, size, where = int(rng.integers(3, 7)), rng.uniform(0.15, 0.4), place(rng, -0.3, 0.1)
        options = grid(cells, size / cells, "xyz") | {"density": 100.0, "k_mu": 1e3, "k_lambda": 1e3, "k_damp": 0.0}
        builder.add_soft_grid(pos=where.p, rot=where.q, vel=wp.vec3(), **options)
    builder.color()
    return builder.finalize(device=device)


def check(seed):
    """Repairs a model, and returns what became of it; raises AssertionError if that breaks a promise."""
    model = random_model(seed)
    state = model.state()
    before = state.particle_q.numpy()
    options = {} if seed % 4 else {"min_distance": MIN_DISTANCE}
    crossings = CrossingCounter(model).count(state)
    result = bsc.repair_state(model, state, **options)
    after = state.particle_q.numpy()
    still = result.moved == 0.0
    assert np.array_equal(result.x, after) and after[still].tobytes() == before[still].tobytes()
    assert still[model.particle_inv_mass.numpy() == 0.0].all()
    faults = result.crossings_before + result.inside_before, result.crossings + len(result.inside)
    assert faults[1] <= faults[0] and result.crossings <= result.crossings_before
    assert result.inverted <= result.inverted_before
    assert CrossingCounter(model).count(state) <= crossings
    if result.certified:
        check_steps(model, state, options)
    if not faults[0] and not result.near_before:
        return "nothing to repair"
    return "certified" if result.certified else "better" if faults[1] < faults[0] else "as before"


def check_steps(model, state, options):
    """Steps from a legal start behind the stage, which certifies each step and excludes nothing."""
    solver = bsc.SolverCCD(newton.solvers.SolverVBD(model, iterations=2), **options)
    other = model.state()
    for _ in range(2):
        state.clear_forces()
        solver.step(state, other, model.control(), None, 1.0 / 480.0)
        state, other = other, state
    totals = solver.report.totals
    assert (totals.crossing_steps, totals.uncertified_steps, totals.excluded) == (0, 0, 0)


def main():
    """Checks the models, and prints how many became what."""
    wp.config.log_level = wp.LOG_ERROR
    warnings.simplefilter("ignore")
    first, last = [*map(int, sys.argv[1:]), *(0, 200)[len(sys.argv) - 1 :]]
    print(dict(collections.Counter(check(seed) for seed in track(range(first, last), "Repairing"))))


if __name__ == "__main__":
    main()
