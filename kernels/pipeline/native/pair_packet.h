// The body of pair_packet.

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
        other_low[axis] = at_end ? other_low1[axis] : __builtin_elementwise_min(other_low0[axis], other_low1[axis]);
        other_high[axis] = at_end ? other_high1[axis] : __builtin_elementwise_max(other_high0[axis], other_high1[axis]);
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
struct {
    int level, node;
} stack[88];
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
