"""Contacts of a motion, as planes that keep their elements apart."""

from dataclasses import dataclass

import numpy as np

from ..detection.collisions import Collisions
from ..detection.mesh import CollisionMesh

__all__ = ["Contacts", "as_contacts", "projected"]

_SWEEPS = 4
_LEAST_MOBILITY = 0.05
"""Sum of squared weights below which a contact counts as one that hardly moves."""
_KEY = np.array([2**31, 1])
"""Makes one number of the numbers of two elements."""


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

    def mobilities(self, fixed: np.ndarray) -> np.ndarray:
        """Returns the move of each contact by a push, as its reciprocal, where ``fixed`` vertices stay, shape [n]."""
        movable = np.where(fixed[self.vertices], 0.0, self.weights)
        return 1.0 / np.maximum((movable**2).sum(axis=1), _LEAST_MOBILITY)

    @staticmethod
    def none() -> "Contacts":
        """Returns no contacts."""
        keys, vertices = np.zeros(0, np.int64), np.zeros((0, 4), np.int64)
        return Contacts(keys, vertices, np.zeros((0, 4)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))

    @staticmethod
    def joined(contacts: list["Contacts"]) -> "Contacts":
        """Returns the contacts of a list."""
        return Contacts(*(np.concatenate(values) for values in zip(*(vars(c).values() for c in contacts), strict=True)))


def as_contacts(mesh: CollisionMesh, found: Collisions, gap: float) -> Contacts:
    """Returns collisions of a mesh with faces and edges in one form; ``gap`` is the distance that they are to have."""
    beta = found.vertex_face_coordinates
    s, r = found.edge_edge_coordinates[:, 0, None], found.edge_edge_coordinates[:, 1, None]
    vertex_face, edge_edge = found.vertex_face.astype(np.int64), found.edge_edge.astype(np.int64)
    toi = np.concatenate([found.vertex_face_toi, found.edge_edge_toi])
    return Contacts(
        np.concatenate([vertex_face @ _KEY, -1 - edge_edge @ _KEY]),
        np.concatenate(
            [np.column_stack([vertex_face[:, 0], mesh.faces[vertex_face[:, 1]]]), mesh.edges[edge_edge].reshape(-1, 4)]
        ),
        np.concatenate([np.hstack([np.ones((len(beta), 1)), -beta]), np.hstack([1.0 - s, s, r - 1.0, -r])]),
        np.concatenate([found.vertex_face_normal, found.edge_edge_normal]),
        toi,
        np.full(len(toi), gap),
    )


def projected(fixed: np.ndarray, x: np.ndarray, contacts: Contacts, sweeps: int = _SWEEPS) -> np.ndarray:
    """Returns positions at which contacts have their gaps along their normals: Jacobi sweeps, averaged by vertex.

    Args:
        fixed: Vertices that stay, bool, shape [n].
        x: Positions, float64, shape [n, 3].
        contacts: The contacts.
        sweeps: Number of sweeps.
    """
    involved, rows = np.unique(contacts.vertices, return_inverse=True)
    rows, at = rows.reshape(contacts.vertices.shape), x[involved]
    # one row of twelve numbers a contact, for its four vertices
    gradients = (contacts.weights[:, :, None] * contacts.normals[:, None, :]).reshape(-1, 12)
    movable = np.where(fixed[contacts.vertices], 0.0, contacts.weights) * contacts.mobilities(fixed)[:, None]
    moves = (movable[:, :, None] * contacts.normals[:, None, :]).reshape(-1, 12)
    for _ in range(sweeps):
        short = contacts.gap - np.einsum("ij,ij->i", gradients, at[rows].reshape(-1, 12))
        (active,) = np.nonzero(short > 0.0)
        if not len(active):
            break
        pushed = rows[active].ravel()
        pushes = (moves[active] * short[active, None]).reshape(-1, 3)
        total = np.stack([np.bincount(pushed, pushes[:, i], len(at)) for i in range(3)], axis=1)
        at = at + total / np.maximum(np.bincount(pushed, minlength=len(at)), 1)[:, None]
    result = x.copy()
    result[involved] = at
    return result
