"""The first contact of a vertex as one number, and the path that remains before it."""

import warp as wp

from ..state.structs import Vertices
from ..tuning import SHARE_OF_PATH

TIME_UNITS = wp.constant(wp.float64(2.0**30))
"""Units of time in a step; packed contacts hold whole units."""


@wp.func
def packed_contact(time: wp.float64, kind: int, i: int) -> wp.int64:
    """Returns contact ``i`` of a ContactKind as one number, which orders contacts by time, then by index and kind.

    The lowest three bits are its kind, those below the time its index.
    """
    units = wp.int64(wp.floor(TIME_UNITS * time))
    return (units << wp.int64(32)) | (wp.int64(8) * wp.int64(i) + wp.int64(kind))


@wp.func
def contact_time(packed: wp.int64) -> wp.float64:
    """Returns the time of a packed contact, in [0, 1]."""
    return wp.float64(packed >> wp.int64(32)) / TIME_UNITS


@wp.func
def contact_kind(packed: wp.int64) -> int:
    """Returns the ContactKind of a packed contact."""
    return int(packed & wp.int64(7))


@wp.func
def update_first_contact(vertices: Vertices, vertex: int, time: wp.float64, kind: int, i: int):
    """Makes contact ``i`` of a ContactKind the first contact of a vertex, if it is earlier than the one so far."""
    wp.atomic_min(vertices.first_contact, vertex, packed_contact(time, kind, i))


@wp.func
def truncated_path(x0: wp.vec3d, x1: wp.vec3d, time: wp.float64) -> wp.vec3d:
    """Returns the path of a vertex truncated before its first contact, at ``time`` in [0, 1] [m]."""
    return SHARE_OF_PATH * time * (x1 - x0)
