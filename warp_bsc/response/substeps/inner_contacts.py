"""Contacts for the inner solver in steps with substeps: those of the program, without those that the stage resolves.

Newton's contacts of particles with shapes are stiff springs, at rest where a particle is its radius away from the
shape. The stage lets particles rest at the shape itself. If both acted, a long step would end where the springs let it,
its elements stretched as far as the iterations of the inner solver leave them, and the stage would find no contact that
needs substeps. The first step in substeps would start from this stretch, and release its energy at once. So one of the
two resolves a contact, in whole steps and in substeps alike, and where it can, that is the stage.

Short steps of VBD are otherwise: it gets all contacts. Springs hold there without stretching what rests on them, and
VBD weighs them against the stiffness of elements, which the projection of the stage does not know: what a shape pushes,
it strains by the way of the shape in a step, and where elements are stiff, that is much energy. The stage then resolves
what the springs let through. A step is short if weight moves what is at rest by no more than ``WEIGHT_STRAIN`` of an
edge. XPBD would make a velocity of the depth of a contact, which is higher the shorter the substep.
"""

import newton
import numpy as np
import warp as wp
from newton import BodyFlags, GeoType

from ..._private_names.of_newton import contacts_with, soft_contact_arrays, soft_contact_counters
from ..._private_names.of_warp import struct_fields
from ...kernels.pipeline.pairs import PairFilter, groups_meet
from ..options import in_eight_bits, particle_edge_lengths
from ..state.mesh import ModelMesh, are_infinite_planes
from ..tuning import SEGMENTS, SHAPE_SAGITTA, WEIGHT_STRAIN

wp.set_module_options({"enable_backward": False})


@wp.struct
class _SoftContacts:
    """Newton's contacts of particles, edges and faces with shapes, as in ``newton.Contacts``."""

    indices: wp.array[wp.vec3i]
    rigid_indices: wp.array[wp.vec3i]
    particle: wp.array[int]
    barycentric: wp.array[wp.vec3]
    shape: wp.array[int]
    body_pos: wp.array[wp.vec3]
    body_vel: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    features: wp.array[wp.vec3i]  # empty without contacts of whole surfaces


@wp.struct
class _Stage:
    """What the stage resolves."""

    depth: wp.array[float]  # below the surface of each shape [m]; a particle below that has entered it
    is_plane: wp.array[bool]  # of each shape, whether it is an infinite plane, which all particles meet
    takes_part: wp.array[bool]  # whether a particle meets other shapes
    of_particles: PairFilter  # groups and masks; empty if no pair is left out
    of_shapes: PairFilter
    shape_body: wp.array[int]
    body_world: wp.array[int]
    body_flags: wp.array[int]
    body_inv_mass: wp.array[float]
    worlds: int
    moves_bodies: int
    leaves_bodies: int  # whether the inner solver moves those that the stage does not


@wp.func
def _resolves(
    stage: _Stage, contacts: _SoftContacts, i: int, particle_q: wp.array[wp.vec3], body_q: wp.array[wp.transform]
) -> bool:
    """Returns whether the stage resolves a contact, so that the inner solver need not."""
    shape = contacts.shape[i]
    body = stage.shape_body[shape]
    x = wp.vec3()
    for corner in range(3):
        particle = contacts.indices[i][corner]
        if particle >= 0:
            if not stage.is_plane[shape] and not stage.takes_part[particle]:
                return False
            x += contacts.barycentric[i][corner] * particle_q[particle]
            if stage.of_particles.group:
                group = stage.of_particles.group[particle]
                mask = stage.of_particles.mask[particle]
                if not groups_meet(group, mask, stage.of_shapes.group[shape], stage.of_shapes.mask[shape]):
                    return False
    point = contacts.body_pos[i]
    if body >= 0:
        point = wp.transform_point(body_q[body], point)
        if stage.body_inv_mass[body] > 0.0 and stage.body_flags[body] & BodyFlags.KINEMATIC == 0:
            moves = stage.moves_bodies == 1 and (stage.worlds <= 1 or stage.body_world[body] >= 0)
            if stage.leaves_bodies == 1 and not moves:
                return False
    return wp.dot(contacts.normal[i], x - point) >= -stage.depth[shape]


@wp.kernel
def _pack(
    # in
    stage: _Stage,
    contacts: _SoftContacts,
    count: wp.array[int],
    particle_q: wp.array[wp.vec3],
    body_q: wp.array[wp.transform],
    # out
    packed: _SoftContacts,
    packed_count: wp.array[int],
    overflow: wp.array[int],
    places: wp.array[int],
):
    """Copies the contacts that the stage does not resolve, and writes the place of each among all."""
    i = wp.tid()
    if i == 0 and count[0] > contacts.shape.shape[0]:
        overflow[0] = 1
    if i >= count[0] or _resolves(stage, contacts, i, particle_q, body_q):
        return
    place = wp.atomic_add(packed_count, 0, 1)
    places[place] = i
    packed.indices[place] = contacts.indices[i]
    packed.rigid_indices[place] = contacts.rigid_indices[i]
    packed.particle[place] = contacts.particle[i]
    packed.barycentric[place] = contacts.barycentric[i]
    packed.shape[place] = contacts.shape[i]
    packed.body_pos[place] = contacts.body_pos[i]
    packed.body_vel[place] = contacts.body_vel[i]
    packed.normal[place] = contacts.normal[i]
    if contacts.features:
        packed.features[place] = contacts.features[i]


@wp.kernel
def _write_depths(shape_type: wp.array[int], shape_scale: wp.array[wp.vec3], sagitta: float, depth: wp.array[float]):
    """Writes how deep below the surface of each shape a particle may rest on its triangles [m].

    The triangles of a round shape lie below its surface, so that a particle that rests on them has not entered it.
    """
    i = wp.tid()
    kind = shape_type[i]
    scale = shape_scale[i]
    radius = wp.float64(0.0)
    if kind == GeoType.SPHERE or kind == GeoType.CAPSULE or kind == GeoType.CONE:
        radius = wp.float64(scale[0])
    elif kind == GeoType.ELLIPSOID:
        radius = wp.float64(wp.max(scale))
    elif kind == GeoType.CYLINDER:
        y, z = wp.float64(scale[1]), wp.float64(scale[2])  # z is the radius of the side of a barrel, an arc
        bulge = wp.where(z > wp.float64(0.0), wp.min(y, z), wp.float64(0.0))
        if z > y:
            bulge = z - wp.sqrt(z * z - y * y)
        radius = wp.float64(scale[0]) + bulge
    depth[i] = sagitta * float(radius)


@wp.kernel
def _unpack(
    packed: wp.array[wp.spatial_vector],
    count: wp.array[int],
    places: wp.array[int],
    forces: wp.array[wp.spatial_vector],
):
    """Writes the forces of packed contacts to the rows of the contacts that the program passed on."""
    i = wp.tid()
    if i < count[0]:
        forces[places[i]] = packed[i]


class InnerContacts:
    """Takes the contacts that the stage resolves out of those that a program passes on.

    The stage resolves a contact of particles with a shape if the particles take part in its detection, and start the
    step outside the shape. It excludes particles that have entered a shape: Newton's contacts push them out. The inner
    solver keeps a contact with a body that it moves, unless the stage pushes that body as well, and a contact that a
    filter of the stage leaves out. Contacts of bodies with each other remain.
    """

    def __init__(self, mesh: ModelMesh, *, moves_bodies: bool):
        """Finds which contacts the stage resolves on a mesh, if the response can move bodies or not."""
        model, self._device = mesh.model, mesh.device
        self._model = model
        self._stage = stage = _Stage()
        stage.depth = wp.zeros(model.shape_count, dtype=float, device=mesh.device)
        self._sagitta = SHAPE_SAGITTA * (SEGMENTS / mesh.segments) ** 2
        self.read_shapes()
        stage.is_plane = wp.array(are_infinite_planes(model), dtype=bool, device=mesh.device)
        stage.takes_part = wp.array(_takes_part(mesh), dtype=bool, device=mesh.device)
        stage.of_particles, stage.of_shapes = mesh.pair_filter, mesh.shape_filter
        stage.shape_body = model.shape_body
        if model.body_count:
            stage.body_world, stage.body_flags = model.body_world, model.body_flags
            stage.body_inv_mass = model.body_inv_mass
        stage.worlds, stage.moves_bodies = model.world_count, int(moves_bodies)
        lengths = particle_edge_lengths(mesh)
        self._edge = in_eight_bits(np.median(lengths)) if lengths.any() else 0.0
        self.read_gravity()
        self._buffers: dict[tuple[int, bool], _Buffers] = {}

    def read_gravity(self) -> None:
        """Reads the gravity of the model, by which steps are short."""
        gravity = self._model.gravity
        assert gravity is not None  # a finalized model has one of each world
        self._gravity = float(np.linalg.norm(gravity.numpy().reshape(-1, 3).astype(np.float64), axis=1).max())

    def read_shapes(self) -> None:
        """Reads the scales of the model's shapes. Can be captured in a CUDA graph."""
        inputs = [self._model.shape_type, self._model.shape_scale, self._sagitta]
        depth = self._stage.depth
        wp.launch(_write_depths, len(depth), inputs=inputs, outputs=[depth], device=self._device)

    def is_short(self, dt: float) -> bool:
        """Returns whether a step of this length [s] is so short that springs hold what weight presses on them.

        Without gravity, none is: nothing says how far contacts go in a step.
        """
        return 0.0 < self._gravity * dt * dt <= WEIGHT_STRAIN * self._edge

    def take_out(
        self, contacts: newton.Contacts | None, state: newton.State, *, leaves_bodies: bool
    ) -> newton.Contacts | None:
        """Returns the contacts for the inner solver.

        Args:
            contacts: The contacts of the program, which stay as they are.
            state: The state at the start of the step.
            leaves_bodies: Whether the inner solver, or a coupler around it, moves bodies that the stage does not.
        """
        if contacts is None or not contacts.soft_contact_max or not self._model.particle_count:
            return contacts
        arrays = _arrays_of(contacts)
        key = _key(contacts, arrays)
        if key not in self._buffers or self._buffers[key].in_graph:
            self._buffers[key] = _Buffers(contacts, arrays)
        buffers = self._buffers[key]
        self._stage.leaves_bodies = int(leaves_bodies)
        wp.copy(buffers.counters, contacts.contact_counters)
        buffers.count.zero_()
        inputs = [self._stage, _as_struct(arrays), contacts.soft_contact_count, state.particle_q, state.body_q]
        outputs = [_as_struct(buffers.arrays), buffers.count, buffers.overflow, buffers.places]
        wp.launch(_pack, contacts.soft_contact_max, inputs=inputs, outputs=outputs, device=self._device)
        return contacts_with(contacts, buffers.counters, buffers.arrays)

    def _buffers_of(self, contacts):
        return self._buffers.get(_key(contacts, _arrays_of(contacts)))

    def packed(self, contacts: newton.Contacts) -> newton.Contacts:
        """Returns the contacts that the inner solver got in the last step instead of those of the program."""
        buffers = self._buffers_of(contacts)
        return contacts if buffers is None else contacts_with(contacts, buffers.counters, buffers.arrays)

    def unpack(self, forces: wp.array | None, contacts: newton.Contacts | None) -> None:
        """Moves the forces on packed contacts to the rows of the contacts that the program passed on.

        Args:
            forces: Forces on all contacts, those of bodies first, as of ``Observables.contact_f``, or None.
            contacts: The contacts of the program.
        """
        if forces is None or contacts is None:
            return
        buffers = self._buffers_of(contacts)
        if buffers is None:
            return
        first = contacts.rigid_contact_max
        rows = forces[first : first + contacts.soft_contact_max]
        if buffers.forces is None:
            buffers.forces = wp.empty_like(rows, requires_grad=False)
        wp.copy(buffers.forces, rows)
        rows.zero_()
        inputs = [buffers.forces, buffers.count, buffers.places]
        wp.launch(_unpack, contacts.soft_contact_max, inputs=inputs, outputs=[rows], device=self._device)


class _Buffers:
    """Packed contacts, and where they were."""

    def __init__(self, contacts, arrays):
        self.arrays = {name: wp.empty_like(array, requires_grad=False) for name, array in arrays.items()}
        self.counters = wp.zeros_like(contacts.contact_counters)
        self.count, self.overflow = soft_contact_counters(contacts, self.counters)  # overflow: some were dropped
        self.places = wp.zeros(contacts.soft_contact_max, dtype=int, device=contacts.device)  # among all contacts
        self.forces: wp.array | None = None  # on the packed contacts
        self.in_graph = contacts.device.is_cuda and contacts.device.is_capturing  # of no use outside it


def _arrays_of(contacts):
    return soft_contact_arrays(contacts, struct_fields(_SoftContacts))


def _key(contacts, arrays):
    """Returns the size of buffers for contacts, and whether they may be of whole surfaces."""
    return contacts.soft_contact_max, "features" in arrays


def _as_struct(arrays):
    soft = _SoftContacts()
    for name, array in arrays.items():
        setattr(soft, name, array)
    return soft


def _takes_part(mesh):
    """Returns whether particles take part in the detection, or lie inside soft bodies, behind others that do."""
    model = mesh.model
    inner = np.empty(0, dtype=int) if model.tet_indices is None else model.tet_indices.numpy()
    members = np.concatenate([mesh.edges.ravel(), mesh.points, inner.ravel()])
    return np.isin(np.arange(model.particle_count), members)
