"""Contacts of a motion, as planes that keep their elements apart."""

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from ..detection.mesh import CollisionMesh
from ..detection.results.collisions import Collisions
from ..detection.run.launch import launch_repeatedly
from .kernels import Planes, find_shortfalls, move_apart

_SWEEPS = 4
_LEAST_MOBILITY = 0.05
"""Sum of squared weights below which a contact counts as one that hardly moves."""


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts of a motion, vertex-face and edge-edge ones alike.

    Attributes:
        keys: A number for each pair of elements, int64, shape [n].
        vertices: Vertices of both elements, int, shape [n, 4].
        weights: Coordinates of the contact in the elements, those of the second one negative, shape [n, 4].
        normals: Normals, from the second element to the first, shape [n, 3].
        toi: Times of impact, shape [n].
        gap: Distance that the elements are to have along the normal, in units, shape [n].
    """

    keys: np.ndarray
    vertices: np.ndarray
    weights: np.ndarray
    normals: np.ndarray
    toi: np.ndarray
    gap: np.ndarray

    @property
    def are_of_edges(self) -> np.ndarray:
        """Whether both elements are edges, bool, shape [n]."""
        return self.keys < 0

    def rows(self, which: np.ndarray) -> "Contacts":
        """Returns some of the contacts."""
        return Contacts(*(values[which] for values in vars(self).values()))

    def latest(self) -> "Contacts":
        """Returns the last contact of each pair."""
        _, last = np.unique(self.keys[::-1], return_index=True)
        return self.rows(len(self.keys) - 1 - last)

    @staticmethod
    def none() -> "Contacts":
        """Returns no contacts."""
        keys, vertices = np.zeros(0, np.int64), np.zeros((0, 4), np.int64)
        return Contacts(keys, vertices, np.zeros((0, 4)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))

    @staticmethod
    def joined(contacts: list["Contacts"]) -> "Contacts":
        """Returns the contacts of a list."""
        return Contacts(*(np.concatenate(values) for values in zip(*(vars(c).values() for c in contacts), strict=True)))


def keys_of(found: Collisions) -> np.ndarray:
    """Returns a number for each pair of elements that collide, vertex-face ones first, int64, shape [n]."""
    vertex_face, edge_edge = (pairs.astype(np.int64) @ [2**31, 1] for pairs in (found.vertex_face, found.edge_edge))
    return np.concatenate([vertex_face, -1 - edge_edge])


def as_contacts(mesh: CollisionMesh, found: Collisions, gap: float = 0.0) -> Contacts:
    """Returns collisions of a mesh with faces and edges in one form; ``gap`` is the distance that they are to have."""
    beta = found.vertex_face_coordinates
    s, r = found.edge_edge_coordinates[:, 0, None], found.edge_edge_coordinates[:, 1, None]
    vertex_face, edge_edge = found.vertex_face.astype(np.int64), found.edge_edge.astype(np.int64)
    toi = np.concatenate([found.vertex_face_toi, found.edge_edge_toi])
    return Contacts(
        keys_of(found),
        np.concatenate(
            [np.column_stack([vertex_face[:, 0], mesh.faces[vertex_face[:, 1]]]), mesh.edges[edge_edge].reshape(-1, 4)]
        ),
        np.concatenate([np.hstack([np.ones((len(beta), 1)), -beta]), np.hstack([1.0 - s, s, r - 1.0, -r])]),
        np.concatenate([found.vertex_face_normal, found.edge_edge_normal]),
        toi,
        np.full(len(toi), gap),
    )


def as_planes(contacts: Contacts, rows: np.ndarray, fixed: np.ndarray, device: wp.DeviceLike) -> Planes:
    """Returns contacts as planes on a device.

    ``rows`` are those of the vertices among those that move, ascending, -1 for the others, int, and ``fixed`` ones
    stay, bool, both of shape [n].
    """
    of_places = rows[contacts.vertices.ravel()]
    order = np.argsort(of_places, kind="stable")
    order = order[np.count_nonzero(of_places < 0) :]
    starts = np.searchsorted(of_places[order], np.arange(rows.max(initial=-1) + 2))
    planes = Planes()
    planes.starts, planes.places = (wp.array(values, dtype=int, device=device) for values in (starts, order))
    planes.vertices = wp.array(contacts.vertices, dtype=wp.vec4i, device=device)
    planes.weights = wp.array(contacts.weights, dtype=wp.vec4d, device=device)
    planes.normals = wp.array(contacts.normals, dtype=wp.vec3d, device=device)
    planes.gaps = wp.array(contacts.gap, dtype=wp.float64, device=device)
    movable = np.where(fixed[contacts.vertices], 0.0, contacts.weights)
    mobilities = 1.0 / np.maximum((movable**2).sum(axis=1), _LEAST_MOBILITY)
    planes.mobilities = wp.array(mobilities, dtype=wp.float64, device=device)
    return planes


def projected(
    fixed: np.ndarray, x: np.ndarray, contacts: Contacts, sweeps: int = _SWEEPS, *, device: wp.DeviceLike
) -> np.ndarray:
    """Returns positions at which contacts have their gaps along their normals: Jacobi sweeps, averaged by vertex.

    Vertices that are ``fixed`` stay, bool, shape [n]; positions are float64, shape [n, 3].
    """
    count = len(contacts.toi)
    is_involved = np.zeros(len(x), dtype=bool)
    is_involved[contacts.vertices] = True
    involved = np.flatnonzero(is_involved)
    own = replace(contacts, vertices=(np.cumsum(is_involved) - 1)[contacts.vertices])
    (moving,) = np.nonzero(~fixed[involved])
    rows = np.full(len(involved), -1)
    rows[moving] = np.arange(len(moving))
    planes = as_planes(own, rows, fixed[involved], device)
    at = wp.array(x[involved], dtype=wp.vec3d, device=device)
    shortfalls = wp.empty(count, dtype=wp.float64, device=device)
    vertices = wp.array(moving, dtype=int, device=device)
    first = find_shortfalls, count, [at, planes], [shortfalls]
    second = move_apart, len(moving), [vertices, planes, shortfalls], [at]
    launch_repeatedly([first, second], sweeps, device=device)
    result = x.copy()
    result[involved] = at.numpy()
    return result
