"""A wide BVH for the CPU: packets of eight boxes, compared with SIMD instructions.

Elements sorted along a space-filling curve are cut into packets of eight. Eight packets have a node, eight nodes have
one of the next level, up to one root: a tree whose links are arithmetic. The same coordinate of all eight lies side by
side, so that one box is compared with eight at once.

- ``boxes``, float32, 96 a packet: for each axis the lowest and the highest coordinate at the start, then at the end.
- ``elements``, int32, 48 a packet: the numbers of the elements, three corners each, their worlds, and their marks: 0
  of what has not changed, more than 1 of what is of a rigid body, by body.
- ``nodes``, float32, 96 a node: the same of its children.
- ``node_marks``, int32, 24 a node: the first and the last world of the children, and whether elements below them have
  changed.

Missing elements and children have empty boxes, which overlap none.
"""

import functools

import warp as wp

from ..native_text import definitions, header
from ..pairs import PairFilter


@wp.struct
class WideBvh:
    """A tree, whose packets have eight elements each, and whose nodes have eight packets or nodes each."""

    boxes: wp.array[wp.float32]
    elements: wp.array[int]
    corners: int  # of an element
    nodes: wp.array[wp.float32]
    node_marks: wp.array[int]
    level_starts: wp.array[int]


@functools.cache
def pair_packet_of(**constants: bool | int) -> wp.Function:
    """Returns the function that enqueues the pairs of a packet's elements with those of a tree, on a CPU.

    They share no corner, and their swept boxes overlap, unless an axis separates the two at the start and at the end,
    on the same side; with ``keep_separated`` such pairs are enqueued as well. Pairs without a changed element are
    excluded, and those within a rigid body, by marks. With groups, the pairs that a :class:`.pairs.PairFilter` leaves
    out are counted, by world as well if there is an array for that, and are not enqueued.

    Args:
        constants: What is known when it is compiled: ``corners`` and ``other_corners`` of an element; ``symmetric``,
            for pairs of one tree, each found once; ``ordered``, for the smaller number first, else that of the packet;
            ``at_end``, for boxes at the end; ``queued`` and ``filtered``, the indices of these counts.
    """

    @wp.func_native(definitions({}, **constants) + header(__file__, "lanes.h", "append.h", "pair_packet.h"))
    def pair_packet(
        packet: int,
        tree: WideBvh,
        traversed: WideBvh,
        pair_filter: PairFilter,
        keep_separated: int,
        # out
        counts: wp.array[wp.int64],
        filtered_of_worlds: wp.array[wp.int64],
        pairs: wp.array[wp.vec2i],
    ): ...

    return pair_packet


@functools.cache
def fit_packet_of(dtype: type) -> wp.Function:
    """Returns the function that fits the boxes of a packet to a motion, for one type of position, vec3 or vec3d.

    It is a device function for the CPU. Its arguments are the packet, the number of its elements, the positions at both
    ends, the mark of each vertex or None for 1, how far boxes reach beyond each vertex or None, and the tree. It writes
    the boxes, the packet's entry in its node, and the marks of the elements. Boxes are rounded as by
    :func:`~warp_bsc.kernels.boxes.rounded`. That of an element with a position that is not finite is empty. Indices are
    not checked.
    """
    scalar = definitions({"Scalar": "float" if dtype is wp.vec3 else "double"})

    @wp.func_native(scalar + header(__file__, "lanes.h", "positions.h", "fit_packet.h"))
    def fit_packet(
        packet: int,
        count: int,
        # in
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        changed: wp.array[int],
        padding: wp.array[wp.float64],
        # in and out
        tree: WideBvh,
    ): ...

    return fit_packet
