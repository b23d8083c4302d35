"""The scenes that benchmarks measure, read from files or generated."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from ...detection.mesh import CollisionMesh
from ...detection.pipeline import DetectionPipeline
from ...detection.run.launch import retry_until_fits
from ...detection.run.settings import PairKind
from ...usd.scene import Scene
from .mesh_files import read_mesh

PAPER_SCENES = ("twisting", "funnel", "dancer", "flamenco", "crashing")
"""Names of the scenes of the paper's benchmarks (Sec. 5.2)."""

_MIN_TRIANGLES, _MAX_TRIANGLES = 1000, 20_000_000


@dataclass(frozen=True)
class BenchmarkScene:
    """A mesh and one step of its motion."""

    name: str  # the name that the user gave, and the number of worlds if there are many
    faces: np.ndarray  # vertex indices, int32, shape [face_count, 3]
    x0: np.ndarray  # positions at the start of the step, float32 or float64, shape [vertex_count, 3]
    x1: np.ndarray  # positions at its end, of the same type
    world: np.ndarray | None = None  # world of each vertex, int32, shape [vertex_count]; None if all are in one

    def in_worlds(self, count: int) -> "BenchmarkScene":
        """Returns the scene in a number of worlds, which do not collide with each other; in one, the scene itself.

        Raises:
            ValueError: If that makes 2^31 vertices or more.
        """
        if count == 1:
            return self
        vertices = len(self.x0)
        if vertices * count >= 2**31:
            raise ValueError(f"{self.name}: {count} worlds have too many vertices, more than 2^31")
        offsets = vertices * np.arange(count, dtype=np.int32)[:, None, None]
        return BenchmarkScene(
            name=f"{self.name} in {count:,} worlds",
            faces=(self.faces + offsets).reshape(-1, 3),
            x0=np.tile(self.x0, (count, 1)),
            x1=np.tile(self.x1, (count, 1)),
            world=np.repeat(np.arange(count, dtype=np.int32), vertices),
        )


def is_scene_name(text: str) -> bool:
    """Returns whether a text is the name of a scene, as of :func:`load_scene`, not that of another file."""
    return ":" in text or "," in text or Path(text).suffix.startswith(".usd")


def default_scenes() -> list[str]:
    """Returns the scenes that are measured by default: that of a checkout, if this is one, and generated ones."""
    scene = Path(__file__).parents[3] / "assets" / "cloth_twist.usd"
    return [*([str(scene)] if scene.exists() else []), "cloth:5000", "cloth:50000"]


def load_scene(name: str, *, interval: int = 0) -> BenchmarkScene:
    """Reads or generates a scene.

    Args:
        name: A USD file; two meshes joined by a comma, ``first.ply,second.ply``, of any format that trimesh reads; or
            a generator and a number of triangles, ``cloth:5000``.
        interval: Number of the interval between time samples of a USD file, from 0.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If a file is broken, the two meshes do not fit together, or a generator or an interval does not
            exist.
    """
    generated = re.fullmatch(r"(\w+):([^/\\]*)", name)
    if generated:
        return BenchmarkScene(name, *_find_generator(name, *generated.groups()))
    if "," in name:
        return _load_pair(name)
    scene = Scene(name, sample_turns=False)  # samples as they were recorded
    if not 0 <= interval < len(scene):
        raise ValueError(f"{name}: there is no interval {interval}, they go from 0 to {len(scene) - 1}")
    motion = scene.interval(interval)
    return BenchmarkScene(name, motion.segment.faces, motion.x0, motion.x1)


def paper_scenes() -> list[str]:
    """Paths of the scenes of the paper's benchmarks, which a checkout has.

    Raises:
        FileNotFoundError: If this is not a checkout, or a scene is missing.
    """
    assets = Path(__file__).parents[3] / "assets"
    paths = [assets / f"{name}.usd" for name in PAPER_SCENES]
    for path in paths:
        if not path.exists():
            raise FileNotFoundError(
                f"{path}: no such file: the paper's scenes come with a checkout of the project, where "
                f"examples/paper/example_{path.stem}.py makes this one; or name other scenes, such as cloth:20000"
            )
    return [str(path) for path in paths]


def load_intervals(name: str, *, most: int) -> list[tuple[int, BenchmarkScene]]:
    """Reads intervals of a scene, evenly spaced, with their numbers; a scene that is not a USD file has one.

    Args:
        name: The scene, as of :func:`load_scene`, with its errors.
        most: Largest number of intervals.
    """
    if "," in name or re.fullmatch(r"\w+:[^/\\]*", name):
        return [(0, load_scene(name))]
    scene = Scene(name, sample_turns=False)  # samples as they were recorded
    count = len(scene)
    if count < 1:
        raise ValueError(f"{name}: there is no interval, its meshes never move")
    # the middles of equal parts
    chosen = sorted({(2 * i + 1) * count // (2 * min(most, count)) for i in range(min(most, count))})
    intervals = []
    for index in chosen:
        motion = scene.interval(index)
        intervals.append((index, BenchmarkScene(name, motion.segment.faces, motion.x0, motion.x1)))
    return intervals


def find_overlapping(scene: BenchmarkScene, device: wp.Device) -> dict[PairKind, tuple[np.ndarray, np.ndarray]]:
    """Returns the vertices of the elements, and the pairs whose swept boxes overlap, by kind."""
    mesh = CollisionMesh(scene.faces, len(scene.x0), device=device)
    pipeline = DetectionPipeline(mesh)
    x0, x1 = (mesh.device_positions(x, name) for x, name in ((scene.x0, "x0"), (scene.x1, "x1")))
    retry_until_fits(lambda: pipeline.find_overlapping(x0, x1), pipeline, mesh.device)
    queued = pipeline.counts.vertex_face.queued, pipeline.counts.edge_edge.queued
    found = {}
    for narrow_phase, count, elements in zip(pipeline.narrow_phases, queued, (mesh.faces, mesh.edges), strict=True):
        pairs = narrow_phase.queue.numpy()[:count]
        # a GPU finds them in an order that varies
        found[narrow_phase.kind] = elements, pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    return found


def _find_generator(name: str, generator: str, triangles: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the mesh and the motion of a generated scene."""
    if generator not in GENERATORS:
        raise ValueError(f"{name}: there is no generator {generator}, only {', '.join(GENERATORS)}")
    if not re.fullmatch(r"[0-9]{1,9}", triangles) or not _MIN_TRIANGLES <= int(triangles) <= _MAX_TRIANGLES:
        bounds = f"[{_MIN_TRIANGLES}, {_MAX_TRIANGLES}]"
        raise ValueError(f"{name}: the number of triangles must be in {bounds}, not {triangles!r}")
    return GENERATORS[generator](int(triangles))


def _load_pair(name: str) -> BenchmarkScene:
    """Returns a step from the vertices of one mesh file to those of another."""
    paths = name.split(",")
    if len(paths) != 2:
        raise ValueError(f"{name}: expected two files joined by a comma, got {len(paths)}")
    first, second = (read_mesh(path) for path in paths)
    if len(first.vertices) != len(second.vertices):
        raise ValueError(f"{name}: the first has {len(first.vertices)} vertices, the second {len(second.vertices)}")
    if not np.array_equal(first.faces, second.faces):
        raise ValueError(f"{name}: the two have different faces")
    x0, x1 = np.array(first.vertices), np.array(second.vertices)
    # trimesh returns double precision for any file
    singles = [x.astype(np.float32) for x in (x0, x1)]
    if all(np.array_equal(x, single) for x, single in zip((x0, x1), singles, strict=True)):
        x0, x1 = singles
    return BenchmarkScene(name, np.array(first.faces, dtype=np.int32), x0, x1)


def generate_cloth(triangles: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns a wrinkled sheet, folded in half, that closes until the wrinkles of its two layers meet.

    Args:
        triangles: Approximate number of triangles.

    Returns:
        Faces, int32, shape [n, 3]; positions at the start and at the end [m], float32, shape [vertex_count, 3].
    """
    rows, columns = _grid_shape(triangles // 2)
    noise = _noise(3, rows + 1, columns + 1)
    i, j = np.mgrid[: rows + 1, : columns + 1] + 0.2 * noise[:2]
    along, across = i / rows, j / columns
    wrinkles = (
        np.sin(9.0 * np.pi * along + 2.0 * across)
        + np.sin(14.0 * np.pi * across + 3.0 * along)
        + np.sin(23.0 * along - 31.0 * across + 1.0)
    )
    wrinkles = 0.01 * wrinkles + 0.1 / rows * noise[2]

    def fold(radius):
        """Returns two straight layers, joined by half a circle."""
        straight = 0.5 * (1.0 - np.pi * radius)
        turn = np.clip((along - straight) / radius, 0.0, np.pi)
        layer = np.where(turn < 0.5 * np.pi, along - straight, 1.0 - straight - along)
        distance = radius + wrinkles
        x = np.minimum(layer, 0.0) + distance * np.sin(turn)
        return _stack(x, across, -distance * np.cos(turn))

    return _grid_faces(rows + 1, columns + 1), fold(0.028), fold(0.019)


def generate_crash(triangles: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns a square tube of thin sheet, crushed along its axis and pushed aside; every second fold just closes.

    A fold has 16 triangles, and no vertex moves further than a few of them, so that candidates and hits grow in
    proportion to the number of triangles.

    Args:
        triangles: Approximate number of triangles.

    Returns:
        Faces, int32, shape [n, 3]; positions at the start and at the end [m], float32, shape [vertex_count, 3].
    """
    rows, columns = _grid_shape(triangles // 2)
    i, j = np.mgrid[: rows + 1, :columns]
    angle = 2.0 * np.pi * j / columns
    cell = 7.2 / columns
    jitter = 0.1 * cell * _noise(3, rows + 1, columns)
    phase = 2.0 * np.pi * i / 16.0
    bumps = 0.05 * np.sin(5.0 * angle) + 0.03 * np.sin(13.0 * angle + 1.0)

    def crush(time):
        # a curve whose direction is a sine of its length meanders, and touches itself from an amplitude of 2.1 on;
        # as one fold closes the next opens, so that the ends of the tube stay where they are
        direction = (2.0 + bumps + 0.15 * time * np.sin(0.5 * phase)) * np.sin(phase)
        height = np.cumsum(cell * np.cos(direction), axis=0)
        offset = np.cumsum(cell * np.sin(direction), axis=0)
        x, y = np.cos(angle), np.sin(angle)
        radius = (1.0 + offset) / (x**6 + y**6) ** (1.0 / 6.0)
        push = 4.0 * cell * time
        return _stack(*np.add(jitter, [radius * x + push, radius * y, height - height.mean(axis=0)]))

    return _grid_faces(rows + 1, columns, closed=True), crush(0.0), crush(1.0)


GENERATORS: dict[str, Callable[[int], tuple[np.ndarray, np.ndarray, np.ndarray]]] = {
    "cloth": generate_cloth,
    "crash": generate_crash,
}
"""Generated scenes by name."""


def _grid_shape(quads: int) -> tuple[int, int]:
    """Returns rows and columns of a nearly square grid of about this number of quads."""
    side = int(quads**0.5)
    rows = np.arange(int(0.8 * side), side + 1)
    columns = np.round(quads / rows).astype(int)
    best = np.argmin(np.abs(rows * columns - quads))
    return int(rows[best]), int(columns[best])


def _grid_faces(rows: int, columns: int, *, closed: bool = False) -> np.ndarray:
    """Returns two triangles for each four vertices of a grid; in a closed grid the first column is next to the last."""
    vertex = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    if closed:
        vertex = np.column_stack([vertex, vertex[:, 0]])
    a, b, c, d = vertex[:-1, :-1], vertex[:-1, 1:], vertex[1:, 1:], vertex[1:, :-1]
    return np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)


def _noise(*shape: int) -> np.ndarray:
    """Returns random numbers in [-1, 1), the same each time, so that no two features are aligned exactly."""
    return np.random.default_rng(0).uniform(-1.0, 1.0, shape)


def _stack(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
