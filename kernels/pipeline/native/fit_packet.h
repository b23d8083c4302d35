// The body of fit_packet; Scalar is the type of a coordinate.

typedef Scalar Four __attribute__((ext_vector_type(4)));
typedef Scalar Loaded __attribute__((ext_vector_type(4), aligned(sizeof(Scalar))));
typedef double Doubles __attribute__((ext_vector_type(4)));
typedef float Row __attribute__((ext_vector_type(4)));

const Scalar infinity = __builtin_inf();
const int* element = elements.data + 48 * (size_t)packet;
float* box = boxes.data + 96 * (size_t)packet;
float* node = nodes.data + 96 * (size_t)(packet / 8) + packet % 8;
int* marks = node_marks.data + 24 * (size_t)(packet / 8) + packet % 8;

// positions may be a view, with any stride; a fourth number is read with them where there is one
auto load = [&](const auto& x, int corner) -> Four {
    const Scalar* from = (const Scalar*)((const char*)x.data + x.strides[0] * (wp::int64)corner);
    if (corner + 1 < x.shape[0] && x.strides[0] >= 3 * (int)sizeof(Scalar))
        return *(const Loaded*)from;
    return Four{from[0], from[1], from[2], 0};
};
// to single precision, to nearest: rounding and clamping keep order; -0 becomes 0
auto rounded = [](Four x, double pad) {
    const Doubles largest = 3.4028234663852886e38;
    const Doubles moved = __builtin_convertvector(x, Doubles) + pad;
    const Doubles clamped = __builtin_elementwise_max(__builtin_elementwise_min(moved, largest), -largest);
    return __builtin_convertvector(clamped, Row) + 0.0f;
};

float rows[12][8];
Row whole[4];
for (int row = 0; row < 4; ++row) {
    whole[row] = row % 2 ? -__builtin_inff() : __builtin_inff();
    for (int axis = 0; axis < 3; ++axis)
        for (int lane = 0; lane < 8; ++lane)
            rows[4 * axis + row][lane] = whole[row][0];
}
int lane_marks[8] = {}, any_changed = 0;
for (int lane = 0; lane < count; ++lane) {
    Four low0 = infinity, high0 = -infinity, low1 = infinity, high1 = -infinity;
    auto finite = low0 == low0;
    double pad = 0.0;
    int mark = !changed.data;
    for (int i = 0; i < corners; ++i) {
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
    }
    lane_marks[lane] = mark;
    any_changed |= mark != 0;
    if (!(finite[0] && finite[1] && finite[2]))
        continue;  // an empty box overlaps none
    const Row four[4] = {rounded(low0, -pad), rounded(high0, pad), rounded(low1, -pad), rounded(high1, pad)};
    for (int row = 0; row < 4; ++row) {
        whole[row] = row % 2 ? __builtin_elementwise_max(whole[row], four[row])
                             : __builtin_elementwise_min(whole[row], four[row]);
        for (int axis = 0; axis < 3; ++axis)
            rows[4 * axis + row][lane] = four[row][axis];
    }
}
for (int row = 0; row < 4; ++row)
    for (int axis = 0; axis < 3; ++axis)
        node[32 * axis + 8 * row] = whole[row][axis];
__builtin_memcpy(box, rows, sizeof(rows));
__builtin_memcpy(elements.data + 48 * (size_t)packet + 40, lane_marks, sizeof(lane_marks));
marks[16] = any_changed;
