"""Compares gradients through steps of the solver with contact inside with central differences, by scene and world.

    python tests/support/gradient_accuracy.py --worlds 8
    python tests/support/gradient_accuracy.py throw rope --worlds 64 --steps 40 --device cuda:0

In each world something is thrown in another way. The loss is a weighted mean of the positions at the end; its gradient
is with respect to the velocity of the throw. A world deviates by the largest difference of its three components from
those of central differences, as a share of the largest of these. Two comparisons, and two that tell why they differ:

- "exact": the adjoint of steps in float64, solved until nothing is left, with central differences of the same steps,
  see ``gradient_reference.py``, at 1e-4 m/s. A world passes within 1%, and within 5% in each component that is more
  than a fifth of the largest one.
- "as computed": the gradient of a tape through the solver's own steps with central differences of these at 3e-3 m/s. A
  world passes within 10%.
- "longer": the exact adjoint with differences of exact steps at 3e-3 m/s, within 10%. What fails here and not above has
  an end that is rough: cloth that buckles, contacts that begin to slip within the differences.
- "loads": the exact adjoint with differences at 1e-4 m/s of exact steps in which loads are read anew, within 10%. The
  adjoint holds them constant: they are what stiffens barriers where solids and taut elements press.

``--json`` writes all deviations to a file as well.
"""

import argparse
import itertools
import json
import sys
import time
from pathlib import Path

import newton
import numpy as np
import warp as wp
from gradient_reference import ReferenceSteps

import warp_bsc as bsc

WEIGHT = np.array([1.0, 0.3, 0.7])
EXACT, COMPUTED = 1e-4, 3e-3  # m/s
CLOTH = {"dim_x": 6, "dim_y": 6, "cell_x": 0.05, "cell_y": 0.05, "mass": 0.001, "vel": wp.vec3()}
CLOTH |= {"tri_ke": 100.0, "tri_ka": 100.0, "tri_kd": 1e-4, "edge_kd": 1e-5, "particle_radius": 0.005}


def add_cloth(builder, at, angle=0.0, *, bending=1e-2, **options):
    """Adds a cloth with a corner at a place, turned about an axis that is nearly y."""
    rotation = wp.quat_from_axis_angle(wp.normalize(wp.vec3(0.2, 1.0, 0.1)), angle)
    builder.add_cloth_grid(pos=wp.vec3(*at), rot=rotation, **(CLOTH | {"edge_ke": bending} | options))


def throw(builder, bending=1e-2):
    """A cloth that is thrown at a sphere."""
    at = wp.transform(wp.vec3(0.02, 0.01, -0.17), wp.quat_identity())
    builder.add_shape_sphere(body=-1, radius=0.1, xform=at)
    add_cloth(builder, (-0.15, -0.15, 0.0), 0.2, bending=bending)
    return (0.2, 0.1, -1.0), {"friction": 0.2}


def stiff_throw(builder):
    """The same with ten times the bending stiffness."""
    return throw(builder, 1e-1)


def drape(builder):
    """A cloth that falls over the edge of a box."""
    at = wp.transform(wp.vec3(-0.2, 0.0, -0.12), wp.quat_identity())
    builder.add_shape_box(body=-1, hx=0.2, hy=0.3, hz=0.1, xform=at)
    add_cloth(builder, (-0.17, -0.15, 0.0), 0.05)
    return (0.1, 0.02, -0.5), {"friction": 0.3}


def sheets(builder):
    """A cloth that slides over another one, which is held at two sides."""
    add_cloth(builder, (-0.15, -0.15, 0.0), fix_left=True, fix_right=True)
    add_cloth(builder, (-0.10, -0.12, 0.02), 0.05, dim_x=4, dim_y=4)
    return (0.3, 0.1, -0.5), {"friction": 0.2}


def cube(builder):
    """A soft cube that rolls on a plane."""
    builder.add_ground_plane()
    soft = {"density": 200.0, "k_mu": 5e3, "k_lambda": 5e3, "k_damp": 1e-3, "particle_radius": 0.005}
    grid = {"dim_x": 3, "dim_y": 3, "dim_z": 3, "cell_x": 0.04, "cell_y": 0.04, "cell_z": 0.04}
    rotation = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), 0.5)
    builder.add_soft_grid(pos=wp.vec3(0.0, 0.0, 0.10), rot=rotation, vel=wp.vec3(), **grid, **soft)
    return (1.0, 0.1, -0.5), {"friction": 0.5}


def rope(builder):
    """A rope that falls over a bar."""
    turned = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.5 * np.pi)
    at = wp.transform(wp.vec3(0.02, 0.0, -0.06), turned)
    builder.add_shape_capsule(body=-1, radius=0.03, half_height=0.2, xform=at)
    for k in range(17):
        at = wp.vec3(0.02 * (k - 8), 0.002 * k, 0.0)
        builder.add_particle(at, wp.vec3(), mass=0.001, radius=0.005)
        if k > 0:
            builder.add_spring(k - 1, k, 200.0, 1e-3, 0)
        if k > 1:
            builder.add_spring(k - 2, k, 5.0, 1e-4, 0)
    return (0.1, 0.0, -0.5), {"friction": 0.3}


def trampoline(builder):
    """A box that falls on a cloth that is held at two sides, pushed both ways: its own velocity is the throw."""
    add_cloth(builder, (-0.15, -0.15, 0.0), fix_left=True, fix_right=True, mass=0.003)
    turn = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.3, 0.2)), 0.3)
    body = builder.add_body(xform=wp.transform(wp.vec3(0.01, 0.02, 0.08), turn))
    cfg = newton.ModelBuilder.ShapeConfig(density=200.0, mu=0.3)
    builder.add_shape_box(body, hx=0.04, hy=0.03, hz=0.03, cfg=cfg)
    return (0.1, -0.05, -1.0), {"friction": 0.3}


SCENES = {
    "throw": throw,
    "stiff throw": stiff_throw,
    "drape": drape,
    "sheets": sheets,
    "cube": cube,
    "rope": rope,
    "trampoline": trampoline,
}


class Scene:
    """Worlds of a scene, each with a throw of its own.

    Attributes:
        model: The model.
        throws: Velocities of the worlds, float64, shape [worlds, 3].
        solver: The solver.
        dt: Length of a step [s].
    """

    def __init__(self, name, worlds, device, seed=0, dt=1.0 / 60.0):
        """Builds the worlds."""
        self.dt = dt
        world, builder = newton.ModelBuilder(), newton.ModelBuilder()
        throw, options = SCENES[name](world)
        builder.replicate(world, worlds)
        self.model = model = builder.finalize(requires_grad=True, device=device)
        random = np.random.default_rng(seed)
        self.throws = np.float32(throw + 0.1 * random.normal(size=(worlds, 3))).astype(float)
        self.solver = bsc.SolverImplicit(model, **options)
        self.world = model.particle_world.numpy().clip(0)
        moves = model.particle_inv_mass.numpy() > 0
        if name == "sheets":  # the upper one is thrown
            moves &= model.particle_q.numpy()[:, 2] > 0.01
        self.has_bodies = model.body_count > 0
        self.thrown = np.zeros(len(moves), dtype=bool) if self.has_bodies else moves
        self.loss_weights = WEIGHT / np.bincount(self.world)[self.world][:, None]

    def velocities(self, throws):
        """Returns velocities of particles, of worlds with these throws."""
        return np.where(self.thrown[:, None], throws[self.world], 0.0)

    def by_world(self, of_particles):
        """Returns sums of values of particles by world."""
        sums = np.zeros((len(self.throws), *of_particles.shape[1:]))
        np.add.at(sums, self.world, of_particles)
        return sums

    def losses(self, x):
        """Returns the losses of worlds."""
        return self.by_world((x * self.loss_weights).sum(axis=1))

    def body_velocities(self, throws):
        """Returns velocities of bodies, of worlds with these throws."""
        return np.hstack([throws, np.tile((0.5, -0.3, 0.2), (len(throws), 1))])

    def state(self, throws):
        """Returns a state at the start."""
        state = self.model.state()
        state.particle_qd.assign(self.velocities(throws).astype(np.float32))
        if self.has_bodies:
            state.body_qd.assign(self.body_velocities(throws).astype(np.float32))
        return state

    def gradients(self, state):
        """Returns the gradients with respect to the throws, given those of the state at the start."""
        if self.has_bodies:
            return state.body_qd.grad.numpy()[:, :3].astype(float)
        of_v = state.particle_qd.grad.numpy().astype(float)
        return self.by_world(np.where(self.thrown[:, None], of_v, 0.0))


def central_differences(run, throws, step):
    """Returns central differences of losses by throws, shape [worlds, 3]."""
    found = [(run(throws + step * unit) - run(throws - step * unit)) / (2.0 * step) for unit in np.eye(3)]
    return np.stack(found, axis=1)


def run_exactly(scene, steps):
    """Returns gradients of steps in float64, their differences by name, and worlds in which a step has no solution."""
    solver, reference = scene.solver, ReferenceSteps(scene.solver)
    states, unsolved = [scene.model.state() for _ in range(steps + 1)], np.zeros(len(scene.throws), dtype=bool)
    x0 = scene.model.particle_q.numpy()

    def run(throws, held=None):
        states[0].assign(scene.state(throws))
        solver.reset(states[0])
        bodies = [scene.model.body_q.numpy(), scene.body_velocities(throws)] if scene.has_bodies else []
        reference.begin(held, x0, scene.velocities(throws), *bodies)
        with wp.Tape() as tape:  # what records steps solves them in float64
            for start, end in itertools.pairwise(states):
                solver.step(start, end, None, None, scene.dt)
        unsolved[:] |= reference.unsolved
        return tape, scene.losses(reference.x)

    tape, _ = run(scene.throws)
    held = reference.held
    states[-1].particle_q.grad.assign(scene.loss_weights.astype(np.float32))
    tape.backward()
    gradients = scene.gradients(states[0])
    found = {"exact": central_differences(lambda throws: run(throws, held)[1], scene.throws, EXACT)}
    of_exact = unsolved.copy()
    found["longer"] = central_differences(lambda throws: run(throws, held)[1], scene.throws, COMPUTED)
    found["loads"] = central_differences(lambda throws: run(throws)[1], scene.throws, EXACT)
    reference.end()
    return gradients, found, of_exact


def run_as_computed(scene, steps):
    """Returns gradients of a tape and central differences of the solver's own steps."""
    model, solver = scene.model, scene.solver
    states = [model.state() for _ in range(steps + 1)]

    def begin(throws):
        first = scene.state(throws)
        for name in ("particle_q", "particle_qd", "body_q", "body_qd"):
            if getattr(first, name) is not None:
                wp.copy(getattr(states[0], name), getattr(first, name))
        solver.reset(states[0])

    def take_steps():
        for start, end in itertools.pairwise(states):
            solver.step(start, end, None, None, scene.dt)

    def run(throws):
        begin(throws)
        take_steps()
        return scene.losses(states[-1].particle_q.numpy().astype(float))

    begin(scene.throws)
    with wp.Tape() as tape:
        take_steps()
    states[-1].particle_q.grad.assign(scene.loss_weights.astype(np.float32))
    tape.backward()
    return scene.gradients(states[0]), central_differences(run, scene.throws, COMPUTED)


def deviations(gradients, found):
    """Returns the deviation of each world, and the largest one of components above a fifth of the largest."""
    size = np.abs(found).max(axis=1, keepdims=True)
    off = np.abs(gradients - found)
    of_each = np.where(np.abs(found) > 0.2 * size, off / np.maximum(np.abs(found), 1e-300), 0.0)
    return (off / size).max(axis=1), of_each.max(axis=1)


def judge(name, worlds, steps, dt, device):
    """Returns what a row shows of a scene, and all deviations."""
    scene, start = Scene(name, worlds, device, dt=dt), time.perf_counter()
    row = {"scene": name, "worlds": worlds, "steps": steps}
    gradients, found, unsolved = run_exactly(scene, steps)
    off, of_each = deviations(gradients, found["exact"])
    passes = (off <= 0.01) & (of_each <= 0.05) & ~unsolved
    row |= {"exact": float(passes.mean()), "median": float(np.median(off)), "unsolved": int(unsolved.sum())}
    row["exact_deviations"] = off.tolist()
    for kind in ("longer", "loads"):
        off, _ = deviations(gradients, found[kind])
        row |= {kind: float((off <= 0.1).mean()), f"{kind}_deviations": off.tolist()}
    gradients, found = run_as_computed(scene, steps)
    off, _ = deviations(gradients, found)
    is_nan = ~np.isfinite(gradients).all(axis=1)
    row |= {"as computed": float((off <= 0.1).mean()), "of it": float(np.nanmedian(off)), "NaN": int(is_nan.sum())}
    row["deviations"] = off.tolist()
    row["largest norm"] = float(np.nanmax(scene.solver.report.gradient_norms))
    row["seconds"] = time.perf_counter() - start
    return row


def main():
    """Prints a row for each scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", help=f"of {', '.join(SCENES)} (default: all)")
    parser.add_argument("--worlds", type=int, default=8)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--dt", type=float, default=1.0 / 60.0, help="length of a step [s]")
    parser.add_argument("--device", help="Warp device, such as cpu or cuda:0 (default: the first GPU, else cpu)")
    parser.add_argument("--json", metavar="FILE", help="file to which all deviations are written")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    device, rows = wp.get_device(options.device), []
    print("scene         exact   median unsolved longer  loads as computed   median  NaN      s")
    for name in options.scenes or SCENES:
        with wp.ScopedDevice(device):
            row = judge(name, options.worlds, options.steps, options.dt, device)
        rows.append(row)
        exact = f"{row['exact']:6.0%} {row['median']:8.1e} {row['unsolved']:8} {row['longer']:6.0%} {row['loads']:6.0%}"
        computed = f"{row['as computed']:11.0%} {row['of it']:8.1e} {row['NaN']:4} {row['seconds']:6.0f}"
        print(f"{name:<12} {exact} {computed}", flush=True)
    if options.json:
        Path(options.json).write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
