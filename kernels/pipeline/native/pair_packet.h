// The body of pair_packet; after append.h.

typedef float Floats __attribute__((ext_vector_type(8), aligned(4)));
typedef int Ints __attribute__((ext_vector_type(8), aligned(4)));
typedef long long Longs __attribute__((ext_vector_type(8), aligned(8)));
typedef bool Bools __attribute__((ext_vector_type(8)));

auto floats = [](const float* at) { return *(const Floats*)at; };
auto ints = [](const int* at) { return *(const Ints*)at; };
auto bits = [](Ints mask) -> unsigned {
    return __builtin_bit_cast(unsigned char, __builtin_convertvector(mask, Bools));
};

const float* box = tree.boxes.data + 96 * (size_t)packet;
const int* element = tree.elements.data + 48 * (size_t)packet;

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

// which of the eight boxes in rows no axis separates at both ends from one, a lane of eight others; by the signs of
// differences, which take half as long as comparisons: they are exact, as no highest coordinate is -0
const int start = at_end ? 16 : 0;
auto meeting = [&](const float* eight, const float* one) -> Ints {
    auto below = [](Floats high, Floats low) { return __builtin_bit_cast(Ints, high - low); };
    Ints apart = 0;
#pragma unroll
    for (int i = 0; i < 96; i += 32) {
        const int j = i + start;
        apart |= below(one[j + 8], floats(eight + j)) & below(one[i + 24], floats(eight + i + 16));
        apart |= below(floats(eight + j + 8), one[j]) & below(floats(eight + i + 24), one[i + 16]);
    }
    return apart >= 0;
};

// its worlds, sorted as they are
int first_world = element[32], last_world = element[32];
for (int lane = 1; lane < 8; ++lane)
    last_world = element[32 + lane] > last_world ? element[32 + lane] : last_world;

constexpr int buffered = 512;
wp::int64 found[buffered], filtered = 0;
int count = 0;
auto flush = [&]() {
    const wp::int64 slot = __atomic_fetch_add(&counts.data[queued_count], (wp::int64)count, __ATOMIC_RELAXED);
    const wp::int64 room = pairs.shape[0] - slot;
    if (room > 0)
        __builtin_memcpy(pairs.data + slot, found, sizeof(*found) * (room < count ? room : count));
    count = 0;
};

// whether each corner of one element meets each corner of the other
auto meet = [&](const int* at, const int* other_at) -> bool {
    for (int i = 0; i < tree.corners; ++i)
        for (int j = 0; j < traversed.corners; ++j) {
            const int a = at[8 * i], b = other_at[8 * j];
            if (!(pair_filter.group.data[a] & pair_filter.mask.data[b]) ||
                !(pair_filter.group.data[b] & pair_filter.mask.data[a]))
                return false;
        }
    return true;
};

// the mark of another element with which each makes no pair: 0 with 0, that of a rigid body with itself
const Ints marks = ints(element + 40), excluded = marks == 1 ? -1 : marks;
const bool changed = bits(marks != 0);
const Ints lanes = {0, 1, 2, 3, 4, 5, 6, 7};

// Packets that are near wait until there are many, and so do their elements that are near. Loops over these are long,
// so that the processor predicts their ends, and begins with the next one before it has finished the last.
constexpr int most_near = 64;
int near[most_near + 8], near_count = 0;
auto compare = [&]() {
    int others[8 * most_near + 8], other_count = 0;
    for (int i = 0; i < near_count; ++i) {
        unsigned meets = bits(meeting(traversed.boxes.data + 96 * (size_t)near[i], whole));
        if (!changed)
            meets &= bits(ints(traversed.elements.data + 48 * (size_t)near[i] + 40) != 0);
        other_count += append(others + other_count, 8 * near[i] + lanes, meets);
    }
    near_count = 0;
    for (int i = 0; i < other_count; ++i) {
        const int other = others[i] / 8, lane = others[i] % 8;
        const int* other_element = traversed.elements.data + 48 * (size_t)other + lane;
        Ints met = meeting(own, traversed.boxes.data + 96 * (size_t)other + lane);
        met &= (ints(element + 32) == other_element[32]) & (excluded != other_element[40]);
        for (int i = 0; i < tree.corners; ++i)
            for (int j = 0; j < traversed.corners; ++j)
                met &= ints(element + 8 + 8 * i) != other_element[8 + 8 * j];
        unsigned mask = bits(met);
        if (symmetric && other == packet)
            mask &= (1u << lane) - 1u;
        if (pair_filter.group.data) {
            unsigned left_out = 0;
            for (unsigned rest = mask; rest; rest &= rest - 1)
                if (!meet(element + 8 + __builtin_ctz(rest), other_element + 8))
                    left_out |= rest & -rest;
            filtered += __builtin_popcount(left_out);
            if (filtered_of_worlds.data && left_out)
                __atomic_fetch_add(&filtered_of_worlds.data[other_element[32]], (wp::int64)__builtin_popcount(left_out),
                                   __ATOMIC_RELAXED);
            mask &= ~left_out;
        }
        if (count > buffered - 8)
            flush();
        const Ints a = ints(element), b = other_element[0];
        const Ints first = ordered ? __builtin_elementwise_min(a, b) : a;
        const Ints second = ordered ? __builtin_elementwise_max(a, b) : b;
        const Longs both = __builtin_convertvector(first, Longs) | (__builtin_convertvector(second, Longs) << 32);
        count += append(found + count, both, mask);
    }
};

// nodes with their levels; at most seven wait on each of at most eleven levels, and eight are added at once
int stack[96], height = 0;
stack[height++] = traversed.level_starts.shape[0] - 2;
while (height > 0) {
    const int level = stack[--height] % 16, node = stack[height] / 16;
    const float* child = traversed.nodes.data + 96 * (size_t)(traversed.level_starts.data[level] + node);
    const int* child_marks = traversed.node_marks.data + 24 * (size_t)(traversed.level_starts.data[level] + node);
    const Ints children = 8 * node + lanes;
    Ints overlap = (ints(child_marks) <= last_world) & (ints(child_marks + 8) >= first_world);
    if (!changed)
        overlap &= ints(child_marks + 16) != 0;
    if (symmetric)  // each pair of packets once: the packets below one are those from 8^level times its index on
        overlap &= children >= packet >> (3 * level);
    overlap &= meeting(child, whole);
    if (level > 0)
        height += append(stack + height, 16 * children + level - 1, bits(overlap));
    else
        near_count += append(near + near_count, children, bits(overlap));
    if (near_count > most_near - 8 || height == 0)
        compare();
}
if (count)
    flush();
if (filtered)
    __atomic_fetch_add(&counts.data[filtered_count], filtered, __ATOMIC_RELAXED);
