"""Device functions to import into one's own Warp kernels.

``ccd_vertex_face`` and ``ccd_edge_edge`` answer FREE, HIT or UNSURE; ``impact_vertex_face`` and
``impact_edge_edge`` find the first contact as well, and have gradients. They take eight points, ``vec3`` or ``vec3d``.
Answers are certain whatever the options of the module that calls them, ``fast_math`` among them, and where a processor
is told to take subnormal numbers for zero, as long as it rounds to nearest.

The other modules hold one idea of the method each.
"""

from .ccd import ccd_edge_edge, ccd_vertex_face, impact_edge_edge, impact_vertex_face
from .signs import FREE, HIT, UNSURE
from .time_of_impact import Impact

__all__ = [
    "FREE",
    "HIT",
    "UNSURE",
    "Impact",
    "ccd_edge_edge",
    "ccd_vertex_face",
    "impact_edge_edge",
    "impact_vertex_face",
]
