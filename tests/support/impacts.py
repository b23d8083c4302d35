"""A user's kernel that finds first contacts, shared by all tests that need one, so that it is compiled once."""

import functools

import warp as wp
from compilation import QUICK

from warp_bsc.kernels import impact_edge_edge, impact_vertex_face


@functools.cache
def impact_kernel(dtype):
    """The kernel for one type of point, with gradients; its module may fuse multiply and add, as modules do."""

    @wp.kernel(module="unique", module_options=QUICK)
    def find_impacts(
        edges: bool,
        tolerance: wp.float64,
        x: wp.array2d[dtype],
        status: wp.array[int],
        within_tolerance: wp.array[int],
        grazing: wp.array[int],
        toi: wp.array[wp.float64],
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
    ):
        i = wp.tid()
        if edges:
            contact = impact_edge_edge(
                x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7], tolerance
            )
        else:
            contact = impact_vertex_face(
                x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5], x[i, 6], x[i, 7], tolerance
            )
        status[i] = contact.status
        within_tolerance[i] = contact.within_tolerance
        grazing[i] = contact.grazing
        toi[i] = contact.toi
        coordinates[i] = contact.coordinates
        normal[i] = contact.normal

    return find_impacts
