"""Certified motions of a surface: as far towards a goal as contacts allow, and apart to a minimum distance."""

from dataclasses import dataclass

import numpy as np

from ..detection.collisions import Collisions
from ..detection.mesh import CollisionMesh
from .surface import Surface, differ

__all__ = ["Contacts", "as_contacts", "move_freely", "near_pairs", "projected", "push_apart"]

_PROJECTIONS = 6
"""Detections after which contacts no longer slide, but stop."""
_DETECTIONS = 40
"""Detections after which nothing moves."""
_GAP = 2.0**-7
"""Gap that contacts leave, in edges."""
_MORE_DISTANCE = 1.0 + 2.0**-7
"""Distance at which contacts with a minimum distance are put, as a multiple of it."""
_KEPT_TIME = 0.8
"""Share of the time to a contact after which a vertex stops."""
_LEAST_TIME = 0.05
"""Shares of the way that are less count as 0, so that the search for a motion ends."""
_SWEEPS = 4
_LEAST_MOBILITY = 0.05
"""Sum of squared weights below which a contact counts as one that hardly moves."""
_PATIENCE = 4
"""Pushes without fewer near pairs after which the search ends."""
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

    def rows(self, which: np.ndarray) -> "Contacts":
        """Returns some of the contacts."""
        return Contacts(*(values[which] for values in vars(self).values()))

    @staticmethod
    def joined(contacts: list["Contacts"]) -> "Contacts":
        """Returns the contacts of a list."""
        return Contacts(*(np.concatenate(values) for values in zip(*(vars(c).values() for c in contacts), strict=True)))


def move_freely(surface: Surface, start: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns positions on the way to a goal that are reached without a collision, and which vertices contacts stopped.

    At first contacts are projected: they slide, and leave a gap. Later each vertex stops before its first contact.
    Pairs that keep the minimum distance at the start keep it.

    Args:
        surface: The surface.
        start: Positions, in units, shape [n, 3].
        goal: Likewise, as rounded to the type of the input.
    """
    stopped = np.zeros(len(start), dtype=bool)
    known: list[Contacts] = []
    near = near_pairs(surface, start)
    for detection in range(_DETECTIONS):
        contacts = _contacts(surface, start, goal, near)
        if not len(contacts.toi):
            return goal, stopped
        stopped[contacts.vertices] = True
        if detection < _PROJECTIONS:
            known.append(contacts)
            goal = projected(surface.fixed, goal, Contacts.joined(known))
        else:
            kept = np.ones(len(start))
            np.minimum.at(kept, contacts.vertices.ravel(), np.repeat(_KEPT_TIME * contacts.toi, 4))
            kept[kept < _LEAST_TIME] = 0.0
            goal = start + kept[:, None] * (goal - start)
        goal = surface.rounded(goal)
    return start, stopped


def push_apart(surface: Surface, x: np.ndarray) -> np.ndarray:
    """Returns positions with the fewest pairs nearer than the minimum distance that are reached without a collision."""
    best, fewest, since = x, None, 0
    while since < _PATIENCE:
        near = _near_contacts(surface, x)
        since += 1
        if fewest is None or len(near.keys) < fewest:
            best, fewest, since = x, len(near.keys), 0
        if not len(near.keys):
            break
        x, _ = move_freely(surface, x, surface.rounded(projected(surface.fixed, x, near)))
    return best


def near_pairs(surface: Surface, x: np.ndarray) -> np.ndarray:
    """Returns a number for each pair that is at most the minimum distance apart at positions in units, int64."""
    return _near_contacts(surface, x).keys if surface.min_distance else np.zeros(0, dtype=np.int64)


def _near_contacts(surface: Surface, x: np.ndarray) -> Contacts:
    """Returns the pairs that are at most the minimum distance apart at positions in units, as contacts."""
    positions = surface.positions(x)
    found = surface.distance_detector.detect(positions, positions)
    return as_contacts(surface.mesh, found, surface.min_distance * _MORE_DISTANCE)


def _contacts(surface: Surface, start: np.ndarray, goal: np.ndarray, near: np.ndarray) -> Contacts:
    """Returns the contacts of a motion between positions in units; pairs at rest stay as they are.

    Args:
        surface: The surface.
        start: Positions at the start.
        goal: Positions at the end.
        near: Keys of the pairs that do not keep the minimum distance at the start: they must only not touch.
    """
    x0, x1 = surface.positions(start), surface.positions(goal)
    contacts = as_contacts(surface.mesh, surface.detector.detect(x0, x1), _GAP * surface.edge)
    if surface.min_distance:
        found = surface.distance_detector.detect(x0, x1)
        too_near = as_contacts(surface.mesh, found, surface.min_distance * _MORE_DISTANCE)
        too_near = too_near.rows(~np.isin(too_near.keys, near))
        contacts = Contacts.joined([contacts.rows(~np.isin(contacts.keys, too_near.keys)), too_near])
    moves = differ(start, goal)
    return contacts.rows(np.asarray(moves[contacts.vertices].any(axis=1)))


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
    weights, normals = contacts.weights, contacts.normals
    involved, rows = np.unique(contacts.vertices, return_inverse=True)
    rows, at = rows.reshape(contacts.vertices.shape), x[involved]
    movable = np.where(fixed[contacts.vertices], 0.0, weights)
    inverse = 1.0 / np.maximum((movable**2).sum(axis=1), _LEAST_MOBILITY)
    for _ in range(sweeps):
        short = contacts.gap - np.einsum("ik,ikj,ij->i", weights, at[rows], normals)
        push = np.where(short > 0.0, short * inverse, 0.0)
        moves = (movable * push[:, None])[:, :, None] * normals[:, None, :]
        total = np.stack([np.bincount(rows.ravel(), moves[:, :, i].ravel(), len(at)) for i in range(3)], axis=1)
        count = np.bincount(rows.ravel(), np.repeat(push > 0.0, 4), len(at))
        at = at + total / np.maximum(count, 1.0)[:, None]
    result = x.copy()
    result[involved] = at
    return result
