// The body of cull_arc_batch; after simd_query.h.

auto norm_bound = [=](Vectors a) { return __builtin_elementwise_sqrt(dot(a, a)) * inflated; };
auto to_multiple = [](Doubles time) { return (time + 0x1p12) - 0x1p12; };  // of 2^-40
constexpr int corner_count = vertex_face ? 3 : 4;
struct Corners {
    Doubles x[4];
};
// the products of a direction with the differences of points of the two features
auto corners_along = [=](Vectors direction, Vectors u, Vectors v, Vectors w) -> Corners {
    const Doubles du = dot(direction, u), dv = dot(direction, v), dw = dot(direction, w);
    if (vertex_face)
        return {dw, dw - du, dw - dv, dw};
    return {dw, dw - du, dw + dv, dw - du + dv};
};
// the motion of eight pairs, and the distances that they must keep
struct Packet {
    Motion motion;
    Doubles kept;
    int all, usable;
};
auto read_packet = [&](auto which, int filled) -> Packet {
    auto slot = [&](int lane) { return first + which(lane < filled ? lane : 0); };
    Doubles distance;
    for (int lane = 0; lane < 8; ++lane) {
        const Four corner = corners_of(slot(lane));
        const double* of = (const double*)deviation.data;
        const double a = of[corner[0]], b = of[corner[1]], other = most(of[corner[2]], of[corner[3]]);
        distance[lane] = vertex_face ? a + most(b, other) : most(a, b) + other;
    }
    const int all = (1 << filled) - 1;
    int usable = all;
    const Motion motion = scaled_motion(read_points(slot, filled), usable);
    return {motion, most(above_sum * (distance * motion.scale), Doubles(smallest)), all, usable};
};

int open[64], open_count = 0;
for (int begin = 0; begin < count; begin += 8) {
    const int filled = count - begin < 8 ? count - begin : 8;
    const Packet packet = read_packet([&](int lane) { return begin + lane; }, filled);
    const Motion& motion = packet.motion;
    const Coplanarity y = coplanarity(motion);
    const Doubles error = normal_error * roundoff * (y.uv.x + y.uv.y + y.uv.z) + roundoff * underflow;
    const Doubles norm_0 = norm_bound(y.n0) + error, norm_h = norm_bound(y.nh) + error;
    const Doubles norm_1 = norm_bound(y.n1) + error, far = packet.kept * inflated, y_bound = plane_error * y.bound;
    const Doubles far_1 = far * ((norm_0 + 2.0 * norm_h) * (1.0 / 3.0));
    const Doubles far_2 = far * ((2.0 * norm_h + norm_1) * (1.0 / 3.0));
    auto above = [&](Cubic k) {
        return least(least(k.k0 - far * norm_0, k.k1 - far_1), least(k.k2 - far_2, k.k3 - far * norm_1)) > y_bound;
    };
    const Cubic k = y.k;
    int unsure = packet.all & ~(bits(above(k) | above({-k.k0, -k.k1, -k.k2, -k.k3})) & packet.usable);
    const Vectors size = plus(plus(motion.u_size, motion.v_size), motion.w_size);
    if (unsure) {
        const Vectors direction = centroid_direction(motion);
        const auto gaps = gaps_along(motion, direction);
        const Doubles bound = gap_bound(size, direction), needed = packet.kept * norm_bound(direction);
        unsure &= ~(bits((gaps.lowest - bound > needed) | (-gaps.highest - bound > needed)) & packet.usable);
    }
    for (; unsure; unsure &= unsure - 1)
        open[open_count++] = begin + __builtin_ctz(unsure);
}

unsigned long long left = 0;
for (int begin = 0; begin < open_count; begin += 8) {
    const int filled = open_count - begin < 8 ? open_count - begin : 8;
    const Packet packet = read_packet([&](int lane) { return open[begin + lane]; }, filled);
    const Motion& motion = packet.motion;
    int unsure = packet.all;
    // directions between the closest points at some times: each clears the times around its own until a corner
    // comes within the distance along it; those before start and after limit are clear
    Doubles start = 0.0, limit = 1.0;
    for (int round = 0; round < rounds && unsure; ++round) {
        const Doubles time = round == 0 ? start : round == 1 ? limit : to_multiple(0.5 * (start + limit));
        auto at = [&](Vectors a, Vectors b) { return plus(times(1.0 - time, a), times(time, b)); };
        const Vectors u = at(motion.u0, motion.u1), v = at(motion.v0, motion.v1), w = at(motion.w0, motion.w1);
        Vectors direction = between(closest_coordinates(u, v, w), u, v, w);
        if (!vertex_face)
            direction = times(-1.0, direction);
        const Corners first = corners_along(direction, motion.u0, motion.v0, motion.w0);
        const Corners last = corners_along(direction, motion.u1, motion.v1, motion.w1);
        const Vectors size = plus(plus(motion.u_size, motion.v_size), motion.w_size);
        const Doubles bound = gap_bound(size, direction), needed = packet.kept * norm_bound(direction);
        const Doubles more = needed * away + 2.0 * bound;
        Doubles from = start, until = limit;
        for (int i = 0; i < corner_count; ++i) {
            const Doubles crossing = (more - first.x[i]) / (last.x[i] - first.x[i]);
            from = where(first.x[i] < more, most(from, crossing), from);
            until = where(last.x[i] < more, least(until, crossing), until);
        }
        // proposed, and now checked
        from = where(from > start, to_multiple(from + shortest), start);
        until = where(until < limit, to_multiple(until - shortest), limit);
        auto is_clear = [&](Doubles t) -> Longs {
            Doubles low = (1.0 - t) * first.x[0] + t * last.x[0];
            for (int i = 1; i < corner_count; ++i)
                low = least(low, (1.0 - t) * first.x[i] + t * last.x[i]);
            return low - bound > needed;
        };
        const Longs whole = (from < until) & is_clear(from) & is_clear(until);
        const Longs advances = whole & (from == start), recedes = whole & (until == limit);
        start = where(advances, until, start);
        limit = where(recedes, from, limit);
        unsure &= ~(bits(start >= limit) & packet.usable);
    }
    for (; unsure; unsure &= unsure - 1)
        left |= 1ull << open[begin + __builtin_ctz(unsure)];
}
return left;
