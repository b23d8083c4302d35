// The body of pair_packet; after lanes.h and append.h. Of constants, see pair_packet_of.

auto floats = [](const float* at) { return *(const Floats*)at; };
auto ints = [](const int* at) { return *(const Ints*)at; };

const float* box = tree.boxes.data + 96 * (size_t)packet;
const int* element = tree.elements.data + 48 * (size_t)packet;

// the packet's boxes, with keep_separated those over all of the time for each end, and the box around them
float own[96], whole[96];
#pragma unroll
for (int row = 0; row < 12; ++row) {
    Floats rows = floats(box + 8 * row);
    if (keep_separated && !at_end)
        rows = outer(row, rows, floats(box + 8 * (row ^ 2)));
    *(Floats*)(own + 8 * row) = rows;
    whole[8 * row] = outermost(row, rows);
}

// which of the eight boxes in rows no axis separates at both ends from one, a lane of eight others; by the signs of
// differences, which take half as long as comparisons: they are exact, as no highest coordinate is -0
constexpr int start = at_end ? 16 : 0;
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
const int first_world = element[32], last_world = __builtin_reduce_max(ints(element + 32));

constexpr int buffered = 512;
wp::int64 found[buffered], left_out = 0;
int count = 0;
auto flush = [&]() {
    const wp::int64 slot = __atomic_fetch_add(&counts.data[queued], (wp::int64)count, __ATOMIC_RELAXED);
    const wp::int64 room = pairs.shape[0] - slot;
    if (room > 0)
        __builtin_memcpy(pairs.data + slot, found, sizeof(*found) * (room < count ? room : count));
    count = 0;
};

// whether each corner of one element meets each corner of the other
auto meet = [&](const int* at, const int* other_at) -> bool {
    for (int i = 0; i < corners; ++i)
        for (int j = 0; j < other_corners; ++j) {
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

// Packets that are near wait until there are many, and so do their elements that are near, those whose boxes meet, and
// those that make pairs. Loops over these are long and short of branches, so that the processor begins with the next
// one before it has finished the last.
constexpr int most_near = 64;
int near[most_near + 8], near_count = 0;
auto compare = [&]() {
    int others[8 * most_near + 8], other_count = 0, met_count = 0, pair_count = 0;
    unsigned char met[8 * most_near + 8];  // the lanes that meet each of the others
    for (int i = 0; i < near_count; ++i) {
        unsigned meets = bits(meeting(traversed.boxes.data + 96 * (size_t)near[i], whole));
        if (!changed)
            meets &= bits(ints(traversed.elements.data + 48 * (size_t)near[i] + 40) != 0);
        other_count += append(others + other_count, 8 * near[i] + lanes, meets);
    }
    near_count = 0;
    for (int i = 0; i < other_count; ++i) {
        const unsigned other = others[i];
        others[met_count] = other;
        met[met_count] = bits(meeting(own, traversed.boxes.data + 96 * (size_t)(other / 8) + other % 8));
        met_count += met[met_count] != 0;
    }
    for (int i = 0; i < met_count; ++i) {
        const unsigned other = others[i], lane = other % 8;
        const int* other_element = traversed.elements.data + 48 * (size_t)(other / 8) + lane;
        Ints shared = (ints(element + 32) != other_element[32]) | (excluded == other_element[40]);
        for (int i = 0; i < corners; ++i)
            for (int j = 0; j < other_corners; ++j)
                shared |= ints(element + 8 + 8 * i) == other_element[8 + 8 * j];
        const int before = symmetric && other / 8 == packet ? (1 << lane) - 1 : 255;
        others[pair_count] = other;
        met[pair_count] = met[i] & ~bits(shared) & before;
        pair_count += met[pair_count] != 0;
    }
    for (int i = 0; i < pair_count; ++i) {
        const int* other_element = traversed.elements.data + 48 * (size_t)(others[i] / 8) + others[i] % 8;
        unsigned mask = met[i];
        if (pair_filter.group.data) {
            for (unsigned rest = mask; rest; rest &= rest - 1)
                if (!meet(element + 8 + __builtin_ctz(rest), other_element + 8))
                    mask &= ~(rest & -rest);
            const wp::int64 now = __builtin_popcount(met[i] & ~mask);
            left_out += now;
            if (filtered_of_worlds.data && now)
                __atomic_fetch_add(&filtered_of_worlds.data[other_element[32]], now, __ATOMIC_RELAXED);
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
    const size_t row = traversed.level_starts.data[level] + node;
    const int* child_marks = traversed.node_marks.data + 24 * row;
    const Ints children = 8 * node + lanes;
    Ints overlap = (ints(child_marks) <= last_world) & (ints(child_marks + 8) >= first_world);
    if (!changed)
        overlap &= ints(child_marks + 16) != 0;
    if (symmetric)  // each pair of packets once: the packets below one are those from 8^level times its index on
        overlap &= children >= packet >> (3 * level);
    overlap &= meeting(traversed.nodes.data + 96 * row, whole);
    if (level > 0)
        height += append(stack + height, 16 * children + level - 1, bits(overlap));
    else
        near_count += append(near + near_count, children, bits(overlap));
    if (near_count > most_near - 8 || height == 0)
        compare();
}
flush();
if (left_out)
    __atomic_fetch_add(&counts.data[filtered], left_out, __ATOMIC_RELAXED);
