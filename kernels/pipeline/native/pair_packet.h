// The body of pair_packet.

typedef float Floats __attribute__((ext_vector_type(8), aligned(4)));
typedef int Ints __attribute__((ext_vector_type(8), aligned(4)));
typedef bool Bools __attribute__((ext_vector_type(8)));

auto floats = [](const float* at) { return *(const Floats*)at; };
auto ints = [](const int* at) { return *(const Ints*)at; };
auto bits = [](Ints mask) -> unsigned {
    return __builtin_bit_cast(unsigned char, __builtin_convertvector(mask, Bools));
};

const float* box = boxes.data + 96 * (size_t)packet;
const int* element = elements.data + 48 * (size_t)packet;

// the packet's boxes, with keep_separated those over all of the time for each end, and the box around them
float own[96], whole[96];
#pragma unroll
for (int row = 0; row < 12; ++row) {
    auto outer = [&](Floats a, Floats b) {
        return row % 2 ? __builtin_elementwise_max(a, b) : __builtin_elementwise_min(a, b);
    };
    Floats rows = floats(box + 8 * row);
    if (keep_separated && !at_end)
        rows = outer(rows, floats(box + 8 * (row ^ 2)));
    *(Floats*)(own + 8 * row) = rows;
    rows = outer(rows, __builtin_shufflevector(rows, rows, 4, 5, 6, 7, 0, 1, 2, 3));
    rows = outer(rows, __builtin_shufflevector(rows, rows, 2, 3, 0, 1, 6, 7, 4, 5));
    whole[8 * row] = outer(rows, __builtin_shufflevector(rows, rows, 1, 0, 3, 2, 5, 4, 7, 6))[0];
}

// which of the eight boxes in rows no axis separates at both ends from one, a lane of eight others
const int start = at_end ? 16 : 0;
auto meeting = [&](const float* eight, const float* one) -> Ints {
    Ints apart = 0;
#pragma unroll
    for (int i = 0; i < 96; i += 32) {
        apart |= (floats(eight + i + start) > one[i + start + 8]) & (floats(eight + i + 16) > one[i + 24]);
        apart |= (floats(eight + i + start + 8) < one[i + start]) & (floats(eight + i + 24) < one[i + 16]);
    }
    return ~apart;
};

// its worlds, sorted as they are
int first_world = element[32], last_world = element[32];
for (int lane = 1; lane < 8; ++lane)
    last_world = element[32 + lane] > last_world ? element[32 + lane] : last_world;

const int capacity = pairs.shape[0];
constexpr int buffered = 512;
int firsts[buffered], seconds[buffered];
int count = 0;
wp::int64 filtered = 0;
auto flush = [&]() {
    const wp::int64 slot = __atomic_fetch_add(&counts.data[queued_count], (wp::int64)count, __ATOMIC_RELAXED);
    for (int i = 0; i < count && slot + i < capacity; ++i) {
        int* at = (int*)pairs.data + 2 * (size_t)(slot + i);
        at[0] = firsts[i];
        at[1] = seconds[i];
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
    for (; lanes; lanes &= lanes - 1) {
        const int lane = __builtin_ctz(lanes), mark = element[40 + lane];
        Ints met = meeting(other_box, own + lane) & (ints(other_element + 32) == element[32 + lane]);
        if (mark > 1)
            met &= ints(other_element + 40) != mark;
        for (int i = 0; i < corners; ++i)
            for (int j = 0; j < other_corners; ++j)
                met &= ints(other_element + 8 + 8 * j) != element[8 + 8 * i + lane];
        unsigned mask = bits(met);
        if (!mark)
            mask &= other_changed;
        if (symmetric && other == packet)
            mask &= ~((2u << lane) - 1u);
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
        const Ints a = element[lane], b = ints(other_element);
        const Ints smaller = ordered ? __builtin_elementwise_min(a, b) : a;
        const Ints larger = ordered ? __builtin_elementwise_max(a, b) : b;
#ifdef __AVX512VL__  // without a branch, as how many pairs there are is hard to predict
        *(Ints*)(firsts + count) = __builtin_ia32_compresssi256_mask(smaller, smaller, mask);
        *(Ints*)(seconds + count) = __builtin_ia32_compresssi256_mask(larger, larger, mask);
        count += __builtin_popcount(mask);
#else
        for (; mask; mask &= mask - 1, ++count) {
            firsts[count] = smaller[__builtin_ctz(mask)];
            seconds[count] = larger[__builtin_ctz(mask)];
        }
#endif
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
    const float* child = other_nodes.data + 96 * (size_t)(level_starts.data[level] + node);
    const int* child_marks = other_node_marks.data + 24 * (size_t)(level_starts.data[level] + node);
    Ints overlap = (ints(child_marks) <= last_world) & (ints(child_marks + 8) >= first_world);
    if (!changed)
        overlap &= ints(child_marks + 16) != 0;
    overlap &= meeting(child, whole);
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
        compare((int)index, bits(meeting(own, child + lane)));
    }
}
if (count)
    flush();
if (filtered)
    __atomic_fetch_add(&counts.data[filtered_count], filtered, __ATOMIC_RELAXED);
