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
    return __ballot_sync(0xffffffffu, flag != 0) != 0;
#else
    return flag != 0;
#endif
"""
)
def _any_of_warp(flag: int) -> int:
    """Returns whether any thread of a warp has a flag, as 0 or 1; on the CPU whether the thread has."""
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


@wp.struct
class HierarchyLevel:
    """The nodes of one level: faces by place, clusters or bundles.

    Attributes:
        boxes: Box of each node, shape [n, 4], with lowest coordinates higher than the highest where there is no face.
        changed: Nonzero where a face has pairs that are sought.
        first_world: Lowest world of the faces below; no array if all faces are in one world.
        last_world: Highest world of the faces below.
    """

    boxes: wp.array2d[wp.vec3]
    changed: wp.array[int]
    first_world: wp.array[int]
    last_world: wp.array[int]


@wp.func
def fit_parent(child: int, box: BoxRows, changed: int, parents: HierarchyLevel):
    """Writes the box of the parent of a child, from the boxes of all 32 children, one a thread."""
    low0 = _min_of_warp(box[0])
    high0 = -_min_of_warp(-box[1])
    low1 = _min_of_warp(box[2])
    high1 = -_min_of_warp(-box[3])
    any_changed = _any_of_warp(changed)
    parent = child / WIDTH
    if child % WIDTH != 0:
        if child_step() != 1:
            return
        before = read_box(parents.boxes, parent)
        low0 = wp.min(low0, before[0])
        high0 = wp.max(high0, before[1])
        low1 = wp.min(low1, before[2])
        high1 = wp.max(high1, before[3])
        any_changed = any_changed | parents.changed[parent]
    write_box(wp.matrix_from_rows(low0, high0, low1, high1), parents.boxes, parent)
    parents.changed[parent] = any_changed


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

    Nodes in other worlds are left out, as are nodes without a change if the cluster has none.
    """
    found = wp.uint32(0)
    changed = clusters.changed[cluster]
    count = wp.min(WIDTH, level.boxes.shape[0] - first)
    for child in range(first_child(), count, child_step()):
        node = first + child
        if not are_apart(box, read_box(level.boxes, node)):
            if (changed | level.changed[node]) != 0 and same_world(clusters, cluster, level, node):
                found = found | (wp.uint32(1) << wp.uint32(child))
    return union_of_warp(found)


@wp.func
def changed_children(level: HierarchyLevel, first: int):
    """Returns which of 32 nodes of a level, from the first on, have changed, as bits."""
    found = wp.uint32(0)
    count = wp.min(WIDTH, level.boxes.shape[0] - first)
    for child in range(first_child(), count, child_step()):
        if level.changed[first + child] != 0:
            found = found | (wp.uint32(1) << wp.uint32(child))
    return union_of_warp(found)


@wp.func
def bits_from(first: int):
    """Returns the bits from one on, in [0, 31]."""
    return ~((wp.uint32(1) << wp.uint32(first)) - wp.uint32(1))


@wp.func
def unseparated_faces(
    faces: HierarchyLevel, place: int, box: BoxRows, first: int, candidates: wp.uint32, changed: wp.uint32
):
    """Returns which faces of a cluster no axis separates from a face at a place, as bits, each pair of faces once.

    Args:
        faces: The level of faces.
        place: Place of the face.
        box: Its box.
        first: First place of the cluster, which is that of the face or a later one.
        candidates: Places of the cluster to test, the same for all threads of a warp.
        changed: Places of the cluster whose faces have changed.
    """
    sought = candidates
    if faces.changed[place] == 0:
        sought = sought & changed
    if first <= place:
        own = wp.uint32(1) << wp.uint32(place - first)
        sought = sought & ~(own | (own - wp.uint32(1)))
    found = wp.uint32(0)
    left = candidates
    while left != wp.uint32(0):
        bit = left & (~left + wp.uint32(1))
        left = left ^ bit
        other = first + lowest_set_bit(bit)
        if not are_apart(box, read_box(faces.boxes, other)):
            if (sought & bit) != wp.uint32(0) and same_world(faces, place, faces, other):
                found = found | bit
    return found
