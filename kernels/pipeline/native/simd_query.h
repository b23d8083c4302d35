// Motion, polynomials and closest points of eight queries; after simd.h.

struct Signs {
    int positive, negative;
};
auto sign = [=](Doubles value, Doubles bound) { return Signs{bits(value > bound), bits(value < -bound)}; };
auto known = [](Signs a) { return a.positive | a.negative; };
auto negated = [](Signs a) { return Signs{a.negative, a.positive}; };
auto product = [](Signs a, Signs b) {
    return Signs{(a.positive & b.positive) | (a.negative & b.negative),
                 (a.positive & b.negative) | (a.negative & b.positive)};
};
// the signs of a in some lanes, those of b in the others
auto chosen = [](int lanes, Signs a, Signs b) {
    return Signs{(a.positive & lanes) | (b.positive & ~lanes), (a.negative & lanes) | (b.negative & ~lanes)};
};
auto where = [](Longs lanes, Doubles a, Doubles b) { return lanes ? a : b; };
auto lanes_of = [](int lanes) -> Longs {
    return -__builtin_convertvector(__builtin_bit_cast(Bools, (unsigned char)lanes), Longs);
};

// the lowest and the highest of some numbers
auto range = [](auto low, auto high) {
    struct Range {
        decltype(low) lowest, highest;
    };
    return Range{low, high};
};
auto outside = [](auto range, auto bound) { return (range.lowest > bound) | (range.highest < -bound); };
auto across = [](auto range, auto bound) { return (range.lowest < -bound) & (range.highest > bound); };
auto range_of = [=](auto k) {
    return range(least(least(k.k0, k.k1), least(k.k2, k.k3)), most(most(k.k0, k.k1), most(k.k2, k.k3)));
};
// the lanes in which all coefficients certainly have one sign
auto one_sign = [=](auto k, Doubles bound) { return bits(outside(range_of(k), bound)); };
// a quadratic has its Bernstein coefficients in x, y and z
auto quadratic_sign = [=](Vectors q, Doubles bound) {
    return Signs{bits(least(q.x, least(q.y, q.z)) > bound), bits(most(q.x, most(q.y, q.z)) < -bound)};
};
auto largest_of = [=](auto a) { return most(absolute(a.x), most(absolute(a.y), absolute(a.z))); };

auto inverse_power_of_two = [](Doubles a) {
    const Longs exponent = (__builtin_bit_cast(Longs, a) >> 52) & 2047;
    return __builtin_bit_cast(Doubles, (2046 - exponent) << 52);
};

struct Motion {
    Vectors u0, v0, w0, u1, v1, w1, u_size, v_size, w_size;
    Doubles scale;
};
auto scaled_motion = [&](const Points& points, int& usable) -> Motion {
    const auto r = relative(points, Vectors());
    Vectors u = sizes(r.u0, r.u1), v = sizes(r.v0, r.v1), w = sizes(r.w0, r.w1);
    const Doubles size = most(largest_of(u), most(largest_of(v), largest_of(w)));
    usable &= bits((size >= 0x1p-480) & (size < 0x1p1023));
    if constexpr (sizeof(Scalar) == 4) {
        typedef unsigned Words __attribute__((ext_vector_type(8)));
        Words smallest = 0xffffffffu;
        for (int i = 0; i < 24; ++i) {  // zero becomes the largest number
            const Words word = __builtin_bit_cast(Words, __builtin_convertvector(points.x[i], Floats)) & 0x7fffffffu;
            smallest = __builtin_elementwise_min(smallest, word - 1u);
        }
        usable &= bits(smallest >= 0x007fffffu);
    }
    const Doubles scale = inverse_power_of_two(size);
    return {times(scale, r.u0), times(scale, r.v0), times(scale, r.w0), times(scale, r.u1), times(scale, r.v1),
            times(scale, r.w1), times(scale, u),    times(scale, v),    times(scale, w),    scale};
};
auto cross_size = [](Vectors a, Vectors b) {
    return Vectors{a.y * b.z + a.z * b.y, a.z * b.x + a.x * b.z, a.x * b.y + a.y * b.x};
};
// the cubic of a motion, or of one that is not scaled, and the coefficients of the normal
auto coefficients = [=](const auto& m) {
    struct Coefficients {
        struct {
            decltype(m.u0.x) k0, k1, k2, k3;
        } k;
        decltype(m.u0) n0, nh, n1;
    };
    const auto n0 = cross(m.u0, m.v0), n1 = cross(m.u1, m.v1);
    const auto nh = times(0.5, plus(cross(m.u0, m.v1), cross(m.u1, m.v0)));
    const decltype(m.u0.x) third = 1.0 / 3.0, twice = 2.0;
    return Coefficients{{dot(m.w0, n0), (twice * dot(m.w0, nh) + dot(m.w1, n0)) * third,
                         (twice * dot(m.w1, nh) + dot(m.w0, n1)) * third, dot(m.w1, n1)},
                        n0,
                        nh,
                        n1};
};
typedef decltype(coefficients(Motion())) Coefficients;
typedef decltype(Coefficients::k) Cubic;
struct Coplanarity : Coefficients {
    Doubles bound;
    Vectors uv;
};
auto coplanarity = [&](const Motion& m) -> Coplanarity {
    const Vectors uv = cross_size(m.u_size, m.v_size);
    return {coefficients(m), roundoff * (coplanarity_error * dot(m.w_size, uv) + underflow), uv};
};

// the lanes in which axis 1 and axis 2 are chosen; axis 0 in the others
struct Axes {
    Longs one, two;
};
auto largest_axis = [=](Vectors a) -> Axes {
    const Doubles x = absolute(a.x), y = absolute(a.y), z = absolute(a.z);
    const Longs x_first = x >= y, x_last = x >= z, y_last = y >= z;
    return {~x_first & y_last, (x_first & ~x_last) | (~x_first & ~y_last)};
};
auto component = [=](Vectors a, Axes axes) { return where(axes.two, a.z, where(axes.one, a.y, a.x)); };

struct InsideTests {
    Vectors q[4];
    Doubles bounds[4];
};
auto inside_tests = [&](const Motion& m, const Coplanarity& y, Axes axes) -> InsideTests {
    // the two other axes of each vector, in cyclic order
    struct Plane {
        Doubles j, k;
    };
    auto in_plane = [&](Vectors a) -> Plane {
        return {where(axes.two, a.x, where(axes.one, a.z, a.y)), where(axes.two, a.y, where(axes.one, a.x, a.z))};
    };
    auto cross_component = [](Plane x0, Plane x1, Plane y0, Plane y1) {
        return Vectors{x0.j * y0.k - x0.k * y0.j, 0.5 * ((x0.j * y1.k - x0.k * y1.j) + (x1.j * y0.k - x1.k * y0.j)),
                       x1.j * y1.k - x1.k * y1.j};
    };
    const Plane u0 = in_plane(m.u0), v0 = in_plane(m.v0), w0 = in_plane(m.w0);
    const Plane u1 = in_plane(m.u1), v1 = in_plane(m.v1), w1 = in_plane(m.w1);
    const Plane u_size = in_plane(m.u_size), v_size = in_plane(m.v_size), w_size = in_plane(m.w_size);
    const Vectors n = {component(y.n0, axes), component(y.nh, axes), component(y.n1, axes)};
    const Vectors w_v = cross_component(w0, w1, v0, v1);
    const Doubles uv = component(y.uv, axes);
    const Doubles wv = w_size.j * v_size.k + w_size.k * v_size.j;
    const Doubles wu = w_size.j * u_size.k + w_size.k * u_size.j;
    InsideTests tests;
    tests.q[0] = w_v;
    tests.bounds[0] = roundoff * (product_error * wv + underflow);
    if (vertex_face) {
        const Vectors u_w = cross_component(u0, u1, w0, w1);
        tests.q[1] = u_w;
        tests.q[2] = minus(minus(n, w_v), u_w);
        tests.q[3] = n;
        tests.bounds[1] = roundoff * (product_error * wu + underflow);
        tests.bounds[2] = roundoff * (remainder_error * (uv + wv + wu) + underflow);
        tests.bounds[3] = roundoff * (product_error * uv + underflow);
    } else {
        const Vectors w_u = cross_component(w0, w1, u0, u1);
        tests.q[1] = minus(n, w_v);
        tests.q[2] = w_u;
        tests.q[3] = minus(n, w_u);
        tests.bounds[1] = roundoff * (difference_error * (uv + wv) + underflow);
        tests.bounds[2] = roundoff * (product_error * wu + underflow);
        tests.bounds[3] = roundoff * (difference_error * (uv + wu) + underflow);
    }
    return tests;
};

// the lanes that are certainly free, and those that are certainly hits
struct Status {
    int free, hit;
};
// by the signs of the inside tests
auto verdict = [](const Signs* s) -> Status {
    const int above = s[0].positive | s[1].positive | s[2].positive | s[3].positive;
    const int below = s[0].negative | s[1].negative | s[2].negative | s[3].negative;
    return {above & below, (s[0].positive & s[1].positive & s[2].positive & s[3].positive) |
                               (s[0].negative & s[1].negative & s[2].negative & s[3].negative)};
};
auto constant_verdict = [=](const InsideTests& tests) {
    Signs s[4];
    for (int i = 0; i < 4; ++i)
        s[i] = quadratic_sign(tests.q[i], tests.bounds[i]);
    return verdict(s);
};

// closest points, see kernels/closest.py: (beta, gamma) of a face or (s, r) along two edges
struct Coordinates {
    Doubles first, second;
};
auto ratio = [=](Doubles x, Doubles y) {
    const Doubles zero = 0.0, one = 1.0;
    return where(y > 0.0, least(most(zero, x / y), one), zero);
};
auto closest_coordinates = [=](Vectors u, Vectors v, Vectors w) -> Coordinates {
    const Doubles zero = 0.0;
    if (!vertex_face) {
        const Doubles uu = dot(u, u), vv = dot(v, v), uv = dot(u, v), uw = dot(u, w), vw = dot(v, w);
        const Doubles s = ratio(uw * vv - uv * vw, uu * vv - uv * uv);
        const Doubles r = ratio(uv * s - vw, vv);
        return {ratio(uv * r + uw, uu), r};
    }
    const Vectors n = cross(u, v);
    const Doubles beta = dot(cross(w, v), n), gamma = dot(cross(u, w), n), nn = dot(n, n);
    const Longs inside = (nn > 0.0) & (beta >= 0.0) & (gamma >= 0.0) & (beta + gamma <= nn);
    Coordinates c = {beta / nn, gamma / nn};
    if (bits(inside) == 255)
        return c;
    const Vectors side = minus(v, u), from_u = minus(w, u);
    const Doubles s_u = ratio(dot(w, u), dot(u, u)), s_v = ratio(dot(w, v), dot(v, v));
    const Doubles s_uv = ratio(dot(from_u, side), dot(side, side));
    const Vectors gap_u = minus(w, times(s_u, u)), gap_v = minus(w, times(s_v, v));
    const Vectors gap_uv = minus(from_u, times(s_uv, side));
    const Doubles to_u = dot(gap_u, gap_u), to_v = dot(gap_v, gap_v), to_uv = dot(gap_uv, gap_uv);
    const Longs at_u = (to_u <= to_v) & (to_u <= to_uv), at_v = to_v <= to_uv;
    const Doubles first = where(at_u, s_u, where(at_v, zero, 1.0 - s_uv));
    const Doubles second = where(at_u, zero, where(at_v, s_v, s_uv));
    return {where(inside, c.first, first), where(inside, c.second, second)};
};
auto between = [=](Coordinates c, Vectors u, Vectors v, Vectors w) {
    if (vertex_face)
        return minus(minus(w, times(c.first, u)), times(c.second, v));
    return minus(minus(times(c.first, u), times(c.second, v)), w);
};

// by how much a direction separates the features at both ends, on either side
auto gaps_along = [=](const auto& m, auto direction) {
    const auto u0 = dot(direction, m.u0), v0 = dot(direction, m.v0), w0 = dot(direction, m.w0);
    const auto u1 = dot(direction, m.u1), v1 = dot(direction, m.v1), w1 = dot(direction, m.w1);
    const decltype(direction.x) zero = 0.0;
    if (vertex_face)
        return range(least(w0 - most(most(u0, v0), zero), w1 - most(most(u1, v1), zero)),
                     most(w0 - least(least(u0, v0), zero), w1 - least(least(u1, v1), zero)));
    return range(least(w0 - most(u0, zero) + least(v0, zero), w1 - most(u1, zero) + least(v1, zero)),
                 most(w0 - least(u0, zero) + most(v0, zero), w1 - least(u1, zero) + most(v1, zero)));
};
auto gap_bound = [=](Vectors size, Vectors direction) {
    return roundoff * (direction_error * dot(sizes(direction, direction), size) + underflow);
};
// the direction through the centroids at half time
auto centroid_direction = [=](const auto& m) {
    const auto u = plus(m.u0, m.u1), v = plus(m.v0, m.v1), w = plus(m.w0, m.w1);
    return vertex_face ? minus(w, times(1.0 / 3.0, plus(u, v))) : plus(w, times(0.5, minus(v, u)));
};
// the lanes in which a direction certainly separates the features at both ends, on the same side
auto direction_separates = [=](const Motion& m, Vectors direction) -> int {
    const Doubles bound = gap_bound(plus(plus(m.u_size, m.v_size), m.w_size), direction);
    return bits(outside(gaps_along(m, direction), bound));
};
