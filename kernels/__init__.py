"""Device functions for continuous collision detection, to call from any Warp kernel.

``ccd_vertex_face`` and ``ccd_edge_edge`` return FREE, HIT or UNSURE; ``impact_vertex_face`` and ``impact_edge_edge``
return the first contact as well, and have gradients. They take eight points, ``vec3`` or ``vec3d``, and the latter two
a tolerance of the time, a ``float64``. With a last argument, a minimum distance in double precision,
``ccd_vertex_face``, ``ccd_edge_edge``, ``ccd_vertex_edge`` and ``ccd_vertex_vertex`` return whether the features come
within that distance, without gradients. ``inversion_tetrahedron`` returns whether and when a moving tetrahedron
inverts. FREE and HIT are certain with any options of the calling module, ``fast_math`` among them, and on processors
that flush subnormal numbers to zero, as long as these round to nearest. Each of the other modules holds one part of the
method.

References:
    Min Tang, Ruofeng Tong, Zhendong Wang, and Dinesh Manocha. "Fast and Exact Continuous Collision Detection with
    Bernstein Sign Classification." ACM Transactions on Graphics 33, 6 (2014). https://doi.org/10.1145/2661229.2661237.
    Sections, equations and algorithms that docstrings cite are those of this paper.
"""

from .ccd import (
    ccd_edge_edge,
    ccd_vertex_edge,
    ccd_vertex_face,
    ccd_vertex_vertex,
    impact_edge_edge,
    impact_vertex_face,
)
from .inversion import Inversion, inversion_tetrahedron
from .signs import FREE, HIT, UNSURE
from .time_of_impact import Impact

__all__ = [
    "FREE",
    "HIT",
    "UNSURE",
    "Impact",
    "Inversion",
    "ccd_edge_edge",
    "ccd_vertex_edge",
    "ccd_vertex_face",
    "ccd_vertex_vertex",
    "impact_edge_edge",
    "impact_vertex_face",
    "inversion_tetrahedron",
]
