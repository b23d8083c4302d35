"""A wide BVH for the CPU: packets of eight boxes, compared with SIMD instructions.

Elements sorted along a space-filling curve are cut into packets of eight. Eight packets have a node, eight nodes have
one of the next level, up to one root: a tree whose links are arithmetic. The same coordinate of all eight lies side by
side, so that one box is compared with eight at once.

- ``boxes``, float32, 96 a packet: for each axis the lowest and the highest coordinate at the start, then at the end.
- ``elements``, int32, 48 a packet: the numbers of the elements, three corners each, their worlds, and their marks: 0
  of what has not changed, more than 1 of what is of a rigid body, by body.
- ``nodes``, float32, 48 a node: for each axis the lowest and the highest coordinate of the children, at any time.
- ``node_marks``, int32, 24 a node: the first and the last world of the children, and whether elements below them have
  changed.

Missing elements and children have empty boxes, which overlap none.
"""

import functools

import warp as wp


@wp.func_native(
    snippet="""
    typedef float Floats __attribute__((ext_vector_type(8), aligned(4)));
    typedef int Ints __attribute__((ext_vector_type(8), aligned(4)));
    typedef bool Bools __attribute__((ext_vector_type(8)));

    auto floats = [](const float* at) { return *(const Floats*)at; };
    auto ints = [](const int* at) { return *(const Ints*)at; };
    auto bits = [](Ints mask) -> unsigned {
        return __builtin_bit_cast(unsigned char, __builtin_convertvector(mask, Bools));
    };
    auto lowest = [](float a, float b) { return a < b ? a : b; };
    auto highest = [](float a, float b) { return a > b ? a : b; };

    const float* box = boxes.data + 96 * (size_t)packet;
    const int* element = elements.data + 48 * (size_t)packet;

    // the packet's own box, over all of the time, and its worlds, sorted as they are
    Floats lows[3], highs[3];
    float low[3], high[3], lane_lows[3][8], lane_highs[3][8];
    for (int axis = 0; axis < 3; ++axis) {
        const float* at = box + 32 * axis;
        lows[axis] = at_end ? floats(at + 16) : __builtin_elementwise_min(floats(at), floats(at + 16));
        highs[axis] = at_end ? floats(at + 24) : __builtin_elementwise_max(floats(at + 8), floats(at + 24));
        low[axis] = lows[axis][0];
        high[axis] = highs[axis][0];
        for (int lane = 1; lane < 8; ++lane) {
            low[axis] = lowest(low[axis], lows[axis][lane]);
            high[axis] = highest(high[axis], highs[axis][lane]);
        }
        // a copy in memory: to take a lane whose number is not constant from a register stores all of it each time
        __builtin_memcpy(lane_lows[axis], &lows[axis], sizeof(lane_lows[axis]));
        __builtin_memcpy(lane_highs[axis], &highs[axis], sizeof(lane_highs[axis]));
    }
    int first_world = element[32], last_world = element[32];
    for (int lane = 1; lane < 8; ++lane)
        last_world = element[32 + lane] > last_world ? element[32 + lane] : last_world;

    const int capacity = pairs.shape[0];
    constexpr int buffered = 512;
    int found[2 * buffered];
    int count = 0;
    wp::int64 filtered = 0;
    auto flush = [&]() {
        const wp::int64 slot = __atomic_fetch_add(&counts.data[queued_count], (wp::int64)count, __ATOMIC_RELAXED);
        for (int i = 0; i < count && slot + i < capacity; ++i) {
            int* at = (int*)pairs.data + 2 * (size_t)(slot + i);
            at[0] = found[2 * i];
            at[1] = found[2 * i + 1];
        }
        count = 0;
    };

    // whether each corner of one element meets each corner of the other
    auto meet = [&](const int* at, const int* other_at) -> bool {
        for (int i = 0; i < corners; ++i)
            for (int j = 0; j < other_corners; ++j) {
                const int a = at[8 * i], b = other_at[8 * j];
                if (!(group.data[a] & group_mask.data[b]) || !(group.data[b] & group_mask.data[a]))
                    return false;
            }
        return true;
    };

    const unsigned changed = bits(ints(element + 40) != 0);
    auto compare = [&](int other, unsigned lanes) {
        const float* other_box = other_boxes.data + 96 * (size_t)other;
        const int* other_element = other_elements.data + 48 * (size_t)other;
        const unsigned other_changed = bits(ints(other_element + 40) != 0);
        if (!other_changed)
            lanes &= changed;
        if (!lanes)
            return;
        Floats other_low0[3], other_high0[3], other_low1[3], other_high1[3], other_low[3], other_high[3];
        for (int axis = 0; axis < 3; ++axis) {
            const float* at = other_box + 32 * axis;
            other_low0[axis] = floats(at);
            other_high0[axis] = floats(at + 8);
            other_low1[axis] = floats(at + 16);
            other_high1[axis] = floats(at + 24);
            other_low[axis] =
                at_end ? other_low1[axis] : __builtin_elementwise_min(other_low0[axis], other_low1[axis]);
            other_high[axis] =
                at_end ? other_high1[axis] : __builtin_elementwise_max(other_high0[axis], other_high1[axis]);
        }
        for (; lanes; lanes &= lanes - 1) {
            const int lane = __builtin_ctz(lanes);
            Ints overlap = ints(other_element + 32) == element[32 + lane];
            const int mark = element[40 + lane];
            if (mark > 1)
                overlap &= ints(other_element + 40) != mark;
            for (int axis = 0; axis < 3; ++axis)
                overlap &= (other_low[axis] <= lane_highs[axis][lane]) & (other_high[axis] >= lane_lows[axis][lane]);
            unsigned mask = bits(overlap);
            if (!mark)
                mask &= other_changed;
            if (symmetric && other == packet)
                mask &= ~((2u << lane) - 1u);
            if (!mask)
                continue;
            Ints shared = 0;
            for (int i = 0; i < corners; ++i)
                for (int j = 0; j < other_corners; ++j)
                    shared |= ints(other_element + 8 + 8 * j) == element[8 + 8 * i + lane];
            mask &= ~bits(shared);
            if (!mask)
                continue;
            if (!keep_separated && !at_end) {
                Ints apart = 0;
                for (int axis = 0; axis < 3; ++axis) {
                    const float* at = box + 32 * axis + lane;
                    apart |= (other_low0[axis] > at[8]) & (other_low1[axis] > at[24]);
                    apart |= (other_high0[axis] < at[0]) & (other_high1[axis] < at[16]);
                }
                mask &= ~bits(apart);
                if (!mask)
                    continue;
            }
            if (group.data) {
                unsigned left_out = 0;
                for (unsigned rest = mask; rest; rest &= rest - 1) {
                    const int other_lane = __builtin_ctz(rest);
                    left_out |= (unsigned)!meet(element + 8 + lane, other_element + 8 + other_lane) << other_lane;
                }
                filtered += __builtin_popcount(left_out);
                if (filtered_of_worlds.data && left_out)
                    __atomic_fetch_add(&filtered_of_worlds.data[element[32 + lane]],
                                       (wp::int64)__builtin_popcount(left_out), __ATOMIC_RELAXED);
                mask &= ~left_out;
                if (!mask)
                    continue;
            }
            if (count > buffered - 8)
                flush();
            for (; mask; mask &= mask - 1) {
                const int a = element[lane], b = other_element[__builtin_ctz(mask)];
                found[2 * count] = ordered && b < a ? b : a;
                found[2 * count + 1] = ordered && b < a ? a : b;
                ++count;
            }
        }
    };

    // at most seven nodes wait on each of at most eleven levels
    struct { int level, node; } stack[88];
    int height = 0;
    stack[height++] = {level_starts.shape[0] - 2, 0};
    while (height > 0) {
        const int level = stack[--height].level, node = stack[height].node;
        const float* child = other_nodes.data + 48 * (size_t)(level_starts.data[level] + node);
        const int* child_marks = other_node_marks.data + 24 * (size_t)(level_starts.data[level] + node);
        Ints overlap = (ints(child_marks) <= last_world) & (ints(child_marks + 8) >= first_world);
        if (!changed)
            overlap &= ints(child_marks + 16) != 0;
        for (int axis = 0; axis < 3; ++axis)
            overlap &= (floats(child + 16 * axis) <= high[axis]) & (floats(child + 16 * axis + 8) >= low[axis]);
        for (unsigned mask = bits(overlap); mask; mask &= mask - 1) {
            const int lane = __builtin_ctz(mask);
            const wp::int64 index = 8 * (wp::int64)node + lane;
            // each pair of packets once: the packets below one are those from 8^level times its index on
            if (symmetric && ((index + 1) << (3 * level)) <= packet)
                continue;
            if (level > 0) {
                stack[height++] = {level - 1, (int)index};
                continue;
            }
            Ints near_child = -1;
            for (int axis = 0; axis < 3; ++axis)
                near_child &= (lows[axis] <= child[16 * axis + 8 + lane]) & (highs[axis] >= child[16 * axis + lane]);
            compare((int)index, bits(near_child));
        }
    }
    if (count)
        flush();
    if (filtered)
        __atomic_fetch_add(&counts.data[filtered_count], filtered, __ATOMIC_RELAXED);
"""
)
def pair_packet(
    packet: int,
    # tree of the packet
    boxes: wp.array[wp.float32],
    elements: wp.array[wp.int32],
    corners: int,
    # tree that is traversed
    other_boxes: wp.array[wp.float32],
    other_elements: wp.array[wp.int32],
    other_corners: int,
    other_nodes: wp.array[wp.float32],
    other_node_marks: wp.array[wp.int32],
    level_starts: wp.array[wp.int32],
    # filter
    group: wp.array[wp.int32],
    group_mask: wp.array[wp.int32],
    # options
    symmetric: int,
    ordered: int,
    keep_separated: int,
    at_end: int,
    # in and out
    counts: wp.array[wp.int64],
    filtered_of_worlds: wp.array[wp.int64],
    # indices of counts
    queued_count: int,
    filtered_count: int,
    # out
    pairs: wp.array[wp.vec2i],
):
    """Enqueues the pairs of a packet's elements with those of a tree that share no corner, and whose boxes overlap.

    Those are the swept boxes, unless an axis separates the two at the start and at the end, on the same side; with
    ``keep_separated`` such pairs are enqueued as well. With ``at_end`` they are the boxes at the end. Pairs without a
    changed element are excluded, and those within a rigid body, by marks. With ``symmetric`` both are of one tree, and
    each pair is found once. With ``ordered`` the smaller number comes first, else that of the packet. With groups, the
    pairs that a :class:`.pairs.PairFilter` leaves out are counted, by world as well if there is an array for that, and
    are not enqueued.
    """
    ...


_FIT_SNIPPET = """
    typedef {scalar} Four __attribute__((ext_vector_type(4)));
    typedef {scalar} Loaded __attribute__((ext_vector_type(4), aligned(sizeof({scalar}))));
    typedef double Doubles __attribute__((ext_vector_type(4)));

    const {scalar} infinity = __builtin_inf();
    const int* element = elements.data + 48 * (size_t)packet;
    float* box = boxes.data + 96 * (size_t)packet;
    float* node = nodes.data + 48 * (size_t)(packet / 8) + packet % 8;
    int* marks = node_marks.data + 24 * (size_t)(packet / 8) + packet % 8;

    // positions may be a view, with any stride; a fourth number is read with them where there is one
    auto load = [&](const auto& x, int corner) -> Four {{
        const {scalar}* from = (const {scalar}*)((const char*)x.data + x.strides[0] * (wp::int64)corner);
        if (corner + 1 < x.shape[0] && x.strides[0] >= 3 * (int)sizeof({scalar}))
            return *(const Loaded*)from;
        return Four{{from[0], from[1], from[2], 0}};
    }};
    // to single precision, to nearest: rounding and clamping keep order
    auto rounded = [](Four x, double pad) {{
        const Doubles largest = 3.4028234663852886e38;
        const Doubles moved = __builtin_convertvector(x, Doubles) + pad;
        const Doubles clamped = __builtin_elementwise_max(__builtin_elementwise_min(moved, largest), -largest);
        return __builtin_convertvector(clamped, float __attribute__((ext_vector_type(4))));
    }};

    float rows[12][8];
    for (int row = 0; row < 12; ++row)
        for (int lane = 0; lane < 8; ++lane)
            rows[row][lane] = row % 2 ? -__builtin_inff() : __builtin_inff();
    int lane_marks[8] = {{}}, any_changed = 0;
    for (int lane = 0; lane < count; ++lane) {{
        Four low0 = infinity, high0 = -infinity, low1 = infinity, high1 = -infinity;
        auto finite = low0 == low0;
        double pad = 0.0;
        int mark = !changed.data;
        for (int i = 0; i < corners; ++i) {{
            const int corner = element[8 + 8 * i + lane];
            const Four start = load(x0, corner), end = load(x1, corner);
            finite &= (__builtin_elementwise_abs(start) < infinity) & (__builtin_elementwise_abs(end) < infinity);
            low0 = __builtin_elementwise_min(low0, start);
            high0 = __builtin_elementwise_max(high0, start);
            low1 = __builtin_elementwise_min(low1, end);
            high1 = __builtin_elementwise_max(high1, end);
            if (padding.data)
                pad = padding.data[corner] > pad ? padding.data[corner] : pad;
            if (changed.data)
                mark = changed.data[corner] > mark ? changed.data[corner] : mark;
        }}
        lane_marks[lane] = mark;
        any_changed |= mark != 0;
        if (!(finite[0] && finite[1] && finite[2]))
            continue;  // an empty box overlaps none
        const auto a = rounded(low0, -pad), b = rounded(high0, pad), c = rounded(low1, -pad), d = rounded(high1, pad);
        for (int axis = 0; axis < 3; ++axis) {{
            rows[4 * axis][lane] = a[axis];
            rows[4 * axis + 1][lane] = b[axis];
            rows[4 * axis + 2][lane] = c[axis];
            rows[4 * axis + 3][lane] = d[axis];
        }}
    }}
    for (int axis = 0; axis < 3; ++axis) {{
        float low = __builtin_inff(), high = -__builtin_inff();
        for (int lane = 0; lane < 8; ++lane)
            for (int row = 4 * axis; row < 4 * axis + 4; row += 2) {{
                low = rows[row][lane] < low ? rows[row][lane] : low;
                high = rows[row + 1][lane] > high ? rows[row + 1][lane] : high;
            }}
        node[16 * axis] = low;
        node[16 * axis + 8] = high;
    }}
    __builtin_memcpy(box, rows, sizeof(rows));
    __builtin_memcpy(elements.data + 48 * (size_t)packet + 40, lane_marks, sizeof(lane_marks));
    marks[16] = any_changed;
"""


@functools.cache
def fit_packet_of(dtype: type) -> wp.Function:
    """Returns the function that fits the boxes of a packet to a motion, for one type of position.

    Args:
        dtype: Type of a position, vec3 or vec3d.

    Returns:
        Device function for the CPU. Its arguments are the packet, the number of its elements, the positions at both
        ends, the number of corners of an element, the mark of each vertex or None for 1, how far boxes reach
        beyond each vertex or None, and the elements. It writes the boxes, the packet's entry in its node, and the
        marks of the elements. Boxes are rounded as by :func:`~warp_bsc.kernels.boxes.rounded`. That of an
        element with a position that is not finite is empty. Indices are not checked.
    """
    snippet = _FIT_SNIPPET.format(scalar="float" if dtype is wp.vec3 else "double")

    @wp.func_native(snippet)
    def fit_packet(
        packet: int,
        count: int,
        # in
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        corners: int,
        changed: wp.array[int],
        padding: wp.array[wp.float64],
        # in and out
        elements: wp.array[int],
        # out
        boxes: wp.array[wp.float32],
        nodes: wp.array[wp.float32],
        node_marks: wp.array[int],
    ): ...

    return fit_packet
