"""Measures what arcs cost: in a detection, and in steps of the stage with bodies that turn, against chords.

``python tests/support/arc_cost.py --device cuda:0`` prints the median time of ``detect(rigid_motion=)`` and of
``detect`` on the same motion, a cloth around a ball that turns, and of steps of three scenes by arcs and by chords, on
a GPU in CUDA graphs: a ball that turns in a cloth (``--degrees`` a step), the same ball that moves straight, so that
nothing turns, and dynamic boxes that tumble on a sheet. ``--json`` writes the times to a file as well.
"""

import contextlib
import time
from unittest import mock

import newton
import numpy as np
import trimesh
import warp as wp
from measured import options_of, report
from newton_scenes import SOLVERS, add_patch

import warp_bsc as bsc
from warp_bsc.bench.tables import Column
from warp_bsc.response.state import motion

DT = 1.0 / 240.0
RADIUS = 0.2


def milliseconds(run, repeats, device):
    """Median time of a call: of the processor on a CPU, else by the clock."""
    clock = time.process_time if device.is_cpu else time.perf_counter
    times = []
    for _ in range(repeats):
        wp.synchronize_device(device)
        start = clock()
        run()
        wp.synchronize_device(device)
        times.append(1000.0 * (clock() - start))
    return float(np.median(times))


def detections(cells, degrees, repeats, device):
    """Times of a detection by arcs and by chords: a cloth that falls around a ball, which turns."""
    side = np.linspace(-1.5 * RADIUS, 1.5 * RADIUS, cells + 1)
    x, y = (values.ravel() for values in np.meshgrid(side, side, indexing="ij"))
    height = np.sqrt(np.maximum(RADIUS**2 - x**2 - y**2, 0.0)) + 0.003
    cloth = np.stack([x, y, height], axis=1)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    right, far, up = corner + cells + 1, corner + cells + 2, corner + 1
    faces = np.concatenate([np.stack([corner, right, far], axis=1), np.stack([corner, far, up], axis=1)])
    ball = trimesh.creation.icosphere(4, RADIUS)
    angle = np.radians(degrees)
    turned = ball.vertices @ np.array(
        [[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    x0 = np.concatenate([cloth, ball.vertices]).astype(np.float32)
    x1 = np.concatenate([cloth - [0, 0, 0.002], turned]).astype(np.float32)
    body = np.where(np.arange(len(x0)) < len(cloth), -1, 0)
    arcs = bsc.RigidMotion(body, [[0.0, 0.0, 0.0]], [[0.0, 0.0, angle]])
    mesh = bsc.CollisionMesh(np.concatenate([faces, ball.faces + len(cloth)]), len(x0), device=device)
    detector = bsc.CollisionDetector(mesh)
    x0, x1 = (wp.array(x, dtype=wp.vec3, device=device) for x in (x0, x1))
    found = [detector.detect(x0, x1, **options) for options in ({}, {"arcs": arcs})]
    times = [milliseconds(lambda o=o: detector.detect(x0, x1, **o), repeats, device) for o in ({"arcs": arcs}, {})]
    return times, [len(c.vertex_face) + len(c.edge_edge) for c in reversed(found)]


@wp.kernel(enable_backward=False)
def _move(count: wp.array[int], turn: float, body_q: wp.array[wp.transform]):
    """Moves the ball up and down a little, and turns it."""
    count[0] += 1
    steps = float(count[0])
    rotation = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.4, 0.2)), steps * turn)
    body_q[0] = wp.transform(wp.vec3(0.0, 0.0, 0.01 * wp.sin(0.3 * steps)), rotation)


def ball_in_cloth(cells, device):
    """A cloth that falls on a ball, which the program moves."""
    builder = newton.ModelBuilder()
    body = builder.add_body(xform=wp.transform_identity(), is_kinematic=True)
    builder.add_shape_sphere(body, radius=RADIUS)
    add_patch(builder, cells, 3.0 * RADIUS / cells, (0.0, 0.0, RADIUS + 0.015))
    builder.color()
    return builder.finalize(device=device)


def tumbling_boxes(cells, device):
    """Boxes that fall on a sheet, turning."""
    builder = newton.ModelBuilder()
    material = newton.ModelBuilder.ShapeConfig(density=300.0)
    for number in range(9):
        at = wp.vec3(0.12 * (number % 3 - 1), 0.12 * (number // 3 - 1), 0.06 + 0.01 * number)
        tilt = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, number - 4.0, 0.5)), 0.7)
        body = builder.add_body(xform=wp.transform(at, tilt))
        builder.body_qd[body] = (0.0, 0.0, -1.0, 12.0, 5.0 - number, 3.0)
        builder.add_shape_box(body, hx=0.03, hy=0.025, hz=0.02, cfg=material)
    add_patch(builder, cells, 0.5 / cells, (0.0, 0.0, 0.0), fixed=True)
    builder.color()
    return builder.finalize(device=device)


def steps(model, turn, count, on_arcs):
    """Median time of a step and results: with bodies on arcs, or on chords as if none turned."""
    device = model.device
    chords = contextlib.nullcontext() if on_arcs else mock.patch.object(motion, "BodyTurns", lambda *_: None)
    with chords:
        solver = bsc.SolverCCD(SOLVERS["vbd"](model))
    states, number = [model.state(), model.state()], wp.zeros(1, dtype=int, device=device)

    def two_steps():
        for _ in range(2):
            states[0].clear_forces()
            if turn is not None:
                wp.launch(_move, 1, inputs=[number, turn], outputs=[states[0].body_q], device=device)
            solver.step(*states, None, None, DT)
            states.reverse()

    two_steps()
    run = two_steps
    if device.is_cuda:
        with wp.ScopedCapture(device) as capture:
            two_steps()
        run = lambda: wp.capture_launch(capture.graph)  # noqa: E731
    time_of_step = 0.5 * milliseconds(run, count // 2, device)
    totals = solver.report.totals
    return time_of_step, totals.uncertified_steps


COLUMNS = (
    Column("arcs [ms]", "milliseconds.arcs", ".2f"),
    Column("chords [ms]", "milliseconds.chords", ".2f"),
    Column("ratio", lambda row: row["milliseconds"]["arcs"] / row["milliseconds"]["chords"], ".2f"),
    Column(
        "contacts, or steps not certified, by each",
        lambda row: ", ".join(map(str, row.get("contacts") or row.get("uncertified_steps"))),
        kind="word",
    ),
)


def main():
    """Runs the program."""
    parser = options_of(__doc__)
    parser.add_argument("--device")
    parser.add_argument("--cells", type=int, default=60, help="cells along a side of a cloth")
    parser.add_argument("--degrees", type=float, default=3.0, help="turn of the ball in a step")
    parser.add_argument("--steps", type=int, default=80)
    args = parser.parse_args()
    device = wp.get_device(args.device)
    rows = []

    def add(name, times, results):
        milliseconds = dict(zip(("arcs", "chords"), times, strict=True))
        key = "contacts" if name == "detect" else "uncertified_steps"
        rows.append({"name": name, "milliseconds": milliseconds, key: list(results)})

    add("detect", *detections(args.cells, args.degrees, 20, device))
    for name, build, turn in (
        (f"ball, {args.degrees:g} degrees a step", ball_in_cloth, np.radians(args.degrees)),
        ("ball, nothing turns", ball_in_cloth, 0.0),
        ("boxes that tumble", tumbling_boxes, None),
    ):
        found = [steps(build(args.cells, device), turn, args.steps, on_arcs) for on_arcs in (True, False)]
        add(name, *zip(*found, strict=True))
    settings = {"cells": args.cells, "degrees": args.degrees}
    report(args, "arc_cost", "", COLUMNS, rows, [device], name="name", **settings)


if __name__ == "__main__":
    main()
