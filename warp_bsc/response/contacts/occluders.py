"""The nearest face of each vertex in each of six directions, and paths that end there: what is farther is behind it."""

import warp as wp

from ...detection.broad.element_pairs import Pairs, filtered_pairs, pair_functions
from ...detection.broad.face_hierarchy import FaceHierarchy
from ...detection.run.launch import made_once
from ...detection.run.settings import NO_GRADIENTS
from ...kernels.closest import weights_across
from ...kernels.pipeline.hierarchy import lowest_set_bit
from ...kernels.pipeline.queues import filled_entries
from ...kernels.polynomials import VERTEX_FACE
from ..state.status import SolveStatus
from ..state.structs import Step
from ..state.vectors import ZERO, corners_of, to_double
from ..tuning import BEHIND
from .face_pairs import pair_of_bit
from .queue import PairQueue, pair_count, vertices_of

wp.set_module_options({"enable_backward": False})


@wp.func
def _direction(u: wp.vec3d) -> int:
    """Returns to which of the six directions along the axes a vector is nearest."""
    axis = int(0)
    for other in range(1, 3):
        if wp.abs(u[other]) > wp.abs(u[axis]):
            axis = other
    return 2 * axis + wp.where(u[axis] > ZERO, 1, 0)


@wp.func
def is_behind(corners: wp.vec4i, kind: int, normal: wp.vec3d, distance: wp.float64, nearest: wp.array2d[float]) -> bool:
    """Returns whether another face is between two elements: seen from the vertex, or from both ends of an edge."""
    a = nearest[corners[0], _direction(-normal)]
    if kind == VERTEX_FACE:
        return distance > BEHIND * wp.float64(a)
    b = nearest[corners[1], _direction(-normal)]
    c = nearest[corners[2], _direction(normal)]
    d = nearest[corners[3], _direction(normal)]
    return distance > BEHIND * wp.float64(wp.min(wp.max(a, b), wp.max(c, d)))


@wp.func
def _keep_nearest(step: Step, corners: wp.vec4i, nearest: wp.array2d[float]):
    """Keeps how far a vertex is from a face, if that has the closest point within it."""
    a, b, c, d = corners_of(step.motion.x0, corners)
    _weights, normal, distance = weights_across(VERTEX_FACE, a, b, c, d)
    if distance > ZERO:
        wp.atomic_min(nearest, corners[0], _direction(-normal), float(distance))


@wp.kernel
def find_nearest_in_queue(step: Step, vertex_face: PairQueue, nearest: wp.array2d[float], threads: int):
    """Keeps the nearest face of each vertex among the candidates of a queue."""
    for i in range(wp.tid(), pair_count(vertex_face), threads):
        _keep_nearest(step, vertices_of(vertex_face, i), nearest)


@made_once
def nearest_among_faces_kernel(padded: bool, swept: bool) -> wp.Kernel:
    """Returns the kernel that keeps the nearest face of each vertex among pairs of faces, as a GPU has in a queue.

    It keeps none where some did not fit: which did depends on the order of threads.
    """
    vertex_face_pairs = pair_functions(padded, swept).vertex_face_pairs

    @wp.kernel(**NO_GRADIENTS)
    def find_nearest_among_faces(
        mesh: FaceHierarchy, face_pairs: Pairs, step: Step, nearest: wp.array2d[float], threads: int
    ):
        count = filled_entries(face_pairs.pairs, face_pairs.counts, 0)
        if face_pairs.counts[0] > wp.int64(count):
            return
        for i in range(wp.tid(), count, threads):
            place = face_pairs.pairs[i][0]
            other = face_pairs.pairs[i][1]
            left = vertex_face_pairs(mesh, place, other)
            left = left & ~filtered_pairs(mesh, place, other, left)
            while left != 0:
                bit = lowest_set_bit(wp.uint32(left))
                left = left & (left - 1)
                _kind, _pair, corners = pair_of_bit(mesh, place, other, bit)
                _keep_nearest(step, corners, nearest)

    return find_nearest_among_faces


@wp.kernel
def clip_paths(step: Step, nearest: wp.array2d[float], status: SolveStatus, ends: wp.array[wp.vec3]):
    """Clips paths where, by :func:`is_behind`, all that is farther is behind the nearest face.

    Where elements cross, nothing is known to be behind another.
    """
    vertex = wp.tid()
    x0 = step.motion.x0[vertex]
    end = step.vertices.x1[vertex]
    if status.crossings[step.motion.world[vertex]] == 0 and wp.isfinite(end):
        path = to_double(end - x0)
        direction = _direction(path)
        axis = direction / 2
        limit = float(BEHIND) * nearest[vertex, direction]
        clipped = x0[axis] + wp.clamp(end[axis] - x0[axis], -limit, limit)
        end[axis] = wp.clamp(clipped, wp.min(x0[axis], end[axis]), wp.max(x0[axis], end[axis]))  # not even by rounding
    ends[vertex] = end
