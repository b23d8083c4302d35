"""A hierarchy of boxes over faces in a fixed order: faces, clusters of 32 places, and bundles of 32 clusters.

On a GPU the threads of a warp work on a cluster together: each has one of its faces, and tests one child of a node. All
threads of a warp must therefore call the functions below together. On the CPU, threads run one after the other, in
order, and each tests all children.
"""

import warp as wp

from ..boxes import BoxRows, boxes_apart, read_box, write_box

WIDTH = wp.constant(32)
"""Children of a node, and threads of a warp."""


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    return threadIdx.x & 31;
#else
    return 0;
#endif
"""
)
def first_child() -> int:
    """Returns the first child that a thread tests: 0 on the CPU, where it tests all, else the number of the thread."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    return 32;
#else
    return 1;
#endif
"""
)
def child_step() -> int:
    """Returns the step to the next child that a thread tests."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    return __ballot_sync(0xffffffffu, found != 0);
#else
    return found;
#endif
"""
)
def union_of_warp(found: wp.uint32) -> wp.uint32:
    """Returns the children that the threads of a warp have found, as bits, from those that each has tested."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    for (int step = 16; step > 0; step /= 2)
        for (int axis = 0; axis < 3; ++axis)
            x[axis] = fminf(x[axis], __shfl_xor_sync(0xffffffffu, x[axis], step));
#endif
    return x;
"""
)
def _min_of_warp(x: wp.vec3) -> wp.vec3:
    """Returns the smallest coordinates of the threads of a warp; those of the thread on the CPU."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    return (__ballot_sync(0xffffffffu, flags & 1) != 0) | (__ballot_sync(0xffffffffu, flags & 2) != 0) << 1;
#else
    return flags;
#endif
"""
)
def _flags_of_warp(flags: int) -> int:
    """Returns the two flags that any thread of a warp has; on the CPU those of the thread."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
"""
)
def lowest_set_bit(bits: wp.uint32) -> int:
    """Returns the number of the lowest bit that is set; there must be one."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    return __popc(bits);
#else
    return __builtin_popcount(bits);
#endif
"""
)
def count_set_bits(bits: wp.uint32) -> int:
    """Returns the number of bits that are set."""
    ...


_ABOVE = wp.constant(wp.uint32((1 << 9) | (1 << 19) | (1 << 29)))
"""The bits above three coordinates of 9 bits."""
SOUGHT = wp.constant(3)
"""The flags of two faces together whose pair is sought: one has changed, 1, and one is paired with all others, 2."""
NOWHERE = wp.constant(wp.uint32(511 | (511 << 10) | (511 << 20)))
"""Each row of the coded box of nothing, which is apart from all."""


@wp.struct
class HierarchyLevel:
    """The nodes of one level: faces by place, which have coded boxes, or clusters or bundles, with boxes and flags."""

    boxes: wp.array2d[wp.vec3]  # of each node, shape [n, 4]; the lowest coordinates are the higher ones without a face
    flags: wp.array[int]  # those that a face below has, see SOUGHT
    coded: wp.array2d[wp.uint32]  # box of each face in that of its cluster, see coded_box, shape [n, 4]
    first_world: wp.array[int]  # lowest world of the faces below; no array if all faces are in one world
    last_world: wp.array[int]  # highest world of the faces below


@wp.func
def write_node(level: HierarchyLevel, node: int, box: BoxRows, flags: int):
    """Writes a node, from what the threads of a warp know of its children, and returns its box."""
    low0 = _min_of_warp(box[0])
    high0 = -_min_of_warp(-box[1])
    low1 = _min_of_warp(box[2])
    high1 = -_min_of_warp(-box[3])
    of_node = wp.matrix_from_rows(low0, high0, low1, high1)
    of_any = _flags_of_warp(flags)
    if first_child() == 0:
        write_box(of_node, level.boxes, node)
        level.flags[node] = of_any
    return of_node


@wp.func_native(
    snippet="""
    wp::vec_t<4, wp::uint32> coded;
    for (int row = 0; row < 4; ++row) {
        wp::uint32 word = 0;
        for (int axis = 0; axis < 3; ++axis) {
            const float low = node.data[row & 2][axis], extent = node.data[row | 1][axis] - low;
#if defined(__CUDA_ARCH__)
            float scale = __fdividef(508.0f, extent);
#else
            float scale = 508.0f / extent;
#endif
            const float steps = (box.data[row][axis] - low) * wp::min(wp::max(scale, 1.0e-38f), 3.0e38f);
            word |= (wp::uint32)(wp::min(wp::max(steps, -1.0f), 509.0f) + 1.0f) << 10 * axis;
        }
        coded[row] = word;
    }
    return coded;
"""
)
def coded_box(box: BoxRows, node: BoxRows) -> wp.vec4ui:
    """Returns a box in that of a node: each coordinate in 9 bits, with a free one above them, a row in one number.

    Coordinates become numbers in [0, 510] by one function, which keeps their order, however it is rounded: where two of
    them differ, in this order, so do the coordinates.
    """
    ...


@wp.func
def _are_less(a: wp.uint32, b: wp.uint32) -> wp.uint32:
    """Returns which of three coordinates are less than others, as bits above them; two more bits may be anything."""
    return ~((a | _ABOVE) - b) & _ABOVE


@wp.func
def codes_apart(a: wp.vec4ui, b: wp.vec4ui) -> bool:
    """Returns whether an axis separates two boxes as :func:`are_apart` does, if that shows in the box of a node."""
    below = _are_less(a[1], b[0]) & _are_less(a[3], b[2])
    above = _are_less(b[1], a[0]) & _are_less(b[3], a[2])
    return (below | above) != wp.uint32(0)


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    for (int row = 0; row < 4; ++row)
        coded[row] = __shfl_sync(0xffffffffu, coded[row], child);
#endif
    return coded;
"""
)
def code_of_child(coded: wp.vec4ui, child: int) -> wp.vec4ui:
    """Returns what the thread of a child has; on the CPU what this thread has."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    const uint4 row = reinterpret_cast<const uint4*>(rows.data)[i];
    return wp::vec_t<4, wp::uint32>(row.x, row.y, row.z, row.w);
#else
    const wp::uint32* row = rows.data + 4 * (size_t)i;
    return wp::vec_t<4, wp::uint32>(row[0], row[1], row[2], row[3]);
#endif
"""
)
def read_coded(rows: wp.array2d[wp.uint32], i: int) -> wp.vec4ui:
    """Returns a row of an array of coded boxes, which is contiguous and begins at a multiple of 16 bytes."""
    ...


@wp.func
def are_apart(a: BoxRows, b: BoxRows) -> bool:
    """Returns whether an axis separates two boxes at the start and at the end, on one side."""
    return boxes_apart(a[0], a[1], a[2], a[3], b[0], b[1], b[2], b[3])


@wp.func
def same_world(level: HierarchyLevel, i: int, other_level: HierarchyLevel, j: int):
    """Returns whether two nodes may have faces in one world."""
    if not level.first_world:
        return True
    return level.first_world[i] <= other_level.last_world[j] and other_level.first_world[j] <= level.last_world[i]


@wp.func
def unseparated_children(clusters: HierarchyLevel, cluster: int, box: BoxRows, level: HierarchyLevel, first: int):
    """Returns which of 32 nodes of a level, from the first on, no axis separates from a cluster with a box, as bits.

    Nodes in other worlds are left out, as are nodes with no face whose pairs with those of the cluster are sought.
    """
    found = wp.uint32(0)
    count = wp.min(WIDTH, level.boxes.shape[0] - first)
    for child in range(first_child(), count, child_step()):
        node = first + child
        if not are_apart(box, read_box(level.boxes, node)):
            if (clusters.flags[cluster] | level.flags[node]) == SOUGHT and same_world(clusters, cluster, level, node):
                found = found | (wp.uint32(1) << wp.uint32(child))
    return union_of_warp(found)


@wp.func
def bits_from(first: int):
    """Returns the bits from one on, in [0, 31]."""
    return ~((wp.uint32(1) << wp.uint32(first)) - wp.uint32(1))


@wp.func
def completing(flags: int, changed: wp.uint32, paired: wp.uint32) -> wp.uint32:
    """Returns which children have the flags that are missing, as bits, given which have changed and are paired."""
    return wp.where(flags & 1 != 0, ~wp.uint32(0), changed) & wp.where(flags & 2 != 0, ~wp.uint32(0), paired)
