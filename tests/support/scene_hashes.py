"""Hashes of random scenes behind the collision stage, so that a change of its code can be seen to change no bit.

``python tests/support/scene_hashes.py --write before.json`` steps the scenes, and writes a hash of the states, reports
and gradients of each. ``--compare before.json`` compares with that file; the status is 1 where one differs. Hashes
differ between devices, and between versions of Warp and Newton. Scenes that differ from run to run are not compared.
"""

import argparse
import contextlib
import hashlib
import io
import itertools
import json
import sys
from pathlib import Path

import newton
import numpy as np
import warp as wp
from newton_scenes import Still, add_rope, grid

import warp_bsc as bsc

STEPS = 8
KINDS = 17
VARYING_ON_GPU = 5, 12, 13, 16
"""Kinds of scenes in which ``SolverSemiImplicit`` adds up forces on a particle, or a tape gradients, in any order."""
COUNTS = "steps", "uncertified_steps", "truncated_steps", "frozen_steps", "total_remaining", "total_excluded"
COUNTS += "predicted_contacts", "remaining", "excluded", "crossings", "body_contacts", "truncated", "frozen"


def moved_at_random(model, seed, path):
    """Returns a solver that moves particles at random, whatever the state."""
    rng = np.random.default_rng(seed)

    def move(start, end):
        x = start.particle_q.numpy()
        end.particle_q.assign(x + rng.uniform(-path, path, x.shape).astype(np.float32))
        end.particle_qd.zero_()

    return Still(model, move)


def add_cloth(builder, rng, *, z, cells=6, size=0.5, vel=(0.0, 0.0, -1.0), fixed=False, tilt=0.05, **options):
    """Adds a sheet of cloth, turned at random about a horizontal axis."""
    axis = wp.normalize(wp.vec3(float(rng.normal()), float(rng.normal()), 0.0))
    rotation = wp.quat_from_axis_angle(axis, float(rng.uniform(-tilt, tilt)))
    shift = wp.vec3(*(-0.5 * size + rng.uniform(-0.05, 0.05, 2)).tolist(), z)
    settings = {"mass": 0.01, "tri_ke": 1e3, "tri_ka": 1e3, "tri_kd": 1e-4, "edge_ke": 0.05, "edge_kd": 1e-4}
    settings |= {"particle_radius": 0.005, "fix_left": fixed, "fix_right": fixed} | options
    builder.add_cloth_grid(pos=shift, rot=rotation, vel=wp.vec3(*vel), **grid(cells, size / cells), **settings)


def add_soft(builder, rng, z):
    """Adds a soft box."""
    settings = {"density": 200.0, "k_mu": 2e4, "k_lambda": 2e4, "k_damp": 1e-3, "particle_radius": 0.005}
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), float(rng.uniform(0.0, 0.5)))
    settings |= grid(3, 0.08, "xyz") | {"dim_z": 2}
    builder.add_soft_grid(pos=wp.vec3(-0.1, -0.1, z), rot=turn, vel=wp.vec3(0.0, 0.0, -2.0), **settings)


def add_body(builder, rng, z, *, kind=None, kinematic=False):
    """Adds a rigid body of a random shape."""
    pose = wp.transform(
        wp.vec3(*rng.uniform(-0.1, 0.1, 2).tolist(), z), wp.quat_rpy(*rng.uniform(0.0, 0.6, 3).tolist())
    )
    body = builder.add_body(xform=pose, is_kinematic=kinematic)
    kind = kind or rng.choice(["sphere", "box", "capsule", "cylinder", "cone"])
    sizes = {"sphere": {"radius": 0.08}, "box": {"hx": 0.1, "hy": 0.07, "hz": 0.05}}
    sizes |= {name: {"radius": 0.06, "half_height": 0.08} for name in ("capsule", "cylinder", "cone")}
    getattr(builder, f"add_shape_{kind}")(body, **sizes[kind])
    return body


def make_scene(seed):
    """Returns the model of a scene, its stage, the length of its steps [s], and whether they are recorded."""
    rng, kind = np.random.default_rng(seed), seed % KINDS
    builder = newton.ModelBuilder()
    recorded, options, inner, dt = False, {}, "vbd", 1.0 / 120.0
    ground = kind not in (9, 11)
    if ground:
        builder.add_ground_plane()
    if kind == 0:  # cloth onto a static shape
        builder.add_shape_sphere(-1, xform=wp.transform(wp.vec3(0.0, 0.0, 0.2), wp.quat_identity()), radius=0.15)
        add_cloth(builder, rng, z=0.4, vel=(0.0, 0.0, -8.0))
        options = {"friction": 0.3}
    elif kind == 1:  # a pile
        for layer in range(3):
            add_cloth(builder, rng, z=0.02 + 0.005 * layer, tilt=0.0, vel=(0.3 * layer, 0.0, -3.0 - layer))
        options = {"restitution": 0.2} if seed % 2 else {"max_iterations": 1}
    elif kind == 2:  # fast
        add_cloth(builder, rng, z=0.5, fixed=True, vel=(0.0, 0.0, 0.0))
        add_cloth(builder, rng, z=0.6, vel=(0.0, 2.0, -40.0), size=0.3, cells=4)
    elif kind == 3:  # bodies onto cloth
        add_cloth(builder, rng, z=0.3, fixed=True, vel=(0.0, 0.0, 0.0))
        for i in range(2):
            body = add_body(builder, rng, 0.45 + 0.25 * i)
            builder.body_qd[body] = wp.spatial_vector(0.0, 0.0, -5.0, 2.0, 0.0, 1.0)
    elif kind == 4:  # bodies kept apart
        for i in range(3):
            add_body(builder, rng, 0.15 + 0.22 * i, kind="box")
        add_cloth(builder, rng, z=0.8, vel=(0.0, 0.0, -12.0))
        options, inner = {"bodies": "separated"}, "xpbd"
    elif kind == 5:
        add_soft(builder, rng, 0.02)
        add_soft(builder, rng, 0.35)
        inner = "semi"
        dt = 1.0 / 1000.0
    elif kind == 6:  # ropes
        for i in range(3):
            points = [(0.05 * (j - 4), 0.04 * i, 0.1 + 0.05 * i + 0.001 * rng.normal()) for j in range(8)]
            add_rope(builder, points, mass=0.01, velocity=(0.0, -1.0 * i, -2.0), damping=1.0, radius=0.01)
        options, inner, dt = {"min_distance": 0.002, "particle_radius": 0.005}, "xpbd", 1.0 / 240.0
    elif kind == 7:  # minimum distances
        for layer in range(3):
            add_cloth(builder, rng, z=0.05 + 0.03 * layer, tilt=0.05, vel=(0.0, 0.2 * layer, -4.0))
        options = {"min_distance": 0.004}
    elif kind == 8:  # substeps
        builder.add_shape_box(
            -1, xform=wp.transform(wp.vec3(0.0, 0.0, 0.2), wp.quat_identity()), hx=0.1, hy=0.1, hz=0.1
        )
        add_cloth(builder, rng, z=0.33, vel=(0.0, 0.0, -2.0))
        options = {"substeps": 4}
        dt = 1.0 / 60.0
    elif kind == 9:  # worlds
        for _world in range(3):
            builder.begin_world()
            add_cloth(builder, rng, z=0.3, fixed=True, vel=(0.0, 0.0, 0.0))
            add_cloth(builder, rng, z=0.4, vel=(0.0, 0.0, float(rng.uniform(-30.0, -2.0))), size=0.3, cells=4)
            add_body(builder, rng, 0.6)
            builder.end_world()
    elif kind in (10, 11):  # degenerate
        for layer in range(3):
            gap = (1e-6, 1e-3, 0.02)[seed // KINDS % 3]
            add_cloth(builder, rng, z=0.1 + gap * layer, tilt=0.3 * (kind == 11), cells=4)
        for particle in np.flatnonzero(rng.random(builder.particle_count) < 0.1):
            builder.particle_mass[particle] = 0.0
        inner = "given"
        options = {"min_distance": 1e-3} if seed == 27 else {}
        options["max_iterations"] = 3
    elif kind in (12, 13):  # a model that requires gradients, and gradients
        add_cloth(builder, rng, z=0.06, vel=(2.0, 0.0, -6.0), tri_ke=50.0, tri_ka=50.0, cells=4)
        inner, recorded, dt = "implicit", True, 1.0 / 120.0
        if kind == 12:
            body = add_body(builder, rng, 0.25)
            builder.body_qd[body] = wp.spatial_vector(0.0, 0.0, -3.0, 1.0, 0.0, 1.0)
            inner, recorded, dt, options = "semi", False, 1.0 / 600.0, {"friction": 0.3, "restitution": 0.1}
    elif kind == 14:
        add_cloth(builder, rng, z=0.1, vel=(0.0, 0.0, -10.0))
        add_cloth(builder, rng, z=0.15, vel=(0.0, 0.0, -25.0))
        options = {"monitor": True}
    elif kind == 15:  # animated
        add_cloth(builder, rng, z=0.3, fixed=True, vel=(0.0, 0.0, 0.0))
        add_body(builder, rng, 0.6, kinematic=True)
    else:  # what bounces
        add_cloth(builder, rng, z=0.05, vel=(0.0, 0.0, -3.0))
        add_cloth(builder, rng, z=0.10, vel=(0.0, 0.0, -5.0))
        options, inner = {"restitution": 0.5}, "semi"
        dt = 1.0 / 1000.0
    builder.color()
    model = builder.finalize(requires_grad=kind in (12, 13))
    if inner == "semi":
        model.particle_ke = model.particle_kd = model.particle_kf = 0.0
    solvers = {
        "vbd": lambda: newton.solvers.SolverVBD(model, iterations=5),
        "xpbd": lambda: newton.solvers.SolverXPBD(model, iterations=5),
        "semi": lambda: newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False),
        "given": lambda: moved_at_random(model, seed, 0.02 if seed % 2 else 0.1),
        "implicit": lambda: bsc.SolverImplicit(model, friction=0.3),
    }
    return model, make_stage(solvers[inner](), options), dt, recorded


def make_stage(inner, options):
    """Returns the stage with options of these names."""
    if isinstance(inner, bsc.SolverImplicit):
        return inner
    return bsc.CollisionMonitor(inner) if "monitor" in options else bsc.SolverCCD(inner, **options)


def count(report, name):
    """Returns a count of the report, of the last step or of all steps."""
    if name.startswith("total_"):
        return getattr(report.totals, name.removeprefix("total_"))
    return getattr(report.totals if name == "steps" or name.endswith("_steps") else report, name)


def hash_scene(seed):
    """Returns the hash of the states and reports of a scene, and of its gradients."""
    with contextlib.redirect_stdout(io.StringIO()):
        model, stage, dt, recorded = make_scene(seed)
    states = [model.state() for _ in range(STEPS + 1)]
    digest, control = hashlib.sha256(), model.control()
    names = [
        name for name in ("particle_q", "particle_qd", "body_q", "body_qd") if getattr(states[0], name) is not None
    ]
    tape = wp.Tape() if recorded else contextlib.nullcontext()
    with tape:
        for i, (start, end) in enumerate(itertools.pairwise(states)):
            start.clear_forces()
            if seed % KINDS == 15:
                pose = start.body_q.numpy()
                pose[:, 2] -= 0.06 * (i > 0)
                start.body_q.assign(pose)
            stage.step(start, end, control, None, dt)
            for name in names:
                digest.update(getattr(end, name).numpy().tobytes())
            for name in COUNTS:
                digest.update(str(count(stage.report, name)).encode())
    if recorded:
        for name in names:
            getattr(states[-1], name).grad.fill_(1.0)
        tape.backward()
        for name in names:
            digest.update(getattr(states[0], name).grad.numpy().tobytes())
        digest.update(model.particle_inv_mass.grad.numpy().tobytes())
    return digest.hexdigest()[:16], str(stage.report)


def main() -> int:
    """Runs the program; returns 1 if a hash differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=51, help="number of scenes; default: 51")
    parser.add_argument("--write", metavar="FILE", help="write the hashes")
    parser.add_argument("--compare", metavar="FILE", help="compare with these hashes")
    parser.add_argument("--device", help="Warp device")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    wp.set_device(options.device or wp.get_preferred_device())
    given = json.loads(Path(options.compare).read_text()) if options.compare else {}
    hashes, differing = {}, 0
    for seed in range(options.count):
        hashes[str(seed)], report = hash_scene(seed)
        varies = wp.get_device().is_cuda and seed % KINDS in VARYING_ON_GPU
        differs = not varies and str(seed) in given and given[str(seed)] != hashes[str(seed)]
        differing += differs
        print(f"scene {seed:2} {hashes[str(seed)]} {'DIFFERS' if differs else ''} {report}", flush=True)
    if options.write:
        Path(options.write).write_text(json.dumps(hashes, indent=1))
    print(f"{len(hashes)} scenes, {differing} differ")
    return int(differing > 0)


if __name__ == "__main__":
    sys.exit(main())
