"""Collisions on the device, as differentiable functions of the positions that they were found for."""

import functools

import warp as wp

from ..kernels.gradients import with_gradients
from ..kernels.motion import double
from ..kernels.pipeline.pairs import vertices_of_pair
from ..kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from ..kernels.signs import HIT, UNSURE
from ..kernels.time_of_impact import Impact
from .narrow_phase import Count

__all__ = ["CollisionArrays", "put", "take"]

_FOUND = wp.constant(int(Count.FOUND))
_REFUTED = wp.constant(int(Count.REFUTED))


@functools.cache
def _kernel(dtype):
    """The kernel for one type of position, in a module of its own."""

    @wp.kernel(module="unique", module_options={"fuse_fp": False})
    def differentiate(
        kind: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        tolerance: wp.float64,
        pairs: wp.array[wp.vec2i],
        localized: wp.array[wp.bool],
        found_toi: wp.array[wp.float64],
        found_coordinates: wp.array[wp.vec3d],
        found_normal: wp.array[wp.vec3d],
        toi: wp.array[wp.float64],
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
        grazing: wp.array[wp.bool],
    ):
        i = wp.tid()
        pair = pairs[i]
        if pair[0] < 0:
            toi[i] = wp.float64(2.0)
            coordinates[i] = wp.vec3d()
            normal[i] = wp.vec3d()
            grazing[i] = False
            return
        v = vertices_of_pair(kind, elements, pair)
        found = Impact()
        found.status = wp.where(localized[i], HIT, UNSURE)
        found.localized = wp.where(localized[i], 1, 0)
        found.toi = found_toi[i]
        found.coordinates = found_coordinates[i]
        found.normal = found_normal[i]
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


@wp.kernel(enable_backward=False, module="unique")
def _take(
    counts: wp.array[wp.int64],
    pairs: wp.array[wp.vec2i],
    localized: wp.array[wp.bool],
    toi: wp.array[wp.float64],
    coordinates: wp.array[wp.vec3d],
    normal: wp.array[wp.vec3d],
    taken_pairs: wp.array[wp.vec2i],
    taken_localized: wp.array[wp.bool],
    taken_toi: wp.array[wp.float64],
    taken_coordinates: wp.array[wp.vec3d],
    taken_normal: wp.array[wp.vec3d],
):
    """Copies the contacts out of a queue that the next detection overwrites; what is behind them is none."""
    i = wp.tid()
    if wp.int64(i) >= counts[_FOUND] - counts[_REFUTED]:
        taken_pairs[i] = wp.vec2i(-1, -1)
        return
    taken_pairs[i] = pairs[i]
    taken_localized[i] = localized[i]
    taken_toi[i] = toi[i]
    taken_coordinates[i] = coordinates[i]
    taken_normal[i] = normal[i]


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

    def __init__(self, x0, x1, mesh, tolerance, found):
        """Makes the arrays, and records on the tape how.

        Args:
            x0: Positions at the start, Warp array of vec3 or vec3d on the mesh's device.
            x1: Positions at the end, of the same type.
            mesh: The mesh.
            tolerance: Of the times of impact, as a share of the step.
            found: Arrays for "vertex_face" and for "edge_edge": pairs, localized, times, coordinates, normals.
        """
        for kind, elements in (("vertex_face", mesh.device_faces), ("edge_edge", mesh.device_edges)):
            pairs, *constants = found[kind]
            number = int(VERTEX_FACE if kind == "vertex_face" else EDGE_EDGE)
            toi, coordinates, normal = (wp.zeros_like(array, requires_grad=True) for array in constants[1:])
            grazing = wp.zeros(len(pairs), dtype=wp.bool, device=pairs.device)
            inputs = [number, x0, x1, elements, tolerance, pairs, *constants]
            outputs = [toi, coordinates, normal, grazing]
            wp.launch(_kernel(x0.dtype), len(pairs), inputs=inputs, outputs=outputs, device=pairs.device)
            setattr(self, kind, pairs)
            for name, array in zip(("toi", "coordinates", "normal", "grazing"), outputs, strict=True):
                setattr(self, f"{kind}_{name}", array)


def put(results, kind, device):
    """Collisions of one kind that the host has read, by name, as arrays for :class:`CollisionArrays`."""
    names = kind, f"_{kind}_localized", f"{kind}_toi", f"{kind}_coordinates", f"{kind}_normal"
    dtypes = wp.vec2i, wp.bool, wp.float64, wp.vec3d, wp.vec3d
    return [wp.array(results[name], dtype=dtype, device=device) for name, dtype in zip(names, dtypes, strict=True)]


def take(contacts, counts, read=None):
    """Copies of sorted :class:`Contacts` for :class:`CollisionArrays`.

    Args:
        contacts: The contacts.
        counts: By :class:`Count`, array of int64.
        read: The same as NumPy array; None to take all rows of the queue, filled or not, without asking the device.
    """
    rows = len(contacts.pairs) if read is None else int(read[Count.FOUND] - read[Count.REFUTED])
    arrays = [contacts.pairs, contacts.localized, contacts.toi, contacts.coordinates, contacts.normal]
    taken = [wp.empty(rows, dtype=array.dtype, device=array.device) for array in arrays]
    wp.launch(_take, rows, inputs=[counts, *arrays], outputs=taken, device=counts.device, record_tape=False)
    return taken
