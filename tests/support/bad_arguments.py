"""Gives every public argument bad values, and tells what each gets: ``python tests/support/bad_arguments.py``.

The callables are those of the public modules, their arguments those of their signatures. An argument that has no row in
:data:`ARGUMENTS`, and a callable that is neither called nor exempt, is an error: a new one needs a line here.
"""

import argparse
import contextlib
import functools
import inspect
import math
import re
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp
from rich.console import Console
from rich.table import Table

import warp_bsc as bsc
from warp_bsc.cli.main import build_parser
from warp_bsc.cli.options import natural, positive
from warp_bsc.detection.at_rest.intersections import IntersectionFinder, find_intersections
from warp_bsc.detection.at_rest.proximities import ProximityFinder

SECONDS = 20
"""Time after which a call counts as a hang."""

ASSETS = Path(__file__).parents[2] / "assets"


def masked(array):
    """Returns an array whose first entry is masked."""
    mask = np.zeros(array.shape, dtype=bool)
    mask.flat[0] = True
    return np.ma.MaskedArray(array, mask)


NOT_TEXT = {"None": None, "number": 3, "bool": True, "bytes": b"exact", "list": ["exact"]}
NOT_NUMBER = {
    "string": "1",
    "None": None,
    "bool": True,
    "np.bool_": np.True_,
    "complex": 1j,
    "list": [1.0],
    "array": np.ones(2),
    "object": object(),
}
NOT_FINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf, "np.nan": np.float32("nan"), "10^400": 10**400}
NOT_DISTANCE = {"negative": -1.0, "subnormal": 2.0**-1074, "half": np.nextafter(2.0**-1021, 0.0)}
NOT_COUNT = {**NOT_NUMBER, **NOT_FINITE, "half": 0.5, "negative": -1, "huge": 2**40, "float": 1.0}


def without(values: dict, *names: str) -> dict:
    """Returns the values but for some."""
    return {name: value for name, value in values.items() if name not in names}


def bad_arrays(good: np.ndarray, *, index: bool = False) -> dict[str, Any]:
    """Returns what is no array like a good one, of coordinates or of indices."""
    values = {
        "string": "points",
        "strings": np.full(good.shape, "1"),
        "None": None,
        "number": 3,
        "objects": np.full(good.shape, None),
        "object": object(),
        "ragged": [*good.tolist(), [0.0]] if good.ndim > 1 else [[0], [0, 1]],
        "complex": good.astype(complex),
        "bools": np.ones(good.shape, dtype=bool),
        "dates": np.zeros(good.shape, dtype="datetime64[s]"),
        "masked": masked(good),
        "shape": np.zeros((*good.shape, 2), dtype=good.dtype),
    }
    if index:
        values |= {"floats": good.astype(float), "negative": np.full_like(good, -1), "huge": np.full_like(good, 2**40)}
    else:
        huge = (good.astype(int) - 2**53 - 1).tolist()
        values |= {"integers": good.astype(int), "huge": huge, "half precision": good.astype(np.float16)}
    return values


def bad_bits(count: int) -> dict[str, Any]:
    """Returns what is neither 32 bits nor an array of 32 bits for each of some things."""
    arrays = without(bad_arrays(np.zeros(count, int), index=True), "None", "number", "negative", "huge")
    one = {"bool": True, "float": 1.0, "negative": -2, "33 bits": 2**32, "10^400": 10**400}
    return arrays | one | {"one bad": [1] * (count - 1) + [2**32], "rows": np.zeros(count + 1, int)}


def not_finite(good: np.ndarray) -> dict[str, Any]:
    """Returns coordinates that are not finite."""
    return {
        "nan": np.full_like(good, np.nan),
        "inf": np.full_like(good, np.inf),
        "big-endian nan": np.full_like(good, np.nan).astype(">f8"),
    }


FACES = np.array([[0, 1, 2], [3, 4, 5]])
X = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]], dtype=float)
ORIGIN = np.zeros((1, 3))
POINTS = {name: np.zeros((2, 2 * n, 3)) for name, n in (("vertex_face", 4), ("edge_edge", 4), ("vertex_edge", 3))}
POINTS["vertex_vertex"] = np.zeros((2, 4, 3))

FLAGS = {"string": "no", "None": None, "number": 3, "zero": 0, "array": np.ones(2, bool)}
CHOICES = {**NOT_TEXT, "unknown": "fast", "empty": ""}
NUMBERS = {**NOT_NUMBER, **NOT_FINITE}
DISTANCES = {**NUMBERS, **NOT_DISTANCE}
MANY_DISTANCES = {
    **without(DISTANCES, "list", "array"),
    "shape": np.ones(3),
    "one bad": [1.0, -1.0],
    "one subnormal": [1.0, 2.0**-1060],
    "masked": masked(np.ones(2)),
    "ragged": [[1.0], [1.0, 2.0]],
    "strings": ["1", "1"],
    "half subnormal": np.full(2, 2.0**-1022),
}
POSITIVE = {**DISTANCES, "zero": 0.0}
TOLERANCES = {**NUMBERS, "zero": 0.0, "negative": -1.0, "above 1": 2.0, "small": 2.0**-39}
DEVICES = {"number": 3, "unknown": "gpu:9", "empty": "", "list": ["cpu"], "bool": True}
COORDINATES = {**bad_arrays(X), **not_finite(X), "rows": np.zeros((5, 3))}
OBJECTS = {"None": None, "string": "mesh", "number": 3, "class": object}
FUNCTIONS = {"string": "print", "number": 3}
STRINGS = {"string": "/World", "number": 3, "None": None, "numbers": (1, 2), "bytes": b"/World"}
PAIRS = {"string": "/World", "number": 3, "flat": ("/A", "/B"), "one": (("/A",),), "numbers": ((1, 2),)}


@dataclass(frozen=True)
class Row:
    """What a bad value of an argument got.

    Attributes:
        function: The callable.
        argument: The argument.
        value: The value's name.
        got: Type and first line of the error, "accepted" or "hangs".
        flag: What is wrong with it; empty if nothing.
    """

    function: str
    argument: str
    value: str
    got: str
    flag: str


@dataclass(frozen=True)
class Call:
    """A public callable with good arguments, and bad values by argument."""

    function: Callable
    good: dict[str, Any]
    bad: dict[str, dict[str, Any]]
    raises: Callable | None = None  # whose docstring names the errors, if that is another one
    exempt: frozenset[str] = frozenset()  # arguments that are passed on


class Idle(newton.solvers.SolverBase):
    """A solver that leaves everything where it is."""

    def step(self, state_in, state_out, control, contacts, dt):
        state_out.assign(state_in)


def solver(*, requires_grad: bool = False) -> Idle:
    """Returns a solver of a model with two triangles."""
    builder = newton.ModelBuilder()
    builder.add_cloth_grid(
        pos=wp.vec3(), rot=wp.quat_identity(), vel=wp.vec3(), dim_x=1, dim_y=1, cell_x=0.1, cell_y=0.1, mass=0.1
    )
    builder.color()
    return Idle(builder.finalize(device="cpu", requires_grad=requires_grad))


def calls() -> dict[str, Call]:
    """Returns all public callables that take arguments from users."""
    mesh = bsc.CollisionMesh(FACES, 6, device="cpu")
    detector = bsc.CollisionDetector(mesh)
    found: dict[str, Call] = {}
    tets = np.array([[0, 1, 2, 3], [1, 2, 3, 5]])
    arrays = {"edges": np.array([[0, 3]]), "points": np.array([1]), "tets": tets, "faces": FACES}
    indices = {name: bad_arrays(good, index=True) for name, good in arrays.items()}
    for name in ("edges", "points", "tets"):
        indices[name] = without(indices[name], "None")
    world = without(bad_arrays(np.zeros(6, int), index=True), "None", "huge")
    found["CollisionMesh"] = Call(
        bsc.CollisionMesh,
        {"faces": FACES, "vertex_count": 6, "device": "cpu"},
        {
            **indices,
            "vertex_count": NOT_COUNT,
            "radius": without(MANY_DISTANCES, "None") | {"one bad": [1.0] * 5 + [-1.0], "masked": masked(np.ones(6))},
            "world": world | {"huge": np.full(6, 2**31), "mixed": np.arange(6)},
            "group": bad_bits(6),
            "mask": bad_bits(6),
            "only_free": FLAGS,
            "device": DEVICES,
        },
        raises=bsc.CollisionMesh.__init__,
    )
    found["CollisionDetector"] = Call(
        bsc.CollisionDetector,
        {"mesh": mesh},
        {
            "mesh": {**OBJECTS, "arrays": (FACES, 6)},
            "method": CHOICES,
            "tolerance": TOLERANCES,
            "min_distance": DISTANCES,
            "rings": NOT_COUNT,
        },
        raises=bsc.CollisionDetector.__init__,
    )
    found["CollisionDetector.detect"] = Call(
        detector.detect,
        {"x0": X, "x1": X},
        {
            "x0": COORDINATES,
            "x1": COORDINATES,
            "vertices": without(bad_arrays(np.ones(6, dtype=bool)), "None", "bools") | {"rows": np.ones(5, dtype=bool)},
            "rigid_motion": without(OBJECTS, "None") | {"rows": bsc.RigidMotion(np.zeros(5, int), ORIGIN, ORIGIN)},
        },
    )
    body = np.array([0, 0, 0, -1, -1, -1])
    bodies = without(bad_arrays(body, index=True), "negative") | {"below -1": body - 1, "no such body": body + 1}
    rows = bad_arrays(ORIGIN) | not_finite(ORIGIN) | {"rows": np.zeros((2, 3))}
    found["RigidMotion"] = Call(
        bsc.RigidMotion,
        {"body": body, "centre": ORIGIN, "turn": ORIGIN},
        {
            "body": bodies,
            "centre": without(rows, "rows") | {"huge": ORIGIN + 1e200},
            "turn": rows | {"huge": ORIGIN + 5000.0, "tiny": ORIGIN + 1e-150},
            "tolerance": without(POSITIVE, "None"),
        },
        raises=bsc.RigidMotion.__init__,
    )
    pose = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    poses = bad_arrays(pose) | not_finite(pose) | {"no quaternion": np.zeros((1, 7))}
    found["RigidMotion.between"] = Call(
        bsc.RigidMotion.between,
        {"body": body, "pose_0": pose, "pose_1": pose},
        {
            "body": bodies,
            "pose_0": poses,
            "pose_1": poses | {"rows": np.repeat(pose, 2, axis=0)},
            "tolerance": without(POSITIVE, "None"),
        },
    )
    still = bsc.RigidMotion(body, ORIGIN, ORIGIN)
    found["RigidMotion.positions"] = Call(
        still.positions,
        {"x0": X, "x1": X, "time": 0.5},
        {"x0": COORDINATES, "x1": COORDINATES, "time": NUMBERS | {"early": -0.1, "late": 1.1}},
    )

    def capture(x0, x1, rigid_motion=None):
        with wp.ScopedCapture("cpu"):
            detector.capture(x0, x1, rigid_motion=rigid_motion)

    on_device = wp.array(X, dtype=wp.vec3d, device="cpu")
    found["CollisionDetector.capture"] = Call(
        capture,
        {"x0": on_device, "x1": on_device},
        {"x0": COORDINATES, "x1": COORDINATES, "rigid_motion": without(OBJECTS, "None")},
        raises=detector.capture,
    )
    for name in ("candidates", "collision_free_step"):
        found[f"CollisionDetector.{name}"] = Call(
            getattr(detector, name), {"x0": X, "x1": X}, {"x0": COORDINATES, "x1": COORDINATES}, raises=detector.detect
        )
    for name in ("has_intersections", "least_distance"):
        found[f"CollisionDetector.{name}"] = Call(
            getattr(detector, name),
            {"x": X},
            {"x": COORDINATES, "rings": NOT_COUNT} if name == "least_distance" else {"x": COORDINATES},
            raises=detector.find_proximities,
        )
    found["CollisionDetector.find_intersections"] = Call(detector.find_intersections, {"x": X}, {"x": COORDINATES})
    of_tets = bsc.CollisionDetector(bsc.CollisionMesh(FACES, 6, tets=tets, device="cpu"))
    found["CollisionDetector.inversions"] = Call(
        of_tets.inversions, {"x0": X, "x1": X}, {"x0": COORDINATES, "x1": COORDINATES}
    )
    found["CollisionDetector.find_inversions"] = Call(of_tets.find_inversions, {"x": X}, {"x": COORDINATES})
    found["CollisionDetector.find_proximities"] = Call(
        detector.find_proximities,
        {"x": X, "distance": 0.1},
        {"x": COORDINATES, "distance": POSITIVE, "rings": NOT_COUNT},
    )
    found["CollisionMesh.device_positions"] = Call(
        mesh.device_positions,
        {"x": X, "name": "x"},
        {"x": without(COORDINATES, *not_finite(X))},
        exempt=frozenset({"name"}),
    )
    found["find_intersections"] = Call(
        find_intersections, {"mesh": mesh, "x": X}, {"mesh": OBJECTS, "x": COORDINATES}, raises=IntersectionFinder.find
    )
    found["ProximityFinder"] = Call(
        ProximityFinder,
        {"mesh": mesh, "distance": 0.1},
        {"mesh": OBJECTS, "distance": POSITIVE, "rings": NOT_COUNT},
        raises=ProximityFinder.__init__,
    )
    found["DeviceQueryResult"] = Call(
        bsc.DeviceQueryResult,
        {"count": 1, "device": "cpu"},
        {"count": NOT_COUNT | {"huge": 2**28}, "toi": FLAGS, "device": without(DEVICES)},
    )
    for kind, good in POINTS.items():
        bad = {**bad_arrays(good), **not_finite(good)}
        found[f"query_{kind}"] = Call(
            getattr(bsc, f"query_{kind}"),
            {"points": good[:0], "device": "cpu"},
            {
                "points": bad,
                "min_distance": without(MANY_DISTANCES, "one bad", "one subnormal", "half subnormal", "masked")
                | {"masked": masked(np.ones(1))},
                "method": CHOICES,
                "toi": FLAGS,
                "tolerance": TOLERANCES,
                "device": without(DEVICES),
            }
            | ({"out": without(OBJECTS, "None")} if kind in ("vertex_face", "edge_edge") else {}),
        )
        for name in (kind, f"{kind}_toi"):
            function = getattr(bsc.checker, name)
            distances = {"points": bad, "min_distance": MANY_DISTANCES}
            found[f"checker.{name}"] = Call(function, {"points": good}, distances, raises=bsc.checker.vertex_face)
    pair = {"edges": np.zeros((2, 2, 3)), "faces": np.zeros((2, 3, 3)), "across": np.zeros((2, 3, 3))}
    bad = {name: {**bad_arrays(good), **not_finite(good), "length": good[:1]} for name, good in pair.items()}
    for name in ("edge_face_crossings", "edges_pass_faces"):
        names = list(inspect.signature(getattr(bsc.checker, name)).parameters)
        good = {argument: pair[argument] for argument in names}
        found[f"checker.{name}"] = Call(getattr(bsc.checker, name), good, {a: bad[a] for a in names})
    moving = np.zeros((2, 8, 3))
    for name in ("tetrahedron", "tetrahedron_toi"):
        bad_points = {**bad_arrays(moving), **not_finite(moving)}
        found[f"checker.{name}"] = Call(getattr(bsc.checker, name), {"points": moving}, {"points": bad_points})
    points = np.zeros((2, 3))
    found["checker.rays_pass_faces"] = Call(
        bsc.checker.rays_pass_faces,
        {"points": points, "faces": pair["faces"]},
        {"points": {**bad_arrays(points), **not_finite(points), "length": points[:1]}, "faces": bad["faces"]},
    )
    pairs = np.array([[0, 1]])
    found["query_points"] = Call(
        bsc.query_points,
        {"elements": FACES, "pairs": pairs, "x0": X, "x1": X},
        {
            "elements": without(bad_arrays(FACES, index=True), "None") | {"columns": np.zeros((2, 4), int)},
            "kind": without(CHOICES, "None") | {"of edges": "edge_edge", "of points": "vertex_vertex"},
            "pairs": bad_arrays(pairs, index=True),
            "x0": without(bad_arrays(X)) | {"rows": np.zeros((5, 3))},
            "x1": bad_arrays(X) | {"rows": np.zeros((5, 3)), "single": X.astype(np.float32)},
        },
    )
    ends = np.zeros((2, 2, 3))
    found["distances"] = Call(
        bsc.distances,
        {"points": ends, "kind": "vertex_vertex"},
        {
            "points": bad_arrays(ends) | not_finite(ends) | {"huge": ends + 1e305},
            "kind": CHOICES,
            "device": without(DEVICES),
        },
    )
    arrays = {name: wp.zeros(shape, dtype=wp.vec3, device="cpu") for name, shape in (("points", (1, 4)), ("x", (2, 6)))}
    arrays["faces"] = wp.array(FACES, dtype=int, device="cpu")
    others = {"numpy": np.zeros((2, 3)), "type": wp.zeros((2, 3), dtype=wp.float64, device="cpu"), "string": "x"}
    others |= {"number": 3, "shape": wp.zeros((1, 1, 1), dtype=float, device="cpu"), "object": object()}
    found["chamfer_distance"] = Call(
        bsc.chamfer_distance,
        arrays,
        dict.fromkeys(("weights", "out"), others) | dict.fromkeys(arrays, others | {"None": None}),
    )
    part = bad_arrays(np.zeros(6, int), index=True)
    found["leave_out"] = Call(
        bsc.leave_out,
        {"part": [0, 0, 0, 1, 1, 1], "pairs": [[0, 1]]},
        {"part": without(part, "negative", "huge"), "pairs": bad_arrays(pairs, index=True)},
    )
    vertices = without(bad_arrays(np.array([1]), index=True), "None")
    found["repair"] = Call(
        bsc.repair,
        {"mesh": mesh, "x": X},
        {
            "mesh": without(OBJECTS, "None") | {"negative": -FACES, "columns": np.zeros((2, 4), int)},
            "x": COORDINATES,
            "fixed": vertices,
            "rigid": without(bad_arrays(np.zeros(6, int), index=True), "None", "negative")
            | {"negative": np.full(6, -2), "shared": [[0, 1], [1, 2]], "out of range": [[0], [9]]},
            "order": without(bad_arrays(np.zeros(6, int), index=True), "None", "negative")
            | {"negative": np.full(6, -2), "shared": [[0, 1], [1, 2]], "out of range": [[0], [9]]},
            "x_previous": without(COORDINATES, "None") | {"single": X.astype(np.float32)},
            "min_distance": without(DISTANCES, "None"),
            "seam_tolerance": without(DISTANCES, "None") | {"wider than faces": 10.0},
            "max_strain": {**NUMBERS, "zero": 0.0, "negative": -1.0},
            "time_limit": {**without(NUMBERS, "None"), "zero": 0.0, "negative": -1.0},
            "device": {"beside a mesh": "cpu"},
        },
    )
    found["check"] = Call(
        bsc.check,
        {"mesh": mesh, "x": X},
        {
            "mesh": without(OBJECTS, "None") | {"negative": -FACES, "columns": np.zeros((2, 4), int)},
            "x": COORDINATES,
            "device": {"beside a mesh": "cpu"},
        },
    )
    found |= calls_of_scenes() | calls_of_solvers()
    return found


def calls_of_scenes() -> dict[str, Call]:
    """Returns the callables that need a USD file."""
    path = ASSETS / "cloth_twist.usd"
    scene = bsc.Scene(path)
    triage = Path(tempfile.mkdtemp()) / "shot.triage.json"
    triage.write_text('{"version": 1, "meant": []}')
    bound = without(NUMBERS, "None")
    times = {"start": bound, "end": bound | {"before": 0.0}, "step": bound | {"zero": 0.0, "negative": -1.0}}
    return {
        "FrameRange": Call(bsc.FrameRange, {"start": 1.0}, times),
        "Selection": Call(
            bsc.Selection,
            {},
            {
                "prims": STRINGS,
                "exclude": STRINGS,
                "self_collisions": FLAGS,
                "between": without(STRINGS, "None") | {"three": ("/A", "/B", "/C"), "one": ("/A",)},
                "purposes": STRINGS | {"unknown": ("shown",)},
                "ignore": PAIRS,
                "triage": {**OBJECTS, "path": "shot.triage.json", "pairs": (("/A", "/B"),)},
                "ignored_names": PAIRS,
                "ignored_inside": PAIRS,
            },
        ),
        "read_triage": Call(
            bsc.read_triage,
            {"path": triage},
            {"path": {"None": None, "number": 3.0, "list": [triage]}, "of_files": {"None": None, "text": "yes"}},
        ),
        "Scene": Call(
            bsc.Scene,
            {"source": path},
            {
                "source": {"None": None, "number": 3, "list": ["a.usd"], "missing": "missing.usd"},
                "selection": {"string": "/World", "list": ["/World"]},
                "frames": {"pair": (1, 3), "string": "1:3", "nothing there": bsc.FrameRange(1e6, 2e6)},
                "subdivide": {**NOT_COUNT, "zero": 0},
                "sample_turns": FLAGS,
                "strict": FLAGS,
                "allow_missing": STRINGS,
                "progress": FUNCTIONS,
            },
            raises=bsc.Scene.__init__,
        ),
        "Scene.interval": Call(scene.interval, {"index": 0}, {"index": {**NOT_COUNT, "last": len(scene)}}),
        "Scene.intervals": Call(
            scene.intervals,
            {},
            {"first": NOT_COUNT, "stop": without({**NOT_COUNT, "more": len(scene) + 1}, "None")},
        ),
        "replay": Call(
            bsc.replay,
            {"scene": scene, "device": "cpu"},
            {
                "scene": {**OBJECTS, "path": path},
                "method": CHOICES,
                "device": without(DEVICES, "unknown", "empty"),  # of the machine that checks
                "intersections": FLAGS,
                "ignore_initial": FLAGS,
                "clearance": without(POSITIVE, "None"),
                "validate": {**NOT_COUNT, "word": "some", "empty": ""},
                "earlier": {"None": None, "number": 3},
                "workers": {
                    **without(NOT_COUNT, "None"),
                    "zero": 0,
                    "word": "head",
                    "no host": "tcp://",
                    "list": ["tcp://head"],
                },
            },
        ),
    }


def calls_of_solvers() -> dict[str, Call]:
    """Returns the callables of the collision stage."""
    inner = solver()
    stage = bsc.SolverCCD(inner)
    start, end = inner.model.state(), inner.model.state()
    solvers = {**OBJECTS, "model": inner.model}
    count = inner.model.particle_count
    coefficient = without(NUMBERS, "None") | {
        "negative": -1.0,
        "doubles": wp.zeros(1, dtype=wp.float64, device="cpu"),
        "shape": wp.zeros(count + 1, dtype=wp.float32, device="cpu"),
    }
    double = wp.zeros(count, dtype=wp.float64, device="cpu", requires_grad=True)
    distances = without(DISTANCES, "None") | {
        "doubles with gradients": double[:1],
        "Warp array of two": wp.zeros(2, dtype=float, device="cpu"),
        "negative in a Warp array": wp.full(1, -1.0, dtype=float, device="cpu"),
    }
    radii = without(MANY_DISTANCES, "None") | {
        "doubles with gradients": double,
        "one bad": [1.0] * (count - 1) + [-1.0],
        "masked": masked(np.ones(count)),
    }
    filters = without(OBJECTS, "None") | {
        "bits": {"particle_group": 1},
        "too few": bsc.CollisionFilter(particle_mask=np.ones(count - 1, dtype=int)),
        "shapes": bsc.CollisionFilter(shape_group=[1]),
    }
    tables = {
        "list": [[0.1]],
        "table of fewer": bsc.FrictionTable([[0.1]], particle_material=np.zeros(count - 1, dtype=int)),
        "table of other shapes": bsc.FrictionTable([[0.1]], shape_material=[0]),
    }
    coefficients = without(bad_arrays(np.zeros((2, 2))), "integers", "half precision") | {
        "not square": np.zeros((2, 1)),
        "empty": np.zeros((0, 0)),
        "not symmetric": [[0.1, 0.2], [0.3, 0.1]],
        "nan": [[math.nan]],
        "inf": [[math.inf]],
        "huge": [[1e39]],
        "doubles": wp.zeros((1, 1), dtype=wp.float64, device="cpu"),
        "one dimension": wp.zeros(2, dtype=float, device="cpu"),
    }
    materials = without(bad_bits(count), "rows") | {"too large": 1, "two-dimensional": np.zeros((2, 2), dtype=int)}
    bits = without(bad_bits(count), "rows") | {"two-dimensional": np.ones((2, 2), dtype=int)}
    reporting = bsc.SolverCCD(inner, report=["contacts"])
    patterns = {"None": None, "number": 3, "string": "particles", "numbers": [3], "unknown": ["nothing"]}
    counts = {name: {"contacts": value} for name, value in (without(NOT_COUNT, "bool") | {"zero": 0}).items()}
    reported = patterns | counts | {f"worlds {name}": {"worlds": value} for name, value in FLAGS.items()}
    differentiable = bsc.SolverImplicit(solver(requires_grad=True).model)
    found = {
        "CollisionFilter": Call(
            bsc.CollisionFilter,
            {},
            dict.fromkeys(["particle_group", "particle_mask", "shape_group", "shape_mask"], bits),
            raises=bsc.CollisionFilter,
        ),
        "FrictionTable": Call(
            bsc.FrictionTable,
            {"coefficients": [[0.1]]},
            {
                "coefficients": coefficients,
                "particle_material": materials,
                "shape_material": materials,
                "particle_mu": without(NUMBERS, "None") | {"negative": -1.0, "doubles": coefficient["doubles"]},
            },
            raises=bsc.FrictionTable,
        ),
        "SolverCCD": Call(
            bsc.SolverCCD,
            {"solver": inner},
            {
                "solver": solvers,
                "separation": without(POSITIVE, "None"),
                "friction": coefficient | {"huge": 1e39} | tables,
                "restitution": coefficient | {"above 1": 1.5},
                "substeps": NOT_COUNT | {"zero": 0, "many": 1025},
                "bodies": {"unknown": "moved", "flag": True, "None": None},
                "inversions": {"unknown": "counted", "flag": True, "None": None},
                "max_iterations": NOT_COUNT | {"too many": 41},
                "report": reported,
                "min_distance": distances,
                "particle_radius": radii,
                "collision_filter": filters,
            },
            raises=bsc.SolverCCD.__init__,
        ),
        "CollisionMonitor": Call(
            bsc.CollisionMonitor,
            {"solver": inner},
            {
                "solver": solvers,
                "min_distance": distances,
                "particle_radius": radii,
                "collision_filter": filters,
                "report": reported,
            },
            raises=bsc.CollisionMonitor.__init__,
        ),
        "SolverImplicit": Call(
            bsc.SolverImplicit,
            {"model": inner.model},
            {
                "model": OBJECTS,
                "friction": coefficient | {"huge": 1e39} | tables,
                "min_distance": distances,
                "particle_radius": radii,
                "collision_filter": filters,
                "bodies": {"unknown": "moved", "flag": True, "None": None},
                "inversions": {"unknown": "counted", "flag": True, "None": None},
                "max_iterations": without(NOT_COUNT, "None") | {"zero": 0},
                "report": reported,
            },
            raises=bsc.SolverImplicit.__init__,
        ),
        "checkpointed": Call(
            bsc.checkpointed,
            {
                "solver": differentiable,
                "step": lambda k, start, end: differentiable.step(start, end, None, None, 0.01),
                "state_in": start,
                "state_out": end,
                "steps": 1,
            },
            {
                "solver": {**OBJECTS, "another": inner, "no gradients": bsc.SolverImplicit(inner.model)},
                "step": {**FUNCTIONS, "None": None},
                "state_in": OBJECTS,
                "state_out": {**OBJECTS, "the same": start},
                "steps": NOT_COUNT | {"zero": 0},
                "every": without(NOT_COUNT, "None") | {"zero": 0},
                "outputs": {"None": None, "array": wp.zeros(1, dtype=float, device="cpu"), "numbers": [3]},
            },
        ),
        "CapturedSteps": Call(
            bsc.CapturedSteps,
            {"steps": print, "solver": inner},
            {
                "steps": {**FUNCTIONS, "None": None},
                "solver": solvers,
            },
            raises=bsc.CapturedSteps.__init__,
        ),
        "ContactSensor": Call(
            bsc.ContactSensor,
            {"solver": reporting, "sensors": ["particles"]},
            {
                "solver": {**OBJECTS, "another": inner},
                "sensors": {**patterns, "none": []},
                "filters": patterns,
                "history_length": NOT_COUNT | {"zero": 0},
                "force_threshold": {**NUMBERS, "negative": -1.0},
            },
            raises=bsc.ContactSensor.__init__,
        ),
        "repair_state": Call(
            bsc.repair_state,
            {"model": inner.model, "state": start},
            {
                "model": OBJECTS,
                "state": {**OBJECTS, "model": inner.model},
                "order": without(bad_arrays(np.zeros(count, int), index=True), "None", "negative"),
                "min_distance": without(DISTANCES, "None"),
                "max_strain": {**NUMBERS, "zero": 0.0, "negative": -1.0},
            },
        ),
    }
    masks = {
        "list": [True, True],
        "NumPy": np.ones(2, dtype=bool),
        "integers": wp.ones(2, dtype=int, device="cpu"),
        "shape": wp.ones(1, dtype=bool, device="cpu"),
    }
    sensor, lengths = bsc.ContactSensor(reporting, ["particles"]), {**NUMBERS, "zero": 0.0, "negative": -0.01}
    found["ContactSensor.update"] = Call(sensor.update, {"dt": 0.01}, {"dt": lengths, "world_mask": masks})
    found["ContactSensor.reset"] = Call(sensor.reset, {}, {"world_mask": masks})
    states = {"state_in": start, "state_out": end, "control": None, "contacts": None, "dt": 0.01}
    for name, cls in (
        ("SolverCCD", stage),
        ("SolverImplicit", bsc.SolverImplicit(inner.model)),
        ("CollisionMonitor", bsc.CollisionMonitor(inner)),
    ):
        found[f"{name}.step"] = Call(
            cls.step,
            states,
            {"dt": lengths, "world_mask": masks},
            exempt=frozenset({"state_in", "state_out", "control", "contacts", "options"}),
        )
    return found


RESULTS = {
    "CapturedCollisions",
    "DifferentiableContacts",
    "Collisions",
    "DetectionStats",
    "IntervalResult",
    "IntervalSummary",
    "QueryResult",
    "MeshCheck",
    "RepairResult",
    "SceneContacts",
    "SceneIntersections",
    "SceneProximities",
    "SolverReport",
    "StateRepairResult",
    "UnresolvedContour",
}
"""Classes of results, which users read and do not make; their methods take slices of rows."""

PASSED_ON = re.compile(
    r"(SolverCCD|SolverImplicit|CollisionMonitor)\.(coupling_\w+|"
    r"notify_model_changed|observables|reset|"
    r"set_collision_frequency|update_contacts|validate_observables)$"
)
"""Methods that delegate to the inner solver, which checks their arguments."""

INTERNAL = {
    "CollisionFilter.bits_of_particles",
    "CollisionFilter.bits_of_shapes",
    "CollisionMesh.device_elements",
    "CollisionMesh.elements",
    "FrameRange.bounds",
    "FrameRange.times",
    "FrictionTable.materials",
    "FrictionTable.on_device",
    "Scene.note",
    "Scene.prim_of",
    "Scene.segment",
    "Scene.take_notes",
    "Selection.check_patterns",
    "Selection.counted_pairs",
    "Selection.ignored_pairs",
    "Selection.includes",
    "Selection.may_be_inside",
    "Selection.meant",
    "Selection.unmatched",
}
"""Methods that the package calls with objects of its own."""


def public() -> Iterator[tuple[str, list[str]]]:
    """Yields all public callables with their arguments."""
    for name in bsc.checker.__all__:
        yield f"checker.{name}", list(inspect.signature(getattr(bsc.checker, name)).parameters)
    for name in bsc.__all__:
        value = getattr(bsc, name)
        if inspect.ismodule(value) or name in RESULTS:
            continue
        yield name, list(inspect.signature(value).parameters)
        for method, function in inspect.getmembers(value, inspect.isfunction) if inspect.isclass(value) else ():
            if not method.startswith("_") and function.__module__.startswith("warp_bsc"):
                arguments = list(inspect.signature(function).parameters)[1:]
                if arguments:
                    yield f"{name}.{method}", arguments


def missing(found: dict[str, Call]) -> Iterator[Row]:
    """Yields what has no bad values here."""
    for name, arguments in public():
        if name in INTERNAL or PASSED_ON.match(name):
            continue
        if name not in found:
            yield Row(name, "", "", "", "has no row: add it to calls()")
            continue
        for argument in arguments:
            if argument not in found[name].bad and argument not in found[name].exempt:
                yield Row(name, argument, "", "", "has no bad values: add some to calls()")


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """Raises a TimeoutError where the block takes too long, if it returns to Python at all."""

    def stop(*_):
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def ask(name: str, argument: str, value: str, call: Callable[[], object], documented: str, named: str) -> Row:
    """Calls a function with a bad value, and judges what it gets."""
    try:
        with limited():
            call()
    except TimeoutError:
        return Row(name, argument, value, "hangs", "hangs")
    except Exception as error:
        message = str(error).split("\n")[0]
        kind = type(error).__name__
        flag = ""
        if not isinstance(error, TypeError | ValueError) and kind not in documented:
            flag = "neither a TypeError nor a ValueError, nor documented"
        elif not isinstance(error, OSError) and not re.search(rf"(?<![\w-]){re.escape(named)}\b", message):
            flag = "does not name the argument"
        elif len(message) > 400:
            flag = "is too long"
        return Row(name, argument, value, f"{kind}: {message}", flag)
    return Row(name, argument, value, "accepted", "has no meaning")


def rows() -> list[Row]:
    """Returns what every bad value of every public argument and option gets."""
    found = calls()
    result = list(missing(found))
    for name, call in found.items():
        documented = inspect.getdoc(call.raises or call.function) or ""
        try:
            call.function(**call.good)
        except Exception as error:
            result.append(Row(name, "", "all good", f"{type(error).__name__}: {error}", "should be accepted"))
        for argument, values in call.bad.items():
            for value, bad in values.items():
                ask_it = functools.partial(call.function, **{**call.good, argument: bad})
                result.append(ask(name, argument, value, ask_it, documented, argument))
    return result + option_rows()


NUMERIC = ["", "x", "nan", "inf", "-1", "0", "0.5", "1e400", "1e-320", "True", "10" * 20]
NUMBERS_OF: dict[Any, list[str]] = {positive: NUMERIC, natural: [text for text in NUMERIC if text != "0"]}
VALUES: dict[str, list[str]] = {
    "--clearance": ["", "x", "nan", "inf", "-1", "0", "1e400", "1e-320", "True"],
    "--min-distance": ["", "x", "nan", "inf", "-1", "0", "1e400", "1e-320", "True"],
    "--max-strain": ["", "x", "nan", "inf", "-1", "0", "1e400", "True"],
    "--max-move": ["", "x", "nan", "inf", "-1", "0", "1e400", "1e-320", "True"],
    "--fail-on": ["", "x", "collisions,x"],
    "--frames": ["", "x", "1", "3:1", "1:2:0", "1:2:-1", "nan:2", "1:inf", "1:2:3:4"],
    "--validate": [*NUMERIC, "ALL"],
    "--workers": [*NUMERIC, "head:8786", "tcp://", "://head:8786"],
    "--modes": ["", "x", "plain,x"],
    "--scene": ["", "x", "bullet,x"],
    "--simulator": ["", "x", "vbd,x"],
    "--kinds": ["", "x", "bodies,x"],
    "--configurations": ["", "x", "plain,x"],
    "--seconds": ["", "x", "nan", "inf", "-1", "0", "1e400", "True"],
    "--perturb": ["", "x", "nan", "inf", "-1", "0", "1e400", "1e-320", "True"],
}


def option_rows() -> list[Row]:
    """Returns what bad values of all options of the command line get from its parser."""

    def commands(parser, path):
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                for name, command in action.choices.items():
                    yield from commands(command, [*path, name])
                return
        yield path, parser

    result = []
    for path, parser in commands(build_parser(), []):
        for action in parser._actions:
            option = next((text for text in action.option_strings if text.startswith("--")), None)
            if option is None or action.nargs == 0 or (action.choices is None and action.type is None):
                if option and action.nargs != 0 and option not in TEXTS:
                    result.append(Row(" ".join(path), option, "", "", "takes any text: add it to TEXTS, or check it"))
                continue
            if option in TEXTS:
                continue
            values = ["x", ""] if action.choices else NUMBERS_OF.get(action.type) or VALUES[option]
            positional = ["file"] * any(not a.option_strings and a.nargs in (None, "+") for a in parser._actions)
            for value in values:
                line = [*path, *positional, f"{option}={value}"]
                parse = functools.partial(build_parser().parse_args, line)
                result.append(ask(" ".join(path), option, repr(value), parse, "", option))
    return result


TEXTS = {
    "--prims",
    "--exclude",
    "--keep",
    "--previous",
    "--rigid",
    "--output",
    "--figure",
    "--between",
    "--ignore",
    "--triage",
    "--overlay",
    "--report",
    "--json",
    "--csv",
    "--npz",
    "--baseline",
    "--allow-missing",
    "--device",
}
"""Options whose text is looked up where it is used: patterns, files, devices and addresses."""


def main() -> int:
    """Prints the table, and returns 1 if anything is flagged."""
    wp.config.log_level = wp.LOG_ERROR
    found = rows()
    console = Console(width=200)
    table = Table("function", "argument", "value", "got", "flag")
    for row in found if "--all" in sys.argv else [row for row in found if row.flag]:
        table.add_row(row.function, row.argument, row.value, row.got[:120], row.flag)
    console.print(table)
    flagged = sum(bool(row.flag) for row in found)
    console.print(f"{len(found)} bad values, {flagged} flagged")
    return int(flagged > 0)


if __name__ == "__main__":
    sys.exit(main())
