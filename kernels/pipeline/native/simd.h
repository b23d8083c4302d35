// Vectors of eight numbers, and the points of eight pairs. Of elements, pairs; vertex_face; after lanes.h, positions.h.

struct Vectors {
    Doubles x, y, z;
};
struct FloatVectors {
    Floats x, y, z;
};

auto absolute = [](auto a) { return __builtin_elementwise_abs(a); };
auto larger = [=](auto a, auto b) { return most(absolute(a), absolute(b)); };
auto sizes = [=](auto a, auto b) { return decltype(a){larger(a.x, b.x), larger(a.y, b.y), larger(a.z, b.z)}; };
auto plus = [](auto a, auto b) { return decltype(a){a.x + b.x, a.y + b.y, a.z + b.z}; };
auto minus = [](auto a, auto b) { return decltype(a){a.x - b.x, a.y - b.y, a.z - b.z}; };
auto times = [](auto a, auto b) {
    const decltype(b.x) factor = a;
    return decltype(b){factor * b.x, factor * b.y, factor * b.z};
};
auto dot = [](auto a, auto b) { return a.x * b.x + a.y * b.y + a.z * b.z; };
auto cross = [](auto a, auto b) {
    return decltype(a){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
};

// loaded as vectors: of single numbers, the compiler would make gathers, which take longer
typedef int Two __attribute__((ext_vector_type(2), aligned(4)));
typedef int Four __attribute__((ext_vector_type(4)));
auto corners_of = [&](int slot) -> Four {
    const Two pair = *((const Two*)pairs.data + slot);
    if (vertex_face) {
        const int* face = elements.data + 3 * (size_t)pair[1];
        const Two rest = *(const Two*)(face + 1);
        return Four{pair[0], face[0], rest[0], rest[1]};
    }
    return __builtin_shufflevector(*((const Two*)elements.data + pair[0]), *((const Two*)elements.data + pair[1]), 0, 1,
                                   2, 3);
};

// the points of up to eight pairs, whose slots a function has by lane, as the coordinates of all eight
struct Points {
    Scalars x[24];
};
auto read_points = [&](auto slot, int filled) -> Points {
    Points points;
    Four corners[8], largest = 0;
    for (int lane = 0; lane < 8; ++lane) {
        corners[lane] = corners_of(slot(lane < filled ? lane : 0));
        largest = __builtin_elementwise_max(largest, corners[lane]);
    }
    const bool has_fourth = __builtin_reduce_max(largest) < last;
    for (int i = 0; i < 4; ++i) {
        auto corner = [&](int lane) { return corners[lane][i]; };
        read_coordinates(x0, corner, has_fourth, points.x + 3 * i);
        read_coordinates(x1, corner, has_fourth, points.x + 12 + 3 * i);
    }
    return points;
};

// the differences u, v, w of eight pairs at both ends
auto relative = [&](const Points& points, auto example) {
    typedef decltype(example) Of;
    struct Relative {
        Of u0, v0, w0, u1, v1, w1;
    };
    auto point = [&](int i) {
        auto coordinate = [&](int axis) { return __builtin_convertvector(points.x[3 * i + axis], decltype(Of::x)); };
        return Of{coordinate(0), coordinate(1), coordinate(2)};
    };
    if (vertex_face)
        return Relative{minus(point(2), point(1)), minus(point(3), point(1)), minus(point(0), point(1)),
                        minus(point(6), point(5)), minus(point(7), point(5)), minus(point(4), point(5))};
    return Relative{minus(point(1), point(0)), minus(point(3), point(2)), minus(point(2), point(0)),
                    minus(point(5), point(4)), minus(point(7), point(6)), minus(point(6), point(4))};
};
