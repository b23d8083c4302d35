"""The culls of eight pairs at once, with the vector instructions of a CPU.

They need additions, multiplications and comparisons alone, the same for every pair: what the paper's polynomials are
good for. The operations are those of :mod:`.culling` and :mod:`.polynomials`, in the same order, and so are the bounds
on their errors.

Pairs are not scaled, because powers of two change nothing but overflow and underflow. A sum that overflows is culled by
no comparison. What underflows is lost once in a component of the normal, 2^-1074 for each of at most four products,
before w multiplies it: for coordinates up to 1e150 that is less than the UNDERFLOW that bounds add, times the roundoff,
and larger ones are not culled. Without a roundoff there is nothing to certify.
"""

import functools

import warp as wp

from .culling import DIRECTION_ERROR
from .polynomials import COPLANARITY_ERROR
from .signs import UNDERFLOW

EIGHT = wp.constant(8)
"""Pairs that are culled at once."""

_LARGEST = 1.0e150

_SNIPPET = """
    typedef {scalar} Scalars __attribute__((ext_vector_type(8)));
    typedef {scalar} Four __attribute__((ext_vector_type(4)));
    typedef {scalar} Two __attribute__((ext_vector_type(2), aligned(sizeof({scalar}))));
    typedef double Doubles __attribute__((ext_vector_type(8)));
    typedef bool Bools __attribute__((ext_vector_type(8)));
    struct Vectors {{ Doubles x, y, z; }};

    auto bits = [](auto mask) -> int {{
        return __builtin_bit_cast(unsigned char, __builtin_convertvector(mask, Bools));
    }};
    auto least = [](Doubles a, Doubles b) {{ return __builtin_elementwise_min(a, b); }};
    auto most = [](Doubles a, Doubles b) {{ return __builtin_elementwise_max(a, b); }};
    auto larger = [](Doubles a, Doubles b) {{
        return __builtin_elementwise_max(__builtin_elementwise_abs(a), __builtin_elementwise_abs(b));
    }};
    auto sizes = [larger](Vectors a, Vectors b) {{
        return Vectors{{larger(a.x, b.x), larger(a.y, b.y), larger(a.z, b.z)}};
    }};
    auto plus = [](Vectors a, Vectors b) {{ return Vectors{{a.x + b.x, a.y + b.y, a.z + b.z}}; }};
    auto minus = [](Vectors a, Vectors b) {{ return Vectors{{a.x - b.x, a.y - b.y, a.z - b.z}}; }};
    auto times = [](double a, Vectors b) {{ return Vectors{{a * b.x, a * b.y, a * b.z}}; }};
    auto dot = [](Vectors a, Vectors b) {{ return a.x * b.x + a.y * b.y + a.z * b.z; }};
    auto cross = [](Vectors a, Vectors b) {{
        return Vectors{{a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}};
    }};

    // the points as they are in memory, x y y z each, transposed to coordinates of all eight
    int corners[4][8];
    for (int lane = 0; lane < 8; ++lane) {{
        const int* pair = (const int*)pairs.data + 2 * (size_t)(lane < count ? first + lane : first);
        if (vertex_face) {{
            const int* face = elements.data + 3 * (size_t)pair[1];
            corners[0][lane] = pair[0], corners[1][lane] = face[0];
            corners[2][lane] = face[1], corners[3][lane] = face[2];
        }} else {{
            const int* edge = elements.data + 2 * (size_t)pair[0];
            const int* other = elements.data + 2 * (size_t)pair[1];
            corners[0][lane] = edge[0], corners[1][lane] = edge[1];
            corners[2][lane] = other[0], corners[3][lane] = other[1];
        }}
    }}
    Scalars points[24];
    auto read = [&](const {scalar}* x, const int* corner, Scalars* to) {{
        Four at[8], low[3], high[3];
        for (int lane = 0; lane < 8; ++lane) {{
            const {scalar}* from = x + 3 * (size_t)corner[lane];
            at[lane] = __builtin_shufflevector(*(const Two*)from, *(const Two*)(from + 1), 0, 1, 2, 3);
        }}
        auto transpose = [](const Four* at, Four* to) {{
            const Four xy = __builtin_shufflevector(at[0], at[1], 0, 4, 1, 5);
            const Four yz = __builtin_shufflevector(at[0], at[1], 2, 6, 3, 7);
            const Four more_xy = __builtin_shufflevector(at[2], at[3], 0, 4, 1, 5);
            const Four more_yz = __builtin_shufflevector(at[2], at[3], 2, 6, 3, 7);
            to[0] = __builtin_shufflevector(xy, more_xy, 0, 1, 4, 5);
            to[1] = __builtin_shufflevector(xy, more_xy, 2, 3, 6, 7);
            to[2] = __builtin_shufflevector(yz, more_yz, 2, 3, 6, 7);
        }};
        transpose(at, low);
        transpose(at + 4, high);
        for (int axis = 0; axis < 3; ++axis)
            to[axis] = __builtin_shufflevector(low[axis], high[axis], 0, 1, 2, 3, 4, 5, 6, 7);
    }};
    for (int i = 0; i < 4; ++i) {{
        read((const {scalar}*)x0.data, corners[i], points + 3 * i);
        read((const {scalar}*)x1.data, corners[i], points + 12 + 3 * i);
    }}
    int left = (1 << count) - 1;

    // axis boxes
    Scalars low[2][3], high[2][3], other_low[2][3], other_high[2][3];
    for (int end = 0; end < 2; ++end)
        for (int axis = 0; axis < 3; ++axis) {{
            Scalars p[4];
            for (int i = 0; i < 4; ++i)
                p[i] = points[12 * end + 3 * i + axis];
            low[end][axis] = high[end][axis] = p[0];
            if (!vertex_face) {{
                low[end][axis] = __builtin_elementwise_min(p[0], p[1]);
                high[end][axis] = __builtin_elementwise_max(p[0], p[1]);
            }}
            other_low[end][axis] = __builtin_elementwise_min(p[2], p[3]);
            other_high[end][axis] = __builtin_elementwise_max(p[2], p[3]);
            if (vertex_face) {{
                other_low[end][axis] = __builtin_elementwise_min(other_low[end][axis], p[1]);
                other_high[end][axis] = __builtin_elementwise_max(other_high[end][axis], p[1]);
            }}
        }}
    auto apart = (other_low[0][0] > high[0][0]) & (other_low[1][0] > high[1][0]);
    for (int axis = 0; axis < 3; ++axis) {{
        apart |= (other_low[0][axis] > high[0][axis]) & (other_low[1][axis] > high[1][axis]);
        apart |= (low[0][axis] > other_high[0][axis]) & (low[1][axis] > other_high[1][axis]);
    }}
    left &= ~bits(apart);
    if (!left)
        return 0;

    // Bernstein signs
    auto point = [&](int i) {{
        return Vectors{{
            __builtin_convertvector(points[3 * i], Doubles),
            __builtin_convertvector(points[3 * i + 1], Doubles),
            __builtin_convertvector(points[3 * i + 2], Doubles)}};
    }};
    Vectors u0, v0, w0, u1, v1, w1;
    if (vertex_face) {{
        u0 = minus(point(2), point(1)), v0 = minus(point(3), point(1)), w0 = minus(point(0), point(1));
        u1 = minus(point(6), point(5)), v1 = minus(point(7), point(5)), w1 = minus(point(4), point(5));
    }} else {{
        u0 = minus(point(1), point(0)), v0 = minus(point(3), point(2)), w0 = minus(point(2), point(0));
        u1 = minus(point(5), point(4)), v1 = minus(point(7), point(6)), w1 = minus(point(6), point(4));
    }}
    const Vectors n0 = cross(u0, v0), n1 = cross(u1, v1);
    const Vectors twice_nh = plus(cross(u0, v1), cross(u1, v0));
    const Doubles k0 = dot(w0, n0), k3 = dot(w1, n1);
    const Doubles k1 = (dot(w0, twice_nh) + dot(w1, n0)) * (1.0 / 3.0);
    const Doubles k2 = (dot(w1, twice_nh) + dot(w0, n1)) * (1.0 / 3.0);
    // without a roundoff all bounds are zero
    Vectors size = {{0.0, 0.0, 0.0}};
    Doubles bound = 0.0;
    int trusted = 255;
    if (roundoff > 0.0) {{
        const Vectors u = sizes(u0, u1), v = sizes(v0, v1), w = sizes(w0, w1);
        const Vectors uv = {{u.y * v.z + u.z * v.y, u.z * v.x + u.x * v.z, u.x * v.y + u.y * v.x}};
        bound = roundoff * ({coplanarity_error} * dot(w, uv) + {underflow});
        size = plus(plus(u, v), w);
        trusted = bits(most(most(size.x, size.y), size.z) < {largest});
    }}
    auto culled = (least(least(k0, k1), least(k2, k3)) > bound) | (most(most(k0, k1), most(k2, k3)) < -bound);
    left &= ~(bits(culled) & trusted);
    if (!left)
        return 0;

    // separating direction
    const Vectors us = plus(u0, u1), vs = plus(v0, v1), ws = plus(w0, w1);
    const Vectors direction
        = vertex_face ? minus(ws, times(1.0 / 3.0, plus(us, vs))) : plus(ws, times(0.5, minus(vs, us)));
    const Doubles du0 = dot(direction, u0), du1 = dot(direction, u1), zero = 0.0;
    const Doubles dv0 = dot(direction, v0), dv1 = dot(direction, v1);
    const Doubles dw0 = dot(direction, w0), dw1 = dot(direction, w1);
    Doubles lowest, highest;
    if (vertex_face) {{
        lowest = least(dw0 - most(most(du0, dv0), zero), dw1 - most(most(du1, dv1), zero));
        highest = most(dw0 - least(least(du0, dv0), zero), dw1 - least(least(du1, dv1), zero));
    }} else {{
        lowest = least(dw0 - most(du0, zero) + least(dv0, zero), dw1 - most(du1, zero) + least(dv1, zero));
        highest = most(dw0 - least(du0, zero) + most(dv0, zero), dw1 - least(du1, zero) + most(dv1, zero));
    }}
    const Vectors along = sizes(direction, direction);
    const Doubles slack = roundoff * ({direction_error} * dot(along, size) + {underflow});
    culled = (lowest > slack) | (highest < -slack);
    return left & ~(bits(culled) & trusted);
"""


@functools.cache
def cull_eight_of(dtype, vertex_face: bool):
    """The function that culls eight pairs, for one type of position and one kind of pair.

    It takes positions at both ends, the vertices of the elements, a queue of pairs, the first of them and how many from
    there on count, up to eight, and the roundoff. It returns which of them no cull decides, as bits.
    """
    snippet = _SNIPPET.format(
        scalar="float" if dtype is wp.vec3 else "double",
        coplanarity_error=float(COPLANARITY_ERROR),
        direction_error=float(DIRECTION_ERROR),
        underflow=repr(float(UNDERFLOW)),
        largest=repr(_LARGEST),
    )

    @wp.func_native(f"    constexpr bool vertex_face = {'true' if vertex_face else 'false'};\n{snippet}")
    def cull_eight(
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        pairs: wp.array[wp.vec2i],
        first: int,
        count: int,
        roundoff: wp.float64,
    ) -> int: ...

    return cull_eight
