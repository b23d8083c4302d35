"""Collisions on the device, as differentiable functions of the positions that they were found for."""

import functools

import warp as wp

from ..kernels.gradients import with_gradients
from ..kernels.motion import double
from ..kernels.pipeline.pairs import vertices_of_pair
from ..kernels.signs import HIT, UNSURE
from ..kernels.time_of_impact import Impact
from .contact_buffer import ContactBuffer
from .mesh import CollisionMesh
from .settings import PairKind

__all__ = ["CollisionArrays"]


@functools.cache
def _kernel(dtype: type) -> wp.Kernel:
    """The kernel for one type of position, in a module of its own."""

    @wp.kernel(module="unique", module_options={"fuse_fp": False})
    def differentiate(
        kind: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        tolerance: wp.float64,
        # in
        contacts: ContactBuffer,
        # out
        toi: wp.array[wp.float64],
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
        grazing: wp.array[wp.bool],
    ):
        i = wp.tid()
        pair = contacts.pairs[i]
        if pair[0] < 0:
            toi[i] = wp.float64(2.0)
            coordinates[i] = wp.vec3d()
            normal[i] = wp.vec3d()
            grazing[i] = False
            return
        v = vertices_of_pair(kind, elements, pair)
        found = Impact()
        found.status = wp.where(contacts.within_tolerance[i], HIT, UNSURE)
        found.within_tolerance = wp.where(contacts.within_tolerance[i], 1, 0)
        found.toi = contacts.toi[i]
        found.coordinates = contacts.coordinates[i]
        found.normal = contacts.normal[i]
        contact = with_gradients(
            kind,
            double(x0[v[0]]),
            double(x0[v[1]]),
            double(x0[v[2]]),
            double(x0[v[3]]),
            double(x1[v[0]]),
            double(x1[v[1]]),
            double(x1[v[2]]),
            double(x1[v[3]]),
            found,
            tolerance,
        )
        toi[i] = contact.toi
        coordinates[i] = contact.coordinates
        normal[i] = contact.normal
        grazing[i] = contact.grazing == 1

    return differentiate


class CollisionArrays:
    """The collisions of one motion as Warp arrays on the device, in the order of :class:`Collisions`.

    Times, coordinates and normals are differentiable functions of the positions; which pairs collide is a constant.
    They have gradients, and what made them is recorded on the tape that was active. For collisions of a detection in a
    CUDA graph the arrays are as long as the detector's queues, and rows without a collision have the pair (-1, -1) and
    the time 2.0. All lengths are the same for a kind of pair.

    Attributes:
        vertex_face: (vertex, face), array of vec2i.
        edge_edge: (edge, edge), array of vec2i.
        vertex_face_toi: Times of impact as a share of the step, array of float64. Their values are lower bounds within
            the detector's tolerance, their gradients those of the contact itself.
        edge_edge_toi: The same for the edges, array of float64.
        vertex_face_coordinates: Barycentric coordinates of the contact in the face, array of vec3d.
        edge_edge_coordinates: (s, r, 0) along the two edges, array of vec3d.
        vertex_face_normal: Unit normals, against the velocity of the vertex relative to the face, array of vec3d.
        edge_edge_normal: Unit normals, against the velocity of the first edge relative to the second, array of vec3d.
        vertex_face_grazing: Whether the gradients of a pair are not those of its contact but clamped, as the contact
            grazes or has no normal, or its time is not certain to be within the tolerance, array of bool; see
            :mod:`warp_bsc.kernels.gradients`.
        edge_edge_grazing: The same for the edges, array of bool.
    """

    vertex_face: wp.array
    edge_edge: wp.array
    vertex_face_toi: wp.array
    edge_edge_toi: wp.array
    vertex_face_coordinates: wp.array
    edge_edge_coordinates: wp.array
    vertex_face_normal: wp.array
    edge_edge_normal: wp.array
    vertex_face_grazing: wp.array
    edge_edge_grazing: wp.array

    def __init__(
        self,
        x0: wp.array,
        x1: wp.array,
        mesh: CollisionMesh,
        tolerance: float,
        vertex_face: ContactBuffer,
        edge_edge: ContactBuffer,
    ):
        """Makes the arrays, and records on the tape how.

        Args:
            x0: Positions at the start, Warp array of vec3 or vec3d on the mesh's device.
            x1: Positions at the end, of the same type.
            mesh: The mesh.
            tolerance: Of the times of impact, as a share of the step.
            vertex_face: The sorted contacts of vertices with faces, which nothing may change any more.
            edge_edge: Those of edges with edges.
        """
        for kind, contacts in ((PairKind.VERTEX_FACE, vertex_face), (PairKind.EDGE_EDGE, edge_edge)):
            constants = contacts.toi, contacts.coordinates, contacts.normal
            toi, coordinates, normal = (wp.zeros_like(array, requires_grad=True) for array in constants)
            grazing = wp.zeros(len(contacts.pairs), dtype=wp.bool, device=mesh.device)
            inputs = [int(kind), x0, x1, mesh.device_elements(kind), tolerance, contacts]
            outputs = [toi, coordinates, normal, grazing]
            wp.launch(_kernel(x0.dtype), len(contacts.pairs), inputs=inputs, outputs=outputs, device=mesh.device)
            setattr(self, kind.label, contacts.pairs)
            for name, array in zip(("toi", "coordinates", "normal", "grazing"), outputs, strict=True):
                setattr(self, f"{kind.label}_{name}", array)
