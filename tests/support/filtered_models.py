"""Random small models with filters: an exact detector with the same filter judges every step of the stage.

``python tests/support/filtered_models.py --count 100`` lets three sheets fly into each other, a box, a sphere and the
ground, with random groups and masks, and exits with status 1 if a certified step has a collision of a pair that is not
filtered, if a step is not certified, or if something moves that only filtered pairs are near to. Filters are judged by
brute force, see :mod:`filters`.
"""

import argparse
import sys
from dataclasses import dataclass, field

import newton
import numpy as np
import warp as wp
from filters import corners_of, meet
from newton_scenes import Changed, add_patch

import warp_bsc as bsc

CELL, STEPS, DT = 0.05, 6, 1.0 / 60.0
NEAR = 0.25 * CELL
"""Farther from each other than this in a step, nothing is pushed [m]."""


@dataclass
class Judged:
    """What a rollout of a model has shown."""

    hits: int = 0  # contacts of pairs that are not filtered, which the stage resolved
    filtered: int = 0  # pairs that the stage left out
    passed: int = 0  # collisions of filtered pairs in the motions as stored
    moved: int = 0  # particles that the stage moved, over all steps
    failures: list[str] = field(default_factory=list)


def build(seed):
    """A random model and its filter."""
    rng = np.random.default_rng(seed)
    builder = newton.ModelBuilder()
    groups = []
    for layer in range(3):
        before = builder.particle_count
        velocity = rng.uniform((-0.5, -0.5, -3.0), (0.5, 0.5, 1.0))
        at = (*rng.uniform(-0.03, 0.03, 2), 0.22 + 0.05 * layer)
        add_patch(builder, 4, CELL, at, velocity=velocity)
        groups += [int(rng.integers(3))] * (builder.particle_count - before)
    builder.add_shape_box(body=-1, xform=wp.transform((0.05, 0.0, 0.12), wp.quat_identity()), hx=0.05, hy=0.05, hz=0.05)
    builder.add_shape_sphere(body=-1, xform=wp.transform((-0.08, 0.0, 0.1), wp.quat_identity()), radius=0.05)
    builder.add_ground_plane()
    particles, shapes = np.array(groups), rng.integers(0, 3, 3)
    odd = rng.random(len(particles)) < 0.1 * rng.integers(0, 2)
    masks = rng.integers(1, 8, 3)
    return builder.finalize(device="cpu"), bsc.CollisionFilter(
        particle_group=1 << np.where(odd, (particles + 1) % 3, particles),
        particle_mask=masks[particles],
        shape_group=1 << shapes,
        shape_mask=rng.integers(1, 8, 3),
    )


def pairs_of(detector, x0, x1):
    """Both kinds of pairs that collide, each with the vertices of both elements, shape (n, 4)."""
    found = detector.detect(x0, x1)
    kinds = {"vertex_face": found.vertex_face, "edge_edge": found.edge_edge}
    corners = {kind: np.concatenate(corners_of(detector.mesh, kind, pairs), axis=1) for kind, pairs in kinds.items()}
    return kinds, np.concatenate(list(corners.values()))


def judge(seed, stage=bsc.SolverCCD, **options):
    """Rolls a model out behind a stage, and judges each step."""
    model, collision_filter = build(seed)
    result = Judged()
    predicted = []
    inner = Changed(model, lambda state: predicted.append(state.particle_q.numpy().copy()))
    solver = stage(inner, collision_filter=collision_filter, report=["contacts"], **options)
    mesh, count = solver.mesh, model.particle_count
    of_both = zip(collision_filter.bits_of_particles(model), collision_filter.bits_of_shapes(model), strict=True)
    group, mask = (np.concatenate([one, other[mesh.shape_vertices.shape]]) for one, other in of_both)
    bits = {"group": group, "mask": mask}
    filtered = bsc.CollisionMesh(mesh.faces, mesh.vertex_count, **bits, device="cpu")
    whole = bsc.CollisionMesh(mesh.faces, mesh.vertex_count, device="cpu")
    exact, every, near = (
        bsc.CollisionDetector(m, method="exact", min_distance=distance, rings=0)
        for m, distance in ((filtered, 0.0), (whole, 0.0), (filtered, NEAR))
    )
    ground = mesh.planes.shape[0]
    of_plane = [bits[ground] for bits in collision_filter.bits_of_shapes(model)]
    meets_plane = ((group & of_plane[1]) != 0) & ((mask & of_plane[0]) != 0)
    state, end, x = model.state(), model.state(), wp.empty(mesh.vertex_count, dtype=wp.vec3, device="cpu")

    def positions(particle_q):
        mesh.positions(wp.array(particle_q, dtype=wp.vec3, device="cpu"), model.body_q, x)
        return x.numpy().copy()

    for step in range(STEPS):
        x0 = positions(state.particle_q)
        solver.step(state, end, None, None, DT)
        x1, wanted = positions(end.particle_q), positions(predicted[-1])
        moved = np.flatnonzero((x1 != wanted).any(axis=1))
        report = solver.report
        if not report.certified:
            result.failures.append(f"seed {seed}, step {step}: not certified")
        _kinds, corners = pairs_of(exact, x0, x1)
        corners = corners[(corners < count).any(axis=1)]
        if len(corners):
            result.failures.append(f"seed {seed}, step {step}: {len(corners)} collisions, first {corners[0]}")
        below = meets_plane[:count] & (x1[:count, 2] < 0.0)
        if below.any():
            result.failures.append(f"seed {seed}, step {step}: {below.sum()} particles in the ground")
        kinds, _corners = pairs_of(every, x0, x1)
        result.passed += sum(int((~meet(filtered, *corners_of(whole, k, p))).sum()) for k, p in kinds.items())
        touched = [pairs_of(near, x0, ends)[1].ravel() for ends in (wanted, x1)]
        at_plane = np.flatnonzero(meets_plane & (np.minimum(wanted, x0)[:, 2] < NEAR))
        alone = np.setdiff1d(moved, np.concatenate([*touched, at_plane]))
        if len(alone):
            result.failures.append(f"seed {seed}, step {step}: nothing is near particles {alone} that moved")
        rows = report.forces.contacts.numpy()
        of_pairs = rows["vertices"][rows["vertices"][:, 1] >= 0]
        split = np.where(rows["kind"][rows["vertices"][:, 1] >= 0] == 1, 2, 1)
        for n in (1, 2):
            one, other = of_pairs[split == n][:, :n], of_pairs[split == n][:, n:]
            if not meet(filtered, one, other).all():
                result.failures.append(f"seed {seed}, step {step}: a filtered pair has an impulse")
        if not meets_plane[rows["vertices"][rows["vertices"][:, 1] < 0, 0]].all():
            result.failures.append(f"seed {seed}, step {step}: a filtered plane has an impulse")
        result.hits, result.filtered = result.hits + report.predicted_contacts, result.filtered + report.filtered
        result.moved += len(moved)
        state, end = end, state
    return result


def main():
    """Judges models, prints what they had, and says what failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100, help="models")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    results = [
        judge(seed, min_distance=0.004 if seed % 3 == 0 else None)
        for seed in range(arguments.first, arguments.first + arguments.count)
    ]
    failures = [failure for result in results for failure in result.failures]
    for failure in failures:
        print(failure)
    sums = {name: sum(getattr(r, name) for r in results) for name in ("hits", "filtered", "passed", "moved")}
    print(
        f"{len(results)} models, {STEPS * len(results)} steps: {sums['hits']} contacts resolved, {sums['filtered']} "
        f"pairs filtered, {sums['passed']} collisions of filtered pairs passed, {sums['moved']} particles moved; "
        f"{len(failures)} failures"
    )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
