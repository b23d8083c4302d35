// The body of cull_batch; after simd.h.

// box test, pair by pair: x y z of both ends in one vector
int near[batch];
int near_count = 0;
for (int i = 0; i < count; ++i) {
    near[near_count] = i;
    near_count += boxes_meet;
    if (boxes_meet)
        continue;
    const Four corner = corners_of(first + i);
    const bool has_fourth = __builtin_reduce_max(corner) < last;
    auto ends = [&](int i) { return both(position(x0, corner[i]), position(x1, corner[i]), has_fourth); };
    const Scalars a = ends(0), b = ends(1), c = ends(2), d = ends(3);
    Scalars low = a, high = a;
    Scalars other_low = __builtin_elementwise_min(c, d), other_high = __builtin_elementwise_max(c, d);
    if (vertex_face) {
        other_low = __builtin_elementwise_min(other_low, b);
        other_high = __builtin_elementwise_max(other_high, b);
    } else {
        low = __builtin_elementwise_min(a, b);
        high = __builtin_elementwise_max(a, b);
    }
    const int above = bits(other_low > high), below = bits(low > other_high);
    const int apart = ((above & (above >> 4)) | (below & (below >> 4))) & 7;
    near_count += apart == 0;
}

unsigned long long left = 0;
for (int begin = 0; begin < near_count; begin += 8) {
    const int filled = near_count - begin < 8 ? near_count - begin : 8;
    const Points points = read_points([&](int lane) { return first + near[begin + lane]; }, filled);

    // Bernstein signs
    const Relative r = relative(points);
    const Vectors u0 = r.u0, v0 = r.v0, w0 = r.w0, u1 = r.u1, v1 = r.v1, w1 = r.w1;
    const Vectors n0 = cross(u0, v0), n1 = cross(u1, v1);
    const Vectors twice_nh = plus(cross(u0, v1), cross(u1, v0));
    const Doubles k0 = dot(w0, n0), k3 = dot(w1, n1);
    const Doubles k1 = (dot(w0, twice_nh) + dot(w1, n0)) * (1.0 / 3.0);
    const Doubles k2 = (dot(w1, twice_nh) + dot(w0, n1)) * (1.0 / 3.0);
    // bounds take longer than signs: only where some lane has one sign; with a roundoff of zero they are zero
    int unsure = (1 << filled) - 1;
    const Doubles lowest_k = least(least(k0, k1), least(k2, k3)), highest_k = most(most(k0, k1), most(k2, k3));
    if (bits((lowest_k > 0.0) | (highest_k < 0.0)) & unsure) {
        Doubles bound = 0.0;
        int trusted = 255;
        if (roundoff > 0.0) {
            const Vectors u = sizes(u0, u1), v = sizes(v0, v1), w = sizes(w0, w1);
            const Vectors uv = {u.y * v.z + u.z * v.y, u.z * v.x + u.x * v.z, u.x * v.y + u.y * v.x};
            const Vectors size = plus(plus(u, v), w);
            const Doubles extent = most(most(size.x, size.y), size.z);
            bound = roundoff * (coplanarity_error * dot(w, uv) + underflow) + flushed * extent * extent;
            trusted = bits(extent < largest_size);
        }
        unsure &= ~(bits((lowest_k > bound) | (highest_k < -bound)) & trusted);
        if (!unsure)
            continue;
    }

    // separating direction
    const Vectors us = plus(u0, u1), vs = plus(v0, v1), ws = plus(w0, w1);
    const Vectors direction =
        vertex_face ? minus(ws, times(1.0 / 3.0, plus(us, vs))) : plus(ws, times(0.5, minus(vs, us)));
    const Gap gap = gap_along(r, direction);
    if (bits((gap.low > 0.0) | (gap.high < 0.0)) & unsure) {
        Doubles slack = 0.0;
        int trusted = 255;
        if (roundoff > 0.0) {
            const Vectors along = sizes(direction, direction);
            const Vectors size = plus(plus(sizes(u0, u1), sizes(v0, v1)), sizes(w0, w1));
            slack =
                roundoff * (direction_error * dot(along, size) + underflow) + flushed * (along.x + along.y + along.z);
            trusted = bits(most(most(size.x, size.y), size.z) < largest_size);
        }
        unsure &= ~(bits((gap.low > slack) | (gap.high < -slack)) & trusted);
    }
    for (int lane = 0; lane < filled; ++lane)
        left |= (unsigned long long)((unsure >> lane) & 1) << near[begin + lane];
}
return left;
