// The body of fit_packet; after positions.h.

typedef double Doubles __attribute__((ext_vector_type(8)));
typedef float Row __attribute__((ext_vector_type(8), aligned(4)));
typedef int Ints __attribute__((ext_vector_type(8), aligned(4)));

int* element = tree.elements.data + 48 * (size_t)packet;
float* box = tree.boxes.data + 96 * (size_t)packet;
float* node = tree.nodes.data + 96 * (size_t)(packet / 8) + packet % 8;
int* marks = tree.node_marks.data + 24 * (size_t)(packet / 8) + packet % 8;

auto lesser = [](auto a, auto b) { return b < a ? b : a; };
auto greater = [](auto a, auto b) { return b > a ? b : a; };

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
        largest = greater(largest, corner);
        if (padding.data)
            pad[lane] = greater((double)pad[lane], padding.data[corner]);
        if (changed.data)
            lane_marks[lane] = greater((signed)lane_marks[lane], changed.data[corner]);
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
            low = i ? lesser(low, x) : x;
            high = i ? greater(high, x) : x;
        }
}
const Ints lanes = {0, 1, 2, 3, 4, 5, 6, 7}, present = lanes < count;
const Ints filled = __builtin_convertvector(finite, Ints) & present;
lane_marks &= present;
for (int row = 0; row < 4; ++row)
    for (int axis = 0; axis < 3; ++axis) {
        // to single precision, to nearest: rounding and clamping keep order; -0 becomes 0
        const Doubles largest = 3.4028234663852886e38;
        const Doubles moved = __builtin_convertvector(ends[row][axis], Doubles) + (row % 2 ? pad : -pad);
        const Doubles clamped = greater(lesser(moved, largest), -largest);
        Row values = __builtin_convertvector(clamped, Row) + 0.0f;
        const Row empty = row % 2 ? -__builtin_inff() : __builtin_inff();  // overlaps no box
        values = filled ? values : empty;
        *(Row*)(box + 32 * axis + 8 * row) = values;
        auto outer = [&](Row a, Row b) { return row % 2 ? greater(a, b) : lesser(a, b); };
        values = outer(values, __builtin_shufflevector(values, values, 4, 5, 6, 7, 0, 1, 2, 3));
        values = outer(values, __builtin_shufflevector(values, values, 2, 3, 0, 1, 6, 7, 4, 5));
        node[32 * axis + 8 * row] = outer(values, __builtin_shufflevector(values, values, 1, 0, 3, 2, 5, 4, 7, 6))[0];
    }
*(Ints*)(element + 40) = lane_marks;
marks[16] = __builtin_reduce_or(lane_marks) != 0;
