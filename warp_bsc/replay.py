"""Replays a USD scene: finds the collisions between each two consecutive times."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from .detector import CollisionDetector, DetectionStats
from .mesh import CollisionMesh
from .scene import Scene

__all__ = ["Contact", "Interval", "replay"]


@dataclass(frozen=True)
class Contact:
    """Where and when two meshes, or a mesh and itself, meet.

    Attributes:
        meshes: Paths of the two prims.
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
    """What was found between two consecutive times of a scene.

    Attributes:
        index: Number of the interval, from 0.
        start: Time code at which it starts.
        end: Time code at which it ends.
        vertex_face_hits: Number of vertex-face pairs that collide.
        edge_edge_hits: Number of edge-edge pairs that collide.
        mesh_pairs: Number of pairs that collide for each two meshes, by the paths of their prims, in order; a mesh that
            collides with itself is there twice.
        earliest: The earliest contact, None if there is none.
        certified: Whether no collision can be missing.
        stats: Counts and times of the detector's stages.
    """

    index: int
    start: float
    end: float
    vertex_face_hits: int
    edge_edge_hits: int
    mesh_pairs: dict[tuple[str, str], int]
    earliest: Contact | None
    certified: bool
    stats: DetectionStats

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


def replay(scene: Scene, *, method: str = "exact", device=None) -> Iterator[Interval]:
    """Find the collisions in every interval between two consecutive times of a scene, one interval at a time.

    Meshes that never move are obstacles: where these touch one another is not counted.

    Args:
        scene: The scene.
        method: ``"float"``, ``"conservative"`` or ``"exact"``.
        device: Warp device.

    Raises:
        ValueError: If the positions at some time are broken.
    """
    mesh = CollisionMesh(scene.faces, scene.vertex_count, device=device)
    detector = CollisionDetector(mesh, method=method)

    moves = np.array([scene_mesh.moves for scene_mesh in scene.meshes])
    vertex_mesh = scene.meshes_of_vertices(np.arange(scene.vertex_count))
    face_mesh = scene.meshes_of_faces(np.arange(len(scene.faces)))
    edge_mesh = vertex_mesh[mesh.edges].max(axis=1)  # a welded end may be of an earlier mesh
    edge_moves = moves[vertex_mesh[mesh.edges]].any(axis=1)

    positions = scene.positions(scene.times[0])
    for index, (start, end) in enumerate(pairwise(scene.times)):
        positions, start_positions = scene.positions(end), positions
        collisions = detector.detect(start_positions, positions)
        vertices, faces = collisions.vertex_face.T
        edges = collisions.edge_edge
        vertex_face_meshes = np.stack([vertex_mesh[vertices], face_mesh[faces]], axis=1)
        meshes = np.concatenate([vertex_face_meshes, edge_mesh[edges]])
        counted = np.concatenate([moves[vertex_face_meshes].any(axis=1), edge_moves[edges].any(axis=1)])
        toi = np.where(counted, np.concatenate([collisions.vertex_face_toi, collisions.edge_edge_toi]), np.inf)

        earliest = None
        if counted.any():
            first = int(np.argmin(toi))
            if first < len(vertices):
                contact = _name_vertex(scene, vertices[first]), _name_face(scene, faces[first])
            else:
                contact = [_name_edge(scene, mesh.edges[edge]) for edge in edges[first - len(vertices)]]
            names, elements = zip(*contact, strict=True)
            earliest = Contact(names, elements, float(toi[first]), start + float(toi[first]) * (end - start))

        pairs, counts = np.unique(np.sort(meshes[counted], axis=1), axis=0, return_counts=True)
        paths = [(scene.meshes[a].path, scene.meshes[b].path) for a, b in pairs]
        yield Interval(
            index=index,
            start=start,
            end=end,
            vertex_face_hits=int(counted[: len(vertices)].sum()),
            edge_edge_hits=int(counted[len(vertices) :].sum()),
            mesh_pairs=dict(zip(paths, counts.tolist(), strict=True)),
            earliest=earliest,
            certified=collisions.certified,
            stats=collisions.stats,
        )


def _name_vertex(scene, vertex) -> tuple[str, str]:
    path, point = scene.locate_vertex(vertex)
    return path, f"vertex {point}"


def _name_face(scene, face) -> tuple[str, str]:
    path, polygon = scene.locate_face(face)
    return path, f"face {polygon}"


def _name_edge(scene, ends) -> tuple[str, str]:
    (_, first), (path, second) = sorted(scene.locate_vertex(end) for end in ends)
    return path, f"edge {first}-{second}"
