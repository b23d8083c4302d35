"""Finds the particles that are inside rigid shapes, soft bodies and the solids of planes, in one configuration."""

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import warp as wp
from newton import ParticleFlags

from ..._arguments import as_numpy
from ...detection.at_rest.body_parts import connect_cells
from ...detection.at_rest.containment import ContainmentFinder
from ...detection.mesh import CollisionMesh
from ..state.mesh import ModelMesh, dynamic_bodies, elements_of, outer_sides

_ROUNDOFF, _TINY = 2.0**-50, 1e-300  # as in :func:`.state.planes.signed_distance`


@dataclass(frozen=True, eq=False)
class Inside:
    """The particles that are inside solids: sorted rows of a particle and the solid that holds it.

    Attributes:
        particles: The particles, int32, shape [n]. One that is inside several solids has a row for each.
        shapes: The shapes, -1 for a soft body, int32, shape [n].
        soft_bodies: The soft bodies, each as the first of its particles, -1 for a shape, int32, shape [n].
    """

    particles: np.ndarray
    shapes: np.ndarray
    soft_bodies: np.ndarray

    def __len__(self) -> int:
        """Returns the number of rows."""
        return len(self.particles)


class _Solids(NamedTuple):
    """The bodies that enclose space: soft bodies, then shapes, those that are in all worlds once for each world."""

    finder: ContainmentFinder  # of the points inside them
    faces: np.ndarray  # vertices of their faces, shape [face_count, 3]
    of_face: np.ndarray  # body of each face
    shape: np.ndarray  # of each body, -1 for a soft body
    soft_body: np.ndarray  # first particle of each body, -1 for a shape
    body: np.ndarray  # rigid body of each shape, -1 for none
    soft_body_of: np.ndarray  # first particle of the soft body of each particle, -1 for none


class InsideFinder:
    """Finds the particles of a model that are inside solids, in one configuration after another, on the host.

    Solids are the shapes that collide with particles, as tessellated in the mesh of the model, the soft bodies, and the
    solids of infinite planes. Tetrahedra with common particles make a soft body. Cloth, closed or not, and shapes whose
    triangles do not close (a finite plane, an open mesh) enclose nothing. Each particle is tested by itself, and is
    inside if it is strictly inside: of a sheet, the part that is.

    The finder excludes a particle in the soft body that it belongs to or in a solid of another world, pairs that the
    response cannot move (a pinned particle in a static shape), particles and solids that a filter of the mesh leaves
    out, wholly or in part, particles that are not active, and positions that are not finite. A soft body or shape with
    a position that is not finite holds nothing.

    Floating-point errors cannot change the result for soft bodies and shapes. A particle is inside the solid of a plane
    if its distance is certainly negative, as in a step.
    """

    def __init__(self, mesh: ModelMesh):
        """Takes the mesh of a model; the first search finds its solids."""
        self._mesh, self._world = mesh, mesh.device_world.numpy()

    def find(self, x: np.ndarray | wp.array, planes: np.ndarray | wp.array) -> Inside:
        """Returns which particles are inside solids. Synchronizes with the device of the arrays.

        Args:
            x: Positions of all vertices of the mesh [m], float32, shape [vertex_count, 3], or an array of vec3.
            planes: The planes of the mesh, each as the unit normal out of its solid and its offset [m], float64, shape
                [plane_count, 4], or an array of vec4d, as in :class:`.state.planes.MovingPlanes`.

        Raises:
            ValueError: If an array has another shape.
        """
        mesh, model = self._mesh, self._mesh.model
        x = _checked(x, (mesh.vertex_count, 3), "x")
        planes = _checked(planes, (len(mesh.planes.shape), 4), "planes")
        flags = np.zeros(0, dtype=int) if model.particle_flags is None else model.particle_flags.numpy()
        finite = np.isfinite(x).all(axis=1).reshape(-1)
        (particles,) = np.nonzero(finite[: model.particle_count] & ((flags & int(ParticleFlags.ACTIVE)) != 0))
        movable = mesh.inverse_masses.numpy() > 0.0
        moves = np.append(dynamic_bodies(model), False)  # -1 is no body
        in_bodies = self._find_in_bodies(x, particles, finite, movable, moves)
        behind_planes = self._find_behind_planes(x[particles].astype(np.float64), particles, planes, movable, moves)
        rows = np.concatenate([in_bodies, behind_planes])
        rows = rows[np.lexsort(rows.T[::-1])].astype(np.int32)
        return Inside(*np.ascontiguousarray(rows.T))

    def count_by_world(self, x: np.ndarray | wp.array, planes: np.ndarray | wp.array) -> np.ndarray:
        """Returns how many particles of each world are inside solids, int32, with arguments as of :meth:`find`."""
        world = self._world[np.unique(self.find(x, planes).particles)]
        return np.bincount(world, minlength=max(1, self._mesh.model.world_count)).astype(np.int32)

    def _find_in_bodies(self, x, particles, finite, movable, moves):
        """Returns rows of a particle, a shape and a soft body."""
        solids, world = self._solids, self._world
        bad_faces = solids.of_face[~finite[solids.faces].all(axis=1)]
        holds = np.bincount(bad_faces, minlength=len(solids.shape)) == 0
        soft = solids.soft_body_of
        has_movable = np.bincount(soft[(soft >= 0) & movable[: len(soft)]], minlength=len(soft)) > 0
        is_movable = np.where(solids.shape < 0, np.append(has_movable, False)[solids.soft_body], moves[solids.body])

        kind_of_vertex, meets = self._meeting_solids

        def are_candidates(pairs):
            particle, body = particles[pairs[:, 0]], pairs[:, 1]
            found = holds[body] & ((soft[particle] < 0) | (soft[particle] != solids.soft_body[body]))
            found &= movable[particle] | is_movable[body]
            return found & meets[kind_of_vertex[particle], body]

        x = np.where(finite[:, None], x, 0.0)
        found = solids.finder.find_points(x, x[particles], world[particles], are_candidates)
        return np.stack([particles[found[:, 0]], solids.shape[found[:, 1]], solids.soft_body[found[:, 1]]], axis=1)

    def _find_behind_planes(self, x, particles, planes, movable, moves):
        """Returns rows of a particle, a shape and no soft body, given the positions of the particles in float64."""
        rows = [np.zeros((0, 3), dtype=np.int64)]
        of_planes, world = self._mesh.planes, self._world[particles]
        for i, (*normal, offset) in enumerate(planes):
            terms = np.column_stack([np.full(len(x), -offset), x * normal])
            deep = terms.sum(axis=1) < -(_ROUNDOFF * np.abs(terms).sum(axis=1) + _TINY)
            deep &= (of_planes.world[i] < 0) | (of_planes.world[i] == world)
            of_plane = self._bits_of_shapes[:, of_planes.shape[i], None]
            deep &= _meet(self._bits_of_vertices[:, particles], of_plane)
            inside = particles[deep & (movable[particles] | moves[of_planes.body[i]])]
            rows.append(np.column_stack([inside, np.full_like(inside, of_planes.shape[i]), np.full_like(inside, -1)]))
        return np.concatenate(rows)

    @functools.cached_property
    def _bits_of_vertices(self) -> np.ndarray:
        """Groups and masks of the vertices, shape [2, vertex_count]; 1 without a filter."""
        mesh = self._mesh
        if mesh.group is None or mesh.mask is None:
            return np.ones((2, mesh.vertex_count), dtype=int)
        return np.stack([mesh.group, mesh.mask])

    @functools.cached_property
    def _bits_of_shapes(self) -> np.ndarray:
        """Groups and masks of the shapes, shape [2, shape_count]; 1 without a filter."""
        bits = self._mesh.shape_filter
        if self._mesh.group is None:
            return np.ones((2, self._mesh.model.shape_count), dtype=int)
        return np.stack([bits.group.numpy(), bits.mask.numpy()]).view(np.uint32)

    @functools.cached_property
    def _meeting_solids(self) -> tuple[np.ndarray, np.ndarray]:
        """The kind of each vertex, of those alike, shape [vertex_count], and which kinds meet all of which solids."""
        solids = self._solids
        kinds, kind_of_vertex = np.unique(self._bits_of_vertices, axis=1, return_inverse=True)
        has = np.zeros((len(kinds.T), len(solids.shape)), dtype=bool)  # kinds of vertices that solids have
        has[kind_of_vertex.ravel()[solids.faces], solids.of_face[:, None]] = True
        return kind_of_vertex.ravel(), ~(~_meet(kinds[:, :, None], kinds[:, None, :]) @ has)

    @functools.cached_property
    def _solids(self) -> _Solids:
        mesh, count, world = self._mesh, self._mesh.model.particle_count, self._world
        tetrahedra = elements_of(mesh.model.tet_indices, 4)
        first = connect_cells(tetrahedra, count)
        soft_body_of = np.full(count, -1)
        soft_body_of[tetrahedra] = first[tetrahedra]
        soft_faces = outer_sides(tetrahedra, np.empty((0, 3), dtype=np.int32))
        soft_bodies, of_soft_face = np.unique(soft_body_of[soft_faces[:, 0]], return_inverse=True)
        shape_faces = mesh.faces[mesh.faces[:, 0] >= count]
        corners = shape_faces[:, 0]
        keys = np.column_stack([mesh.shape_vertices.shape[corners - count], world[corners]])
        copies, places, of_shape_face = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        faces = np.concatenate([soft_faces, shape_faces])
        of_face = np.concatenate([of_soft_face, len(soft_bodies) + of_shape_face.ravel()])
        none, no_shape = np.full(len(soft_bodies), -1), np.full(len(copies), -1)
        world = np.concatenate([world[soft_bodies], copies[:, 1]])
        return _Solids(
            ContainmentFinder(CollisionMesh(faces, mesh.vertex_count, device="cpu"), of_face, world),
            faces,
            of_face,
            shape=np.concatenate([none, copies[:, 0]]),
            soft_body=np.concatenate([soft_bodies, no_shape]),
            body=np.concatenate([none, mesh.shape_vertices.body[corners[places] - count]]),
            soft_body_of=soft_body_of,
        )


def _meet(bits: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Returns which groups and masks meet, each of shape [2, ...]."""
    return ((bits[0] & other[1]) != 0) & ((other[0] & bits[1]) != 0)


def _checked(values: np.ndarray | wp.array, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Returns an argument on the host; raises ValueError if it has another shape."""
    values = as_numpy(values, name)
    if values.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, not {values.shape}")
    return values
