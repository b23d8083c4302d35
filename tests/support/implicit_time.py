"""Measures the time of gradients through VBD, in milliseconds a step: forward, on a tape, and back.

    python tests/support/implicit_time.py --device cuda:0

Steps of 1/60 s with 20 iterations of VBD. On a GPU all steps, and their way back, are one CUDA graph. ``--json`` writes
the times to a file as well.
"""

import newton
import numpy as np
import warp as wp
from implicit_scenes import CLOTH, add_cloth
from measured import options_of, report

import warp_bsc as bsc
from warp_bsc.bench.tables import Column
from warp_bsc.bench.timing import median_milliseconds

DT, ITERATIONS = 1.0 / 60.0, 20


def hanging(n, worlds=1):
    """Returns worlds with a cloth of ``2 n n`` triangles that one side holds."""
    world = newton.ModelBuilder()
    add_cloth(world, n, (0.0, 0.0, 1.0), fix_left=True)
    return _in_worlds(world, worlds)


def on_sphere(n, worlds=1):
    """Returns worlds with a cloth of ``2 n n`` triangles that touches a sphere."""
    world = newton.ModelBuilder()
    config = newton.ModelBuilder.ShapeConfig(ke=300.0, kd=0.0, mu=0.3)
    world.add_shape_sphere(-1, radius=0.5, xform=wp.transform(wp.vec3(0.0, 0.0, -0.5), wp.quat_identity()), cfg=config)
    side = 0.05 * n
    add_cloth(world, n, (-0.5 * side, -0.5 * side, CLOTH["particle_radius"]))
    return _in_worlds(world, worlds)


def _in_worlds(world, worlds):
    builder = newton.ModelBuilder()
    for _ in range(worlds):
        builder.add_world(world)
    builder.color()
    return builder


SCENES = {
    "hanging, 800 triangles": lambda: hanging(20),
    "hanging, 800 in each of 64 worlds": lambda: hanging(20, 64),
    "hanging, 2,048 triangles": lambda: hanging(32),
    "hanging, 5,000 triangles": lambda: hanging(50),
    "hanging, 20,000 triangles": lambda: hanging(100),
    "hanging, 80,000 triangles": lambda: hanging(200),
    "on a sphere, 800 triangles": lambda: on_sphere(20),
    "on a sphere, 5,000 triangles": lambda: on_sphere(50),
}


class Rollout:
    """Steps of a scene, and the gradient of where they end."""

    def __init__(self, builder, device, steps):
        """Finalizes a builder on a device."""
        self.model = builder.finalize(device=device, requires_grad=True)
        self.states = [self.model.state() for _ in range(steps + 1)]
        self.contacts = [None] * steps
        if self.model.shape_count:
            pipeline = newton.CollisionPipeline(self.model, soft_contact_gap=0.02)
            self.contacts = [pipeline.contacts() for _ in range(steps)]
            pipeline.collide(self.states[0], self.contacts[0])
            for contacts in self.contacts[1:]:  # constant, so that their detection is not timed
                for name, array in vars(self.contacts[0]).items():
                    if isinstance(array, wp.array):
                        wp.copy(getattr(contacts, name), array)
        seed = np.random.default_rng(0).normal(size=(self.model.particle_count, 3))
        self._seed = wp.array(seed, dtype=wp.vec3, device=device)

    def step(self, solver):
        """Makes all steps."""
        for start, end, contacts in zip(self.states[:-1], self.states[1:], self.contacts, strict=True):
            solver.step(start, end, None, contacts, DT)

    def back(self, solver):
        """Makes all steps on a tape, and goes back."""
        with wp.Tape() as tape:
            self.step(solver)
        tape.backward(grads={self.states[-1].particle_q: self._seed})

    def taped(self, solver):
        """Makes all steps on a tape."""
        with wp.Tape():
            self.step(solver)


def measure(scene, device, steps, repeats):
    """Returns milliseconds a step of VBD, of it on a tape, of the way back, and of VBD with ``polish=3``, as data."""

    def run(method, polish=None):
        rollout = Rollout(SCENES[scene](), device, steps)
        solver = newton.solvers.SolverVBD(rollout.model, iterations=ITERATIONS)
        if polish is not None:
            solver = bsc.SolverImplicitAdjoint(solver, polish=polish)
        time = median_milliseconds(lambda: method(rollout, solver), device, repeats) / steps
        return time, solver.report if polish is not None else None

    plain, _ = run(Rollout.step)
    taped, _ = run(Rollout.taped, 0)
    both, report = run(Rollout.back, 0)
    polished, _ = run(Rollout.step, 3)
    assert report is not None
    times = {"vbd": plain, "on a tape": taped, "back": both - taped, "polish=3": polished}
    return {"scene": scene, "milliseconds": times, "failed_solves": int(report.failed_solves)}


COLUMNS = (
    *(
        Column(header, f"milliseconds.{key}", ".2f")
        for key, header in {"vbd": "VBD", "on a tape": "on a tape", "back": "back", "polish=3": "VBD, polish=3"}.items()
    ),
    Column("back / VBD", lambda row: row["milliseconds"]["back"] / row["milliseconds"]["vbd"], ".2f"),
    Column("failed solves", "failed_solves"),
)


def main():
    """Prints the table."""
    parser = options_of(__doc__, device="cpu")
    parser.add_argument("scenes", nargs="*", default=list(SCENES), help="parts of their names; default: all")
    parser.add_argument("--steps", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    wp.config.quiet = True
    device = wp.get_device(arguments.device)
    rows = []
    for scene in (scene for scene in SCENES if any(part in scene for part in arguments.scenes)):
        rows.append(measure(scene, device, arguments.steps, arguments.repeats))
        print(scene, *(column.cell(rows[-1]) for column in COLUMNS), flush=True)
    report(arguments, "implicit_time", "scene", COLUMNS, rows, [device])


if __name__ == "__main__":
    main()
