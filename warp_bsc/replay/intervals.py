"""Replays a USD scene: finds the collisions between each two consecutive times, holding one interval at a time."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..detection.collisions import DetectionStats
from ..detection.detector import CollisionDetector
from ..detection.mesh import CollisionMesh
from ..usd.scene import Scene
from .scene_contacts import Contacts, find_contacts
from .validation import Validation, validate

__all__ = ["Contact", "Interval", "replay"]

TOI_BINS = 20
"""Parts of an interval that times of impact are counted in."""


@dataclass(frozen=True)
class Contact:
    """Where and when two meshes, or a mesh and itself, meet.

    Attributes:
        meshes: Names of the two.
        elements: What meets, in the prims' own numbers, such as ``"vertex 12"``, ``"face 3"`` or ``"edge 4-5"``.
        toi: Time of impact, 0 at the start of the interval and 1 at its end.
        time: The same as a time code.
    """

    meshes: tuple[str, str]
    elements: tuple[str, str]
    toi: float
    time: float


@dataclass(frozen=True)
class Interval:
    """What was found between two consecutive times of a scene, in numbers.

    Attributes:
        index: Number of the interval, from 0.
        start: Time code at which it starts.
        end: Time code at which it ends.
        vertex_face_hits: Number of vertex-face pairs that collide.
        edge_edge_hits: Number of edge-edge pairs that collide.
        toi_counts: Number of pairs by their time of impact, in equal parts of the interval.
        mesh_pairs: Number of pairs that collide for each two meshes, by their names, in order; a mesh that collides
            with itself is there twice.
        earliest: The earliest contact, None if there is none.
        certified: Whether no collision of vertices that move straight from the start to the end can be missing.
        stats: Counts and times of the detector's stages, pairs that do not count included.
        validation: What the exact checker says of the answers, None if it was not asked.
    """

    index: int
    start: float
    end: float
    vertex_face_hits: int
    edge_edge_hits: int
    toi_counts: tuple[int, ...]
    mesh_pairs: dict[tuple[str, str], int]
    earliest: Contact | None
    certified: bool
    stats: DetectionStats
    validation: Validation | None

    @property
    def hits(self) -> int:
        """Number of pairs that collide."""
        return self.vertex_face_hits + self.edge_edge_hits

    @property
    def pairs_tested(self) -> int:
        """Number of candidate pairs."""
        return self.stats.vertex_face.candidates + self.stats.edge_edge.candidates

    @property
    def milliseconds(self) -> float:
        """Time that the detector took [ms]."""
        return sum(self.stats.milliseconds.values())


def replay(
    scene: Scene, *, method: str = "exact", device=None, validate_most: int | None = 0
) -> Iterator[tuple[Interval, Contacts]]:
    """Find the collisions in every interval between two consecutive times of a scene, one interval at a time.

    Meshes that never move are obstacles: where these touch one another is not counted. Nor is where a mesh touches
    itself that only its transform moves.

    Args:
        scene: The scene, whose selection says which pairs count.
        method: ``"float"``, ``"conservative"`` or ``"exact"``.
        device: Warp device.
        validate_most: How many hits, and how many other answers, of each interval are asked again of the exact
            checker; None for all.

    Raises:
        ValueError: If the positions at some time are broken.
    """
    detector = segment = None
    for index, (start, end) in enumerate(zip(scene.times[:-1], scene.times[1:], strict=True)):
        last_segment = segment
        segment, x0, x1 = scene.interval(index)
        if segment is not last_segment:
            detector = None  # before the next is made, for the sake of memory
            detector = CollisionDetector(
                CollisionMesh(segment.faces, segment.vertex_count, device=device), method=method
            )
        collisions = detector.detect(x0, x1)
        contacts = find_contacts(segment, detector.mesh, collisions, x0, x1, start, end, scene.selection)
        validation = None
        if validate_most != 0:
            validation = validate(
                detector, collisions, x0, x1, most=validate_most, seed=index, counted=contacts.counted
            )
        yield _summarize(index, start, end, collisions, contacts, validation), contacts


def _summarize(index, start, end, collisions, contacts, validation) -> Interval:
    earliest = None
    if len(contacts):
        first = int(np.argmin(contacts.toi))
        row = slice(first, first + 1)
        earliest = Contact(
            contacts.mesh_names(row)[0],
            contacts.element_names(row)[0],
            float(contacts.toi[first]),
            float(contacts.time[first]),
        )
    pairs, counts = np.unique(np.sort(contacts.meshes, axis=1), axis=0, return_counts=True)
    names = [mesh.name for mesh in contacts.segment.meshes]
    edge_edge = int(contacts.kind.sum())
    return Interval(
        index=index,
        start=start,
        end=end,
        vertex_face_hits=len(contacts) - edge_edge,
        edge_edge_hits=edge_edge,
        toi_counts=tuple(np.histogram(contacts.toi, bins=TOI_BINS, range=(0.0, 1.0))[0].tolist()),
        mesh_pairs={(names[a], names[b]): count for (a, b), count in zip(pairs, counts.tolist(), strict=True)},
        earliest=earliest,
        certified=collisions.certified,
        stats=collisions.stats,
        validation=validation,
    )
