"""Replays a USD scene: finds the collisions between each two consecutive times, holding one interval at a time."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..detection.collisions import Collisions, DetectionStats
from ..detection.detector import CollisionDetector
from ..detection.mesh import CollisionMesh
from ..usd.scene import Scene
from .scene_contacts import SceneContacts, find_contacts
from .validation import Validation, validate

__all__ = ["TOI_BINS", "Contact", "IntervalResult", "IntervalSummary", "replay"]

TOI_BINS = 20
"""Number of equal parts of an interval in which times of impact are counted."""


@dataclass(frozen=True)
class Contact:
    """A collision of two meshes, or of a mesh with itself, in words.

    Attributes:
        meshes: Names of the two.
        elements: The two elements, in the prims' own numbers, such as ``"vertex 12"``, ``"face 3"`` or ``"edge 4-5"``.
        toi: Time of impact, 0 at the start of the interval and 1 at its end.
        time: The same as a time code.
    """

    meshes: tuple[str, str]
    elements: tuple[str, str]
    toi: float
    time: float


@dataclass(frozen=True)
class IntervalSummary:
    """The collisions between two consecutive times of a scene, in numbers.

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
        certified: Whether floating point or exact arithmetic has shown that no collision is missing, for vertices that
            move straight from the start to the end.
        stats: Counts and times of the detector's stages; the counts include pairs that the selection excludes.
        validation: The comparison with the exact checker, None if none was asked for.
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
        """Time of the detector's stages together [ms]."""
        return sum(self.stats.milliseconds.values())


@dataclass(frozen=True)
class IntervalResult:
    """The collisions between two consecutive times of a scene.

    Attributes:
        summary: The numbers, which are small and can be kept for all intervals.
        contacts: Every pair that collides, and the positions of all vertices.
    """

    summary: IntervalSummary
    contacts: SceneContacts


def replay(
    scene: Scene, *, method: str = "exact", device: Any = None, validate_most: int | None = 0
) -> Iterator[IntervalResult]:
    """Finds the collisions in every interval between two consecutive times of a scene, one interval at a time.

    Meshes that never move are obstacles: contacts between these are not counted, nor are contacts of a mesh with itself
    if only its transform moves it. Vertices are taken to move straight from the start of an interval to its end::

        import warp_bsc as bsc

        for interval in bsc.replay(bsc.Scene("scene.usd")):
            print(interval.summary.start, interval.summary.hits, interval.contacts.position)

    Args:
        scene: The scene; its selection says which pairs count.
        method: ``"float"``, ``"conservative"`` or ``"exact"``.
        device: Warp device or its name; default: Warp's default.
        validate_most: Number of hits, and of other pairs, of each interval that the exact checker decides again; None
            for all.

    Yields:
        IntervalResult: The collisions of one interval. Only what the caller keeps stays in memory.

    Raises:
        ValueError: If the positions at some time are broken, or there is no such method.
    """
    detector = segment = None
    for interval in scene:
        if detector is None or interval.segment is not segment:
            detector = None  # before the next is made, to free its memory
            segment = interval.segment
            mesh = CollisionMesh(segment.faces, segment.vertex_count, device=device)
            detector = CollisionDetector(mesh, method=method)
        collisions = detector.detect(interval.x0, interval.x1)
        assert isinstance(collisions, Collisions)  # nothing is captured here
        contacts = find_contacts(interval, detector.mesh, collisions, scene.selection)
        validation = None
        if validate_most != 0:
            validation = validate(
                detector,
                collisions,
                interval.x0,
                interval.x1,
                most=validate_most,
                seed=interval.index,
                counted=contacts.counted,
            )
        yield IntervalResult(_summarize(contacts, collisions, validation), contacts)


def _summarize(contacts, collisions, validation) -> IntervalSummary:
    interval, earliest = contacts.interval, None
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
    names = [mesh.name for mesh in interval.segment.meshes]
    edge_edge = int(contacts.kind.sum())
    return IntervalSummary(
        index=interval.index,
        start=interval.start,
        end=interval.end,
        vertex_face_hits=len(contacts) - edge_edge,
        edge_edge_hits=edge_edge,
        toi_counts=tuple(np.histogram(contacts.toi, bins=TOI_BINS, range=(0.0, 1.0))[0].tolist()),
        mesh_pairs={(names[a], names[b]): count for (a, b), count in zip(pairs, counts.tolist(), strict=True)},
        earliest=earliest,
        certified=collisions.certified,
        stats=collisions.stats,
        validation=validation,
    )
