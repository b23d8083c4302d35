"""Collisions on the device, as differentiable functions of the positions that they were found for."""

from collections.abc import Mapping

import warp as wp

from ...kernels.distance_gradients import with_distance_gradients
from ...kernels.gradients import with_gradients
from ...kernels.motion import query_at
from ...kernels.pairs import distance_of_corners, form_of, points_of_pair
from ...kernels.signs import HIT, UNSURE
from ...kernels.time_of_impact import Impact
from ..mesh import CollisionMesh
from ..narrow.contact_buffer import ContactBuffer
from ..run.launch import launch, made_once
from ..run.settings import PairKind


@made_once
def _kernel(dtype: type, with_distance: bool) -> wp.Kernel:
    """Returns the kernel for pairs with a minimum distance or without, for one type of position, in its own module.

    Of a pair with a minimum distance coordinates and normal are neither read nor written.
    """

    @wp.kernel(module="unique", module_options={"fuse_fp": False})
    def differentiate(
        kind: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        radius: wp.array[wp.float64],
        tolerance: wp.float64,
        # in
        contacts: ContactBuffer,
        # out
        toi: wp.array[wp.float64],
        grazing: wp.array[wp.bool],
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
    ):
        i = wp.tid()
        pair = contacts.pairs[i]
        if pair[0] < 0:
            toi[i] = wp.float64(2.0)
            grazing[i] = False
            if not wp.static(with_distance):
                coordinates[i] = wp.vec3d()
                normal[i] = wp.vec3d()
            return
        v = points_of_pair(kind, elements, pair)
        found = Impact()
        found.status = wp.where(contacts.within_tolerance[i], HIT, UNSURE)
        found.within_tolerance = wp.where(contacts.within_tolerance[i], 1, 0)
        found.toi = contacts.toi[i]
        query = query_at(x0, x1, v)
        if wp.static(with_distance):
            distance = distance_of_corners(kind, v, radius)
            form = form_of(kind)
            reached = with_distance_gradients(form, query, distance, found, tolerance)
            toi[i] = reached.toi
            grazing[i] = reached.grazing == 1
        else:
            found.coordinates = contacts.coordinates[i]
            found.normal = contacts.normal[i]
            contact = with_gradients(kind, query, found, tolerance)
            toi[i] = contact.toi
            grazing[i] = contact.grazing == 1
            coordinates[i] = contact.coordinates
            normal[i] = contact.normal

    return differentiate


class DifferentiableContacts:
    """The collisions of one motion as Warp arrays on the device, in the order of :class:`Collisions`.

    Times, coordinates and normals are differentiable functions of the positions; which pairs collide is a constant.
    Their gradients are recorded on the tape that was active. For collisions of a detection in a
    CUDA graph the arrays are as long as the detector's queues, and rows without a collision have the pair (-1, -1) and
    the time 2.0. All lengths are the same for a kind of pair.

    With minimum distances only times have gradients, those of the time at which a pair's distance is reached, see
    :mod:`warp_bsc.kernels.distance_gradients`; coordinates and normals are constants. Of pairs with edges or points
    that no face has, there are attributes ``vertex_edge``, ``vertex_edge_toi`` and so on, and ``vertex_vertex``.

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
        contacts: Mapping[PairKind, ContactBuffer],
        radius: wp.array | None = None,
    ):
        """Launches the kernels that compute the arrays, and records them on the tape.

        Args:
            x0: Positions at the start, Warp array of vec3 or vec3d on the mesh's device.
            x1: Positions at the end, of the same type.
            mesh: The mesh.
            tolerance: Of the times of impact, as a share of the step.
            contacts: The sorted contacts of each kind of pair, which must not change afterwards.
            radius: Radius of each vertex; the distance of a pair is the sum of two. None without minimum distances.
        """
        for kind, found in contacts.items():
            elements = mesh.device_elements(kind)
            toi = wp.zeros_like(found.toi, requires_grad=True)
            grazing = wp.zeros(len(found.pairs), dtype=wp.bool, device=mesh.device)
            coordinates, normal, outputs = found.coordinates, found.normal, [toi, grazing, None, None]
            if radius is None:
                coordinates, normal = (wp.zeros_like(a, requires_grad=True) for a in (coordinates, normal))
                outputs[2:] = coordinates, normal
            kernel, inputs = _kernel(x0.dtype, radius is not None), [int(kind), x0, x1, elements, radius, tolerance]
            launch(kernel, len(found.pairs), inputs=[*inputs, found], outputs=outputs, device=mesh.device)
            setattr(self, kind.label, found.pairs)
            results = {"toi": toi, "normal": normal, "grazing": grazing}
            if kind != PairKind.VERTEX_VERTEX:
                results["coordinates"] = coordinates
            for name, array in results.items():
                setattr(self, f"{kind.label}_{name}", array)
