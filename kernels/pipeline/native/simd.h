// Vectors of eight numbers, and the points of eight pairs. Of elements, pairs; vertex_face; after positions.h.

typedef double Doubles __attribute__((ext_vector_type(8)));
typedef decltype(Doubles() < Doubles()) Longs;
typedef int Ints __attribute__((ext_vector_type(8), aligned(4)));
typedef bool Bools __attribute__((ext_vector_type(8)));
struct Vectors {
    Doubles x, y, z;
};

auto bits = [](auto mask) -> int { return __builtin_bit_cast(unsigned char, __builtin_convertvector(mask, Bools)); };
// one instruction each, unlike __builtin_elementwise_min, which prefers numbers to NaN in either argument
auto least = [](Doubles a, Doubles b) { return b < a ? b : a; };
auto most = [](Doubles a, Doubles b) { return b > a ? b : a; };
auto absolute = [](Doubles a) { return __builtin_elementwise_abs(a); };
auto larger = [=](Doubles a, Doubles b) { return most(absolute(a), absolute(b)); };
auto sizes = [=](Vectors a, Vectors b) { return Vectors{larger(a.x, b.x), larger(a.y, b.y), larger(a.z, b.z)}; };
auto plus = [](Vectors a, Vectors b) { return Vectors{a.x + b.x, a.y + b.y, a.z + b.z}; };
auto minus = [](Vectors a, Vectors b) { return Vectors{a.x - b.x, a.y - b.y, a.z - b.z}; };
auto times = [](Doubles a, Vectors b) { return Vectors{a * b.x, a * b.y, a * b.z}; };
auto dot = [](Vectors a, Vectors b) { return a.x * b.x + a.y * b.y + a.z * b.z; };
auto cross = [](Vectors a, Vectors b) {
    return Vectors{a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
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
struct Relative {
    Vectors u0, v0, w0, u1, v1, w1;
};
auto relative = [&](const Points& points) -> Relative {
    auto point = [&](int i) {
        auto coordinate = [&](int axis) { return __builtin_convertvector(points.x[3 * i + axis], Doubles); };
        return Vectors{coordinate(0), coordinate(1), coordinate(2)};
    };
    if (vertex_face)
        return {minus(point(2), point(1)), minus(point(3), point(1)), minus(point(0), point(1)),
                minus(point(6), point(5)), minus(point(7), point(5)), minus(point(4), point(5))};
    return {minus(point(1), point(0)), minus(point(3), point(2)), minus(point(2), point(0)),
            minus(point(5), point(4)), minus(point(7), point(6)), minus(point(6), point(4))};
};
