"""The collision mesh of a Newton model: cloth, the surfaces of soft bodies, and rigid shapes cut into triangles."""

from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import warp as wp
from newton import BodyFlags, GeoType, Model, ParticleFlags, ShapeFlags

from ..._arguments import checked_integer
from ...detection.mesh import CollisionMesh, ElementsOfParts
from ...detection.narrow.rules.approach import MinDistances, make_min_distances
from ...kernels.pairs import PairFilter
from ..tuning import SEGMENTS
from .collision_filter import CollisionFilter, bits_of_model
from .kept_distances import DistanceArrays, KeptDistances
from .shapes import PlacedShapes, place_shapes, shapes_of, take_shapes
from .structs import Connectivity, Incidence
from .tessellation import tessellate, tessellation_key

MAX_SEGMENTS = 1024
"""Most triangles around a round shape; a sphere has about the square of them."""
_STRAIGHT = 0.9
"""Length of a spring, as a share of that of two others between its ends, from which it runs along them."""

_Array = TypeVar("_Array", np.ndarray, wp.array)


class ShapeVertices(NamedTuple, Generic[_Array]):
    """The vertices of the tessellated rigid shapes, as NumPy or as Warp arrays of length n."""

    position: _Array  # [m] in the frame of the body, or of the world where there is none, float32, shape [n, 3]
    body: _Array  # that the vertex moves with, -1 for none, int32
    shape: _Array  # that the vertex belongs to, as in ``model.shape_material_mu``, int32


class Planes(NamedTuple, Generic[_Array]):
    """The infinite planes, each the boundary of a solid half-space, as NumPy or as Warp arrays of length n."""

    point: _Array  # of the plane [m] in the frame of the body, or of the world, float32, shape [n, 3]
    normal: _Array  # of unit length, out of the solid, in the same frame, float32, shape [n, 3]
    body: _Array  # that the plane moves with, -1 for none, int32
    shape: _Array  # int32
    world: _Array  # -1 for all worlds, int32


@wp.struct
class Placement:
    """Where the vertices and the planes of a mesh are in a state."""

    particle_q: wp.array[wp.vec3]
    body_q: wp.array[wp.transform]
    shapes: PlacedShapes


class ModelMesh(CollisionMesh):
    """The triangles of a Newton model that particles can collide with, as one mesh.

    Its vertices are the particles of the model, then those of the tessellated shapes; its faces are the triangles of
    the model, then the other surface triangles of its tetrahedra, then those of the shapes. Round shapes have their
    vertices on the surface, so that the mesh of a convex shape lies within it. A shape that is in all worlds has
    vertices in each. Infinite planes have no triangles and are listed separately.

    Later changes of the model do not change the mesh, except for positions and inverse masses, and poses and scales of
    shapes, which it follows when it is told to. It does not follow other changes of shapes that collide, or did: of
    type, source, body, flags of collision, and margin if margins are used; the third scale of a barrel, a capsule that
    becomes a sphere or was one, and a plane that becomes infinite or was so. What such a shape collides with is as it
    was, but for its pose.

    Shapes that do not collide with particles by their flags (``newton.ShapeFlags``) are not part of the mesh. Particles
    that are not active are, and are held where the program puts them.

    Attributes:
        model: The model.
        segments: Triangles around a round shape.
        shape_vertices: The vertices from ``model.particle_count`` on, NumPy arrays, positions those of construction.
        planes: The infinite planes, NumPy arrays, those of construction.
        inverse_masses: Inverse masses [1/kg] of all vertices, Warp array of float, shape [vertex_count].
        device_world: World of each vertex, Warp array of int, shape [vertex_count].
        device_shape_vertices: ``shape_vertices`` as Warp arrays.
        device_planes: ``planes`` as Warp arrays.
        placed_shapes: Both for kernels, ``state.shapes.PlacedShapes``.
        connectivity: The elements for kernels, :class:`.state.structs.Connectivity`.
        distances: Minimum distances of pairs, None if pairs only must not touch.
        distance_arrays: What each step reads them from, None if they stay as they are.
        shape_filter: Groups and masks of the shapes on the device, for infinite planes; empty without a filter.
    """

    def __init__(
        self,
        model: Model,
        *,
        strands: bool = False,
        segments: int = SEGMENTS,
        collision_filter: CollisionFilter | None = None,
        separates_bodies: bool = False,
        uses_margins: bool = False,
    ):
        """Tessellates the shapes and puts the mesh on the model's device.

        Args:
            model: The ``newton.Model``.
            strands: Whether springs without faces take part as edges, and particles without springs as points. Only a
                minimum distance keeps these apart from each other. A spring that runs along two others, to resist
                bending, takes no part.
            segments: Triangles around a round shape, a multiple of four, 4 to 1024. The mesh of a sphere of radius r
                lies up to 10 r / segments^2 below the sphere.
            collision_filter: Groups and masks of particles and shapes; None to leave out no pairs.
            separates_bodies: Whether shapes of a model with bodies take part that collide with shapes, but not with
                particles; a filter leaves out their pairs with particles.
            uses_margins: Whether distances that pairs keep follow from margins of shapes.

        Raises:
            TypeError: If ``segments`` is no integer.
            ValueError: If ``segments`` is out of range or no multiple of four, or the filter does not fit the model.
            NotImplementedError: If a shape that collides with particles is neither a plane, box, sphere, capsule,
                cylinder, cone or ellipsoid nor a mesh, or a particle is in all of several worlds.
        """
        self.segments = checked_integer(segments, "segments", 4, MAX_SEGMENTS)
        if segments % 4:
            raise ValueError(f"segments must be a multiple of four, not {segments}")
        particle_world = host_array(model.particle_world)
        if model.world_count == 1:
            particle_world = np.zeros_like(particle_world)
        elif (particle_world < 0).any():
            raise NotImplementedError(
                f"particle {np.argmax(particle_world < 0)} is in all of {model.world_count} worlds; add it to one world"
            )
        shape_body, shape_world = host_array(model.shape_body), host_array(model.shape_world)
        flags = host_array(model.shape_flags)
        apart, self._colliding = np.zeros(len(flags), dtype=bool), int(ShapeFlags.COLLIDE_PARTICLES)
        if separates_bodies and model.body_count:
            apart = (flags & (ShapeFlags.COLLIDE_SHAPES | ShapeFlags.COLLIDE_PARTICLES)) == ShapeFlags.COLLIDE_SHAPES
            self._colliding |= int(ShapeFlags.COLLIDE_SHAPES)
        collides = apart | ((flags & ShapeFlags.COLLIDE_PARTICLES) != 0)
        shape_type, shape_scale = host_array(model.shape_type), host_array(model.shape_scale)
        infinite = are_infinite_planes(model)
        tessellations = {}
        triangles, vertex_count = elements_of(model.tri_indices, 3), model.particle_count
        tetrahedra = elements_of(model.tet_indices, 4)
        faces = [triangles, outer_sides(tetrahedra, triangles)]
        shapes, worlds, units, unit_of_vertex, unit_count = [], [], [np.empty((0, 4))], [np.empty(0, dtype=int)], 0
        for shape in np.flatnonzero(collides & ~infinite):
            key = tessellation_key(model, shape, GeoType(shape_type[shape]), shape_scale[shape])
            if key not in tessellations:
                unit, shape_faces = tessellate(model, shape, GeoType(shape_type[shape]), shape_scale[shape], segments)
                tessellations[key] = unit_count + np.arange(len(unit)), shape_faces
                units.append(unit)
                unit_count += len(unit)
            of_unit, shape_faces = tessellations[key]
            for world in range(model.world_count) if shape_world[shape] < 0 else [shape_world[shape]]:
                shapes += [shape] * len(of_unit)
                worlds += [world] * len(of_unit)
                unit_of_vertex.append(of_unit)
                faces.append(vertex_count + shape_faces)
                vertex_count += len(of_unit)
        world, faces = np.concatenate([particle_world, np.array(worlds, dtype=np.int32)]), np.concatenate(faces)
        edges, points = _strands(model, faces) if strands else (None, None)
        worlds = world if model.world_count > 1 else None
        shapes, group, mask = np.array(shapes, dtype=np.int32), None, None
        bits, self.shape_filter = bits_of_model(model, collision_filter, apart), PairFilter()
        if bits is not None:
            of_particles, of_shapes = bits
            group, mask = np.concatenate([of_particles, of_shapes[:, shapes]], axis=1)
            on_device = [wp.array(b.view(np.int32), dtype=int, device=model.device) for b in of_shapes]
            self.shape_filter.group, self.shape_filter.mask = on_device
        options: dict[str, Any] = {"edges": edges, "points": points, "world": worlds, "group": group, "mask": mask}
        super().__init__(faces, vertex_count, **options, tets=tetrahedra, device=model.device)
        self.model = model
        planes = np.flatnonzero(collides & infinite).astype(np.int32)
        of_vertices, of_planes = (shape_body[shapes], shapes), (shape_body[planes], planes, shape_world[planes])
        unplaced = np.zeros((len(shapes), 3)), np.zeros((len(planes), 3))
        self.device_shape_vertices = vertices = ShapeVertices(*map(self._on_device, (unplaced[0], *of_vertices)))
        self.device_planes = on_device = Planes(*map(self._on_device, (unplaced[1], unplaced[1], *of_planes)))
        self.placed_shapes = placed = PlacedShapes()
        placed.jumped = wp.ones(len(flags), dtype=int, device=self.device)
        placed.unit = wp.array(np.concatenate(units), dtype=wp.vec4d, device=self.device)
        placed.unit_of_vertex = self._on_device(np.concatenate(unit_of_vertex))
        placed.position, placed.body, placed.shape = vertices
        placed.plane_point, placed.plane_normal, placed.plane_body, placed.plane_shape = on_device[:4]
        self._taken_shapes = shapes_of(model, with_margins=uses_margins, copies=True)
        self._place_shapes()
        self.shape_vertices = ShapeVertices(vertices.position.numpy().copy(), *of_vertices)
        self.planes = Planes(on_device.point.numpy().copy(), on_device.normal.numpy().copy(), *of_planes)
        self.device_world = self._on_device(world)
        self.connectivity = connectivity = Connectivity()
        connectivity.faces, connectivity.edges = self.device_faces, self.device_edges
        connectivity.vertex_edges = _for_kernels(ElementsOfParts.of(self.edges, vertex_count), self.device)
        connectivity.edge_faces = _for_kernels(self.edge_faces, self.device)
        self.inverse_masses = wp.zeros(vertex_count, dtype=float, device=self.device)
        self.refresh_inverse_masses()
        self.distances: MinDistances | None = None
        self.distance_arrays: DistanceArrays | None = None

    def keep_distances(self, kept: KeptDistances, *, reach: float) -> None:
        """Makes pairs keep distances, see :mod:`warp_bsc.detection.narrow.rules.approach`.

        Those of a proximity are farther apart than their minimum distance by at most the ``reach`` [m].
        """
        count, rigid_id = self.model.particle_count, np.full(self.vertex_count, -1)
        half = 0.5 * kept.minimum
        every = half + np.concatenate([kept.radii, kept.margins[self.shape_vertices.shape]])
        rigid_id[count:] = self.shape_vertices.body + 1
        self.distances = make_min_distances(
            self, every, of_planes=half + kept.margins[self.planes.shape], reach=reach, rigid_id=rigid_id
        )
        if any(array is not None for array in kept.arrays):
            shapes = np.concatenate([self.shape_vertices.shape, self.planes.shape])
            self.distance_arrays = DistanceArrays(kept, shapes, self.distances)

    def _on_device(self, values: np.ndarray) -> wp.array:
        """Returns a Warp array of ints, or of vectors if the values are two-dimensional."""
        return wp.array(values, dtype=wp.vec3 if values.ndim == 2 else int, device=self.device)

    def positions(
        self, particle_q: wp.array[wp.vec3] | None, body_q: wp.array[wp.transform] | None, out: wp.array[wp.vec3]
    ) -> None:
        """Writes the positions of all vertices, those of particles bit for bit. Can be captured in a CUDA graph.

        Args:
            particle_q: Positions of the particles [m], Warp array of vec3, shape [particle_count], or None if the model
                has none.
            body_q: Transforms of the bodies, Warp array of transform, shape [body_count], or None if the model has
                none.
            out: Where to write the positions [m], Warp array of vec3, shape [vertex_count].

        Raises:
            ValueError: If an array has another length.
        """
        if len(out) != self.vertex_count:
            raise ValueError(f"out must have length {self.vertex_count}, not {len(out)}")
        inputs = [self.place(particle_q, body_q)]
        wp.launch(_write_positions, self.vertex_count, inputs=inputs, outputs=[out], device=self.device)

    def place(self, particle_q: wp.array[wp.vec3] | None, body_q: wp.array[wp.transform] | None) -> Placement:
        """Returns where vertices and planes are in a state, with arguments and errors as of :meth:`positions`."""
        place, model = Placement(), self.model
        given = ("particle_q", particle_q, model.particle_count), ("body_q", body_q, model.body_count)
        for name, array, count in given:
            length = 0 if array is None else len(array)
            if length != count:
                raise ValueError(f"{name} must have length {count}, not {length}")
        place.particle_q, place.body_q, place.shapes = particle_q, body_q, self.placed_shapes
        return place

    def particle_edge_lengths(self) -> np.ndarray:
        """Returns the lengths of the edges of cloth, soft bodies and ropes at rest [m], shape [n]."""
        particle_q = self.model.particle_q
        rest = np.zeros((0, 3)) if particle_q is None else particle_q.numpy()
        edges = self.edges[self.edges[:, 1] < self.model.particle_count]
        return np.linalg.norm(rest[edges[:, 1]] - rest[edges[:, 0]], axis=1)

    def refresh_inverse_masses(self) -> None:
        """Reads the inverse masses and flags of the model's particles again. Can be captured in a CUDA graph.

        The response cannot move vertices with inverse mass 0: kinematic and inactive particles, and shapes; nor those
        whose inverse mass is not finite.
        """
        model = self.model
        inputs, outputs = [model.particle_inv_mass, model.particle_flags], [self.inverse_masses]
        wp.launch(_write_inverse_masses, model.particle_count, inputs=inputs, outputs=outputs, device=self.device)

    def follow_shapes(self, not_followed: wp.array[wp.int64]) -> None:
        """Moves vertices and planes to where poses and scales of shapes have them now. Can be captured in a CUDA graph.

        Args:
            not_followed: Written where something is not followed: the last such shape, counted from 1, shape [1].

        Raises:
            ValueError: If the number of shapes has changed.
        """
        if not self.model.shape_count:
            return
        now = shapes_of(self.model, with_margins=bool(self._taken_shapes.margin))
        if len(now.type) != len(self._taken_shapes.type):
            raise ValueError(f"the model had {len(self._taken_shapes.type)} shapes, now it has {len(now.type)}")
        outputs = [self._taken_shapes, self.placed_shapes.jumped, not_followed]
        wp.launch(take_shapes, len(now.type), inputs=[now, self._colliding], outputs=outputs, device=self.device)
        self._place_shapes()

    def _place_shapes(self):
        placed = self.placed_shapes
        size = max(len(placed.shape), len(placed.plane_shape))
        wp.launch(place_shapes, size, inputs=[self._taken_shapes, placed], device=self.device)


@wp.func
def vertex_position(place: Placement, vertex: int) -> wp.vec3:
    """Returns the position of a vertex of a :class:`ModelMesh` [m], see :meth:`ModelMesh.positions`."""
    i = vertex - place.particle_q.shape[0]
    if i < 0:
        return place.particle_q[vertex]
    body = place.shapes.body[i]
    if body < 0:
        return place.shapes.position[i]
    return wp.transform_point(place.body_q[body], place.shapes.position[i])


@wp.kernel(enable_backward=False, module="unique")
def _write_positions(place: Placement, positions: wp.array[wp.vec3]):
    positions[wp.tid()] = vertex_position(place, wp.tid())


@wp.kernel(enable_backward=False, module="unique")
def _write_inverse_masses(
    particle_inv_mass: wp.array[float], particle_flags: wp.array[int], inverse_masses: wp.array[float]
):
    particle = wp.tid()
    is_active = particle_flags[particle] & ParticleFlags.ACTIVE != 0
    moves = is_active and wp.isfinite(particle_inv_mass[particle])
    inverse_masses[particle] = wp.where(moves, particle_inv_mass[particle], 0.0)


def host_array(array: wp.array | None) -> np.ndarray:
    """Returns an array that a model has once it is finalized, on the host."""
    assert array is not None
    return array.numpy()


def _for_kernels(found: ElementsOfParts, device: wp.Device) -> Incidence:
    incidence = Incidence()
    incidence.first = wp.array(found.first, dtype=int, device=device)
    incidence.items = wp.array(found.elements, dtype=int, device=device)
    return incidence


def grouped_by_world(world: np.ndarray, worlds: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns what there is, what is in all worlds (-1) first, then world by world; and where each begins and ends.

    Both are indices, the first of those of ``world``, shape [n], the second of the first, shape [worlds + 1].
    """
    order = np.argsort(world, kind="stable")
    return order, np.searchsorted(world[order], np.arange(worlds + 1))


def members_of_worlds(world: np.ndarray, worlds: int) -> np.ndarray:
    """Returns what is in each world, what is in all (-1) first, then -1; int32, shape [worlds, n]."""
    order, first = grouped_by_world(world, worlds)
    everywhere, numbers, counts = order[: first[0]], order[first[0] :], np.diff(first)
    found = np.full((worlds, len(everywhere) + counts.max()), -1, dtype=np.int32)
    found[:, : len(everywhere)] = everywhere
    column = np.arange(len(numbers)) - np.repeat(np.cumsum(counts) - counts, counts)
    found[world[numbers], len(everywhere) + column] = numbers
    return found


def are_infinite_planes(model: Model) -> np.ndarray:
    """Returns which shapes of a model are infinite planes, shape [shape_count]."""
    return (host_array(model.shape_type) == GeoType.PLANE) & (host_array(model.shape_scale)[:, :2] <= 0.0).any(axis=1)


def dynamic_bodies(model: Model) -> np.ndarray:
    """Returns which bodies of a model are neither kinematic nor without mass, shape [body_count]."""
    if not model.body_count:
        return np.zeros(0, dtype=bool)
    is_kinematic = (host_array(model.body_flags) & BodyFlags.KINEMATIC) != 0
    return (host_array(model.body_inv_mass) > 0.0) & ~is_kinematic


def elements_of(indices: wp.array | None, n: int) -> np.ndarray:
    """Returns the elements of a model, which have ``n`` vertices each, shape [element_count, n]."""
    return np.empty((0, n), dtype=np.int32) if indices is None else indices.numpy().reshape(-1, n)


def outer_sides(tetrahedra: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Returns the outer sides of tetrahedra without the triangles, counterclockwise from outside, shape [n, 3]."""
    sides = tetrahedra[:, [[0, 2, 1], [1, 2, 3], [0, 1, 3], [0, 3, 2]]].reshape(-1, 3)
    if not len(sides):
        return sides
    # an inner side belongs to two tetrahedra; with the triangles counted twice, the missing sides occur once
    corners = np.sort(np.concatenate([sides, triangles, triangles]), axis=1)
    _, first, count = np.unique(corners, axis=0, return_index=True, return_counts=True)
    return sides[first[count == 1]]


def _strands(model, faces):
    """Returns the springs that take part, and the particles without faces and springs that do.

    Springs have an end without faces, and do not run along two others. Inner particles of soft bodies take no part.
    """
    count = model.particle_count
    bare = np.ones(count, dtype=bool)
    bare[faces[faces < count]] = False
    bare[elements_of(model.tet_indices, 4)] = False
    springs = elements_of(model.spring_indices, 2)
    taken = bare[springs].any(axis=1)
    if not taken.any():
        return None, np.flatnonzero(bare)
    lengths = model.spring_rest_length.numpy()
    springs, lengths = springs[taken], lengths[taken]
    neighbours = [{} for _ in range(count)]
    for (a, b), length in zip(springs.tolist(), lengths.tolist(), strict=True):
        neighbours[a][b] = neighbours[b][a] = length

    def is_chord(a, b, length):
        between = neighbours[a].keys() & neighbours[b].keys()
        return any(length >= _STRAIGHT * (neighbours[a][c] + neighbours[b][c]) for c in between)

    kept = [not is_chord(a, b, length) for (a, b), length in zip(springs.tolist(), lengths.tolist(), strict=True)]
    bare[springs] = False
    return springs[kept], np.flatnonzero(bare)


def unseen_strands(mesh: ModelMesh) -> str | None:
    """Returns which springs and particles that could meet something a mesh without strands lacks, None if none.

    Particles that are not active or that a filter leaves out of all pairs do not count, nor does what is alone in its
    world.
    """
    model = mesh.model
    springs, points = _strands(model, mesh.faces)
    springs = np.zeros((0, 2), dtype=int) if springs is None else springs
    meets = (host_array(model.particle_flags) & ParticleFlags.ACTIVE) != 0
    if mesh.group is not None and mesh.mask is not None:
        meets &= ((mesh.group != 0) & (mesh.mask != 0))[: len(meets)]
    world, size = mesh.device_world.numpy(), max(1, model.world_count)
    lacking = [world[springs[meets[springs].any(axis=1), 0]], world[points[meets[points]]]]
    has_others = np.bincount(np.concatenate(lacking), minlength=size) > 1
    has_others[world[mesh.faces[:, 0]]] = True
    names = "springs", "particles without faces and springs"
    numbers = [np.count_nonzero(has_others[worlds]) for worlds in lacking]
    return " and ".join(f"{n} {name}" for n, name in zip(numbers, names, strict=True) if n) or None
