// Positions of eight vertices at a time. Of x0, x1; Scalar.

typedef Scalar Scalars __attribute__((ext_vector_type(8)));
typedef Scalar Loaded __attribute__((ext_vector_type(4), aligned(sizeof(Scalar))));

// positions may be a view, with any stride; x y z are read with a fourth number where there is one
auto position = [](const auto& x, int corner) {
    return (const Scalar*)((const char*)x.data + x.strides[0] * (wp::int64)corner);
};
const bool forward = x0.strides[0] >= 3 * (int)sizeof(Scalar) && x1.strides[0] >= 3 * (int)sizeof(Scalar);
const int last = forward ? (x0.shape[0] < x1.shape[0] ? x0.shape[0] : x1.shape[0]) - 1 : -1;
auto both = [](const Scalar* a, const Scalar* b, bool has_fourth) -> Scalars {
    if (has_fourth)
        return __builtin_shufflevector(*(const Loaded*)a, *(const Loaded*)b, 0, 1, 2, 3, 4, 5, 6, 7);
    return Scalars{a[0], a[1], a[2], 0, b[0], b[1], b[2], 0};
};

// the coordinates of the vertices of eight lanes: reads their positions, and transposes them
auto read_coordinates = [&](const auto& x, auto corner, bool has_fourth, Scalars* to) {
    auto row = [&](int lane) { return both(position(x, corner(lane)), position(x, corner(lane + 4)), has_fourth); };
    const Scalars a = row(0), b = row(1), c = row(2), d = row(3);
    const Scalars xz = __builtin_shufflevector(a, b, 0, 8, 2, 10, 4, 12, 6, 14);
    const Scalars more_xz = __builtin_shufflevector(c, d, 0, 8, 2, 10, 4, 12, 6, 14);
    const Scalars y = __builtin_shufflevector(a, b, 1, 9, 3, 11, 5, 13, 7, 15);
    const Scalars more_y = __builtin_shufflevector(c, d, 1, 9, 3, 11, 5, 13, 7, 15);
    to[0] = __builtin_shufflevector(xz, more_xz, 0, 1, 8, 9, 4, 5, 12, 13);
    to[1] = __builtin_shufflevector(y, more_y, 0, 1, 8, 9, 4, 5, 12, 13);
    to[2] = __builtin_shufflevector(xz, more_xz, 2, 3, 10, 11, 6, 7, 14, 15);
};
