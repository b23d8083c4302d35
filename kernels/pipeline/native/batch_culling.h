// The body of cull_batch; after simd_query.h.

unsigned long long left = 0;
int open[batch], open_count = 0;  // pairs that the tests before those in double precision leave open

// most pairs are decided in single precision, as in double precision: see batch_culling.py
const bool in_single = boxes_meet && sizeof(Scalar) == sizeof(float);
for (int begin = 0; in_single && begin < count; begin += 8) {
    const int filled = count - begin < 8 ? count - begin : 8;
    const auto r = relative(read_points([&](int lane) { return first + begin + lane; }, filled), FloatVectors());
    const auto u = sizes(r.u0, r.u1), v = sizes(r.v0, r.v1), w = sizes(r.w0, r.w1);
    const Floats extent = most(largest_of(u), most(largest_of(v), largest_of(w))), square = extent * extent;
    const Floats error = 0x1p-17f * square * extent, gap_error = 0x1p-15f * square;
    const auto k = range_of(coefficients(r).k), gaps = gaps_along(r, centroid_direction(r));
    const auto usable = (extent > 0x1p-32f) & (extent < 0x1p40f);
    const int all = (1 << filled) - 1, culled = bits(usable & (outside(k, error) | outside(gaps, gap_error)));
    const int kept = bits(usable & across(k, error) & across(gaps, gap_error)) & all;
    left |= (unsigned long long)kept << begin;
    for (int rest = all & ~(culled | kept); rest; rest &= rest - 1)
        open[open_count++] = begin + __builtin_ctz(rest);
}

// box test, pair by pair: x y z of both ends in one vector
for (int i = 0; !in_single && i < count; ++i) {
    open[open_count] = i;
    const Four corner = corners_of(first + i);
    const bool has_fourth = __builtin_reduce_max(corner) < last;
    auto ends = [&](int i) { return both(position(x0, corner[i]), position(x1, corner[i]), has_fourth); };
    const Scalars a = ends(0), b = ends(1), c = ends(2), d = ends(3);
    const Scalars low = vertex_face ? a : least(a, b), other_low = least(vertex_face ? least(b, c) : c, d);
    const Scalars high = vertex_face ? a : most(a, b), other_high = most(vertex_face ? most(b, c) : c, d);
    const int above = bits(other_low > high), below = bits(low > other_high);
    const int apart = ((above & (above >> 4)) | (below & (below >> 4))) & 7;
    open_count += boxes_meet || apart == 0;
}

for (int begin = 0; begin < open_count; begin += 8) {
    const int filled = open_count - begin < 8 ? open_count - begin : 8;
    const auto r = relative(read_points([&](int lane) { return first + open[begin + lane]; }, filled), Vectors());
    const Vectors direction = centroid_direction(r);
    Doubles error = 0.0, gap_error = 0.0;  // with a roundoff of zero
    int in_range = 255;
    if (roundoff > 0.0) {
        const Vectors u = sizes(r.u0, r.u1), v = sizes(r.v0, r.v1), w = sizes(r.w0, r.w1);
        const Vectors size = plus(plus(u, v), w), along = sizes(direction, direction);
        const Doubles extent = most(most(size.x, size.y), size.z);
        error = roundoff * (coplanarity_error * dot(w, cross_size(u, v)) + underflow) + flushed * extent * extent;
        gap_error = gap_bound(size, direction) + flushed * (along.x + along.y + along.z);
        in_range = bits(extent < 1e70);
    }
    const int culled = one_sign(coefficients(r).k, error) | bits(outside(gaps_along(r, direction), gap_error));
    for (int rest = ((1 << filled) - 1) & ~(culled & in_range); rest; rest &= rest - 1)
        left |= 1ull << open[begin + __builtin_ctz(rest)];
}
return left;
