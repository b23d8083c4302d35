"""Checks a mesh: what crosses, touches or lies inside, and faces and edges that are not sound."""

from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..detection.at_rest.body_parts import connect_cells
from ..detection.at_rest.containment import ContainmentFinder
from ..detection.at_rest.intersections import IntersectionFinder, Intersections
from ..detection.mesh import CollisionMesh
from ..repairing.arguments import checked_mesh
from ..repairing.surface import weld_borders, welded

if TYPE_CHECKING:
    from trimesh import Trimesh


@dataclass(frozen=True, eq=False)
class MeshCheck:
    """What :func:`warp_bsc.check` finds, exactly: sorted arrays of int, with a row for each finding.

    Doubled vertices of borders count as one, as in :func:`warp_bsc.repair`, except for ``doubled_vertices``.

    Attributes:
        edges: Vertices of both ends of the edges that the others name, shape [edge_count, 2].
        component: Number of the connected component of each face, shape [face_count].
        crossings: (edge, face) where an edge passes through a face.
        touching: (edge, face) where an edge meets a face, and only touches it.
        inside: (inner, outer) component, where the outer one is closed and the inner one wholly inside it.
        degenerate_faces: Faces of no area: with a vertex twice, or with their corners on one line.
        doubled_faces: (face, first face) with the corners in the same three places.
        doubled_vertices: (vertex, first vertex) in the same place, of those that faces use.
        nonmanifold_edges: Edges of more than two faces.
        misoriented_edges: Edges that both of their faces pass in the same direction.
        borders: Edges of one face.
    """

    edges: np.ndarray
    component: np.ndarray
    crossings: np.ndarray
    touching: np.ndarray
    inside: np.ndarray
    degenerate_faces: np.ndarray
    doubled_faces: np.ndarray
    doubled_vertices: np.ndarray
    nonmanifold_edges: np.ndarray
    misoriented_edges: np.ndarray
    borders: np.ndarray


def check(
    mesh: "CollisionMesh | np.ndarray | wp.array | Trimesh",
    x: np.ndarray | wp.array | None = None,
    *,
    device: wp.DeviceLike = None,
) -> MeshCheck:
    """Returns what crosses, touches and lies inside in one configuration, and which faces and edges are not sound.

    Args:
        mesh: The mesh, or its faces, as of :func:`warp_bsc.repair`; or a ``trimesh.Trimesh``. Pairs that its worlds,
            groups and masks leave out do not cross.
        x: Positions, any unit of length, shape [vertex_count, 3], float32 or float64, NumPy or Warp array; none with a
            ``trimesh.Trimesh``, which has its own.
        device: Warp device for given faces; default: Warp's default. A mesh has its own.

    Raises:
        TypeError: If an argument has another type.
        ValueError: If an array has another shape or type, is not finite or out of range, or a device is given with a
            mesh.
    """
    mesh, positions = checked_mesh(mesh, x, device)
    surface, found = find_meeting(mesh, positions)
    roots = connect_cells(surface.faces.astype(np.int64), len(positions))
    component = np.unique(roots[surface.faces[:, 0]], return_inverse=True)[1].reshape(-1)
    inside = ContainmentFinder(surface, component).find(positions, found, lambda pairs: np.ones(len(pairs), bool))
    place = np.arange(len(positions))
    _, first, number = np.unique(positions[mesh.vertices], axis=0, return_index=True, return_inverse=True)
    place[mesh.vertices] = mesh.vertices[first[number.reshape(-1)]]
    _, first, number = np.unique(np.sort(place[mesh.faces], axis=1), axis=0, return_index=True, return_inverse=True)
    sides = surface.face_edges.ravel()
    counts = np.bincount(sides + 1, minlength=len(surface.edges) + 1)[1:]
    forward = surface.faces.ravel() == surface.edges[sides, 0]
    turns = np.bincount(sides + 1, np.where(forward, 1, -1), len(surface.edges) + 1)[1:]
    return MeshCheck(
        edges=surface.edges,
        component=component,
        crossings=found.pairs[found.crosses],
        touching=found.pairs[~found.crosses],
        inside=inside.bodies,
        degenerate_faces=np.flatnonzero(_are_degenerate(positions[mesh.faces].astype(np.float64))),
        doubled_faces=_doubled(first[number.reshape(-1)]),
        doubled_vertices=_doubled(place),
        nonmanifold_edges=np.flatnonzero(counts > 2),
        misoriented_edges=np.flatnonzero((counts == 2) & (turns != 0)),
        borders=np.flatnonzero(counts == 1),
    )


def find_meeting(mesh: CollisionMesh, x: np.ndarray) -> tuple[CollisionMesh, Intersections]:
    """Returns a mesh without doubled vertices of borders, and the edges that meet faces in it.

    Args:
        mesh: The mesh.
        x: Positions, finite, shape [vertex_count, 3].
    """
    surface = welded(mesh, weld_borders(mesh, x))
    return surface, IntersectionFinder(surface).find(x)


def _doubled(first: np.ndarray) -> np.ndarray:
    """Returns the elements that are not the first of their kind, and the first, shape [n, 2]."""
    (rows,) = np.nonzero(first != np.arange(len(first)))
    return np.stack([rows, first[rows]], axis=1)


def _are_degenerate(corners: np.ndarray) -> np.ndarray:
    """Returns which faces have no area, exactly, given their corners, shape [n, 3, 3]."""
    with np.errstate(all="ignore"):
        one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        left, right = one[:, [1, 2, 0]] * other[:, [2, 0, 1]], one[:, [2, 0, 1]] * other[:, [1, 2, 0]]
        bound = 2.0**-50 * (np.abs(left) + np.abs(right)) + 2.0**-1000  # of rounding and underflow
        unsure = np.array(~(np.abs(left - right) > bound).any(axis=1))
    for row in np.flatnonzero(unsure):
        a, b, c = ([Fraction(value) for value in corner] for corner in corners[row].tolist())
        u, v = [[p - q for p, q in zip(end, a, strict=True)] for end in (b, c)]
        unsure[row] = all(u[i] * v[i - 1] == u[i - 1] * v[i] for i in range(3))
    return unsure
