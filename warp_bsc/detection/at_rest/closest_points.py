"""The points of a surface that are closest to given points, in single precision, on the CPU."""

from typing import NamedTuple

import numpy as np
import warp as wp

from ..run.launch import launch_over
from ..run.settings import NO_GRADIENTS


@wp.kernel(**NO_GRADIENTS)
def find_closest(
    first: int,
    # mesh
    surface: wp.uint64,
    # in
    points: wp.array[wp.vec3],
    reach: float,
    # out
    faces: wp.array[wp.int32],
    coordinates: wp.array[wp.vec3],
    distances: wp.array[wp.float32],
):
    """Finds the face that is closest to each point, barycentric coordinates of its closest point, and the distance."""
    i = first + wp.tid()
    query = wp.mesh_query_point_no_sign(surface, points[i], reach)
    if not query.result:
        faces[i] = 0
        coordinates[i] = wp.vec3(1.0, 0.0, 0.0)
        distances[i] = wp.inf
        return
    faces[i] = query.face
    coordinates[i] = wp.vec3(query.u, query.v, 1.0 - query.u - query.v)
    distances[i] = wp.length(points[i] - wp.mesh_eval_position(surface, query.face, query.u, query.v))


class ClosestPoints(NamedTuple):
    """The closest points of a surface, a row for each given point.

    Attributes:
        faces: Their faces, shape [n], int32.
        coordinates: Their barycentric coordinates, shape [n, 3].
        distances: Their distances from the given points, infinite where there is none within reach, shape [n].
    """

    faces: np.ndarray
    coordinates: np.ndarray
    distances: np.ndarray


class ClosestPointFinder:
    """Finds closest points of one surface."""

    def __init__(self, x: np.ndarray, faces: np.ndarray):
        """Builds a tree of the faces.

        Args:
            x: Positions of the vertices, float32, shape [vertex_count, 3].
            faces: Vertices of at least one face, int32, shape [face_count, 3].
        """
        corners = wp.array(faces.reshape(-1), dtype=int, device="cpu")
        self._mesh = wp.Mesh(wp.array(x, dtype=wp.vec3, device="cpu"), corners)

    def find(self, points: np.ndarray, reach: float = np.inf) -> ClosestPoints:
        """Returns the closest points that are within a distance.

        Args:
            points: The given points, float32, shape [n, 3].
            reach: The distance.
        """
        count = len(points)
        given = wp.array(points, dtype=wp.vec3, device="cpu")
        outputs = [wp.empty(count, dtype=kind, device="cpu") for kind in (wp.int32, wp.vec3, wp.float32)]
        launch_over(find_closest, count, inputs=[self._mesh.id, given, reach], outputs=outputs, device=given.device)
        return ClosestPoints(*(array.numpy() for array in outputs))
