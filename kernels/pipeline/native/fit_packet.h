// The body of fit_packet; after lanes.h and positions.h.

int* element = tree.elements.data + 48 * (size_t)packet;
float* box = tree.boxes.data + 96 * (size_t)packet;
float* node = tree.nodes.data + 96 * (size_t)(packet / 8) + packet % 8;
int* marks = tree.node_marks.data + 24 * (size_t)(packet / 8) + packet % 8;

// low and high at the start, then at the end, of the elements in lanes; missing ones are as the first
Scalars ends[4][3];
const Scalars infinity = __builtin_inf();
auto finite = infinity == infinity;
Doubles pad = 0.0;
Ints lane_marks = changed.data ? 0 : 1;
for (int i = 0; i < tree.corners; ++i) {
    int corners_of_lanes[8], largest = 0;
    for (int lane = 0; lane < 8; ++lane) {
        const int corner = corners_of_lanes[lane] = element[8 + 8 * i + (lane < count ? lane : 0)];
        largest = most(largest, corner);
        if (padding.data)
            pad[lane] = most((double)pad[lane], padding.data[corner]);
        if (changed.data)
            lane_marks[lane] = most((signed)lane_marks[lane], changed.data[corner]);
    }
    Scalars points[6];
    auto corner = [&](int lane) { return corners_of_lanes[lane]; };
    read_coordinates(x0, corner, largest < last, points);
    read_coordinates(x1, corner, largest < last, points + 3);
    for (int axis = 0; axis < 3; ++axis)
        for (int end = 0; end < 2; ++end) {
            const Scalars x = points[3 * end + axis];
            Scalars &low = ends[2 * end][axis], &high = ends[2 * end + 1][axis];
            finite &= __builtin_elementwise_abs(x) < infinity;
            low = i ? least(low, x) : x;
            high = i ? most(high, x) : x;
        }
}
const Ints present = lanes < count;
const Ints filled = __builtin_convertvector(finite, Ints) & present;
lane_marks &= present;
for (int row = 0; row < 4; ++row)
    for (int axis = 0; axis < 3; ++axis) {
        // to single precision, to nearest: rounding and clamping keep order; -0 becomes 0
        const Doubles largest = 3.4028234663852886e38;
        const Doubles moved = __builtin_convertvector(ends[row][axis], Doubles) + (row % 2 ? pad : -pad);
        const Doubles clamped = most(least(moved, largest), -largest);
        const Floats empty = row % 2 ? -__builtin_inff() : __builtin_inff();  // overlaps no box
        const Floats values = filled ? __builtin_convertvector(clamped, Floats) + 0.0f : empty;
        *(Floats*)(box + 32 * axis + 8 * row) = values;
        node[32 * axis + 8 * row] = outermost(row, values);
    }
*(Ints*)(element + 40) = lane_marks;
marks[16] = __builtin_reduce_or(lane_marks) != 0;
