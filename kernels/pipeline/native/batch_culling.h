// The body of cull_batch; after simd_query.h.

// box test, pair by pair: x y z of both ends in one vector
int near[batch], near_count = 0;
for (int i = 0; i < count; ++i) {
    near[near_count] = i;
    near_count += boxes_meet;
    if (boxes_meet)
        continue;
    const Four corner = corners_of(first + i);
    const bool has_fourth = __builtin_reduce_max(corner) < last;
    auto ends = [&](int i) { return both(position(x0, corner[i]), position(x1, corner[i]), has_fourth); };
    const Scalars a = ends(0), b = ends(1), c = ends(2), d = ends(3);
    auto lowest = [](Scalars a, Scalars b) { return __builtin_elementwise_min(a, b); };
    auto highest = [](Scalars a, Scalars b) { return __builtin_elementwise_max(a, b); };
    const Scalars low = vertex_face ? a : lowest(a, b), other_low = lowest(vertex_face ? lowest(b, c) : c, d);
    const Scalars high = vertex_face ? a : highest(a, b), other_high = highest(vertex_face ? highest(b, c) : c, d);
    const int above = bits(other_low > high), below = bits(low > other_high);
    const int apart = ((above & (above >> 4)) | (below & (below >> 4))) & 7;
    near_count += apart == 0;
}

unsigned long long left = 0;
for (int begin = 0; begin < near_count; begin += 8) {
    const int filled = near_count - begin < 8 ? near_count - begin : 8;
    const Points points = read_points([&](int lane) { return first + near[begin + lane]; }, filled);
    // bounds take longer than signs: only where some lane has one sign; with a roundoff of zero they are zero
    const Relative r = relative(points);
    int unsure = (1 << filled) - 1;
    auto decide = [&](auto signs_of, auto bound_of) {
        const Doubles zero = 0.0;
        int decided = signs_of(zero) & unsure;
        if (decided && roundoff > 0.0) {
            const Vectors u = sizes(r.u0, r.u1), v = sizes(r.v0, r.v1), w = sizes(r.w0, r.w1);
            const Vectors size = plus(plus(u, v), w);
            const Doubles extent = most(most(size.x, size.y), size.z);
            decided = signs_of(bound_of(u, v, w, size, extent)) & bits(extent < largest_size);
        }
        unsure &= ~decided;
    };
    const Cubic k = coefficients(r).k;
    decide([&](Doubles bound) { return one_sign(k, bound); },
           [&](Vectors u, Vectors v, Vectors w, Vectors, Doubles extent) {
               return roundoff * (coplanarity_error * dot(w, cross_size(u, v)) + underflow) + flushed * extent * extent;
           });
    if (!unsure)
        continue;
    const Vectors direction = centroid_direction(r);
    const Gaps gaps = gaps_along(r, direction);
    decide([&](Doubles bound) { return bits((gaps.low > bound) | (gaps.high < -bound)); },
           [&](Vectors, Vectors, Vectors, Vectors size, Doubles) {
               const Vectors along = sizes(direction, direction);
               return gap_bound(size, direction) + flushed * (along.x + along.y + along.z);
           });
    for (int lane = 0; lane < filled; ++lane)
        left |= (unsigned long long)((unsure >> lane) & 1) << near[begin + lane];
}
return left;
