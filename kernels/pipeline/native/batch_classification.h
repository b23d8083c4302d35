// The body of classify_batch; after simd_query.h and simd_roots.h.

auto classify_piece = [&](Curve y, const InsideTests& tests, int extremum, int lanes) -> Status {
    const Signs ends = product(y.start, sign(y.k.k3, y.bound));
    y.one = ends.negative & lanes;
    y.two = 0;
    int none = ends.positive & ~extremum;
    int turning = ends.positive & extremum & lanes;
    if (turning) {
        const Doubles d0 = y.d.x, d1 = y.d.y, d2 = y.d.z;
        const int away = product(sign(d0, difference_of_cubic * y.bound), y.start).positive;
        none |= turning & away;
        turning &= ~away;
        const Doubles a = absolute(d0), b = absolute(d2), sum = a + b;
        const Doubles leading = (d2 - d1) - (d1 - d0);
        const Doubles spread = absolute(leading) + turning_error * y.bound;
        const Doubles value = evaluate_cubic(y.k, a, b);
        const Doubles rounding = 2.0 * y.bound * sum * sum * sum + underflow * y.bound;
        const Doubles deviation = 7.0 * (0.25 * spread) * (0.25 * spread) * sum * sum;
        y.two = turning & product(sign(value, rounding), y.start).negative;
        turning &= ~y.two;
        const int beside = turning & product(sign(value, rounding + deviation), y.start).positive;
        none |= beside;
        turning &= ~beside;
        if (turning) {
            const Doubles t0 = leading * y.k.k0 - (d1 - d0) * d0, t1 = leading * y.k.k3 - (d2 - d1) * d2;
            const Doubles t_bound = y.bound * (turning_error * y.size + underflow);
            const Signs s0 = sign(t0, t_bound), s1 = sign(t1, t_bound);
            const Doubles ta = absolute(t0), tb = absolute(t1);
            const Doubles side_bound =
                (ta + tb) * (6.0 * y.bound * (ta + tb) + slope_crossing_error * y.size * t_bound) + underflow * y.bound;
            const Signs side = sign(evaluate_quadratic(y.d, ta, tb), side_bound);
            const int as_slope = product(side, sign(d0, y.bound)).positive;
            const int split = product(s0, s1).negative, same = product(s0, s1).positive;
            const int decided = same | (split & known(side));
            Signs at = chosen(split & as_slope, s1, s0);
            at = product({at.positive & decided, at.negative & decided}, sign(leading, turning_error * y.bound));
            at = product(at, y.start);
            none |= turning & at.positive;
            y.two |= turning & at.negative;
        }
    }
    const int rooted = y.one | y.two;
    Status status = {none, 0};
    if (!rooted)
        return status;
    Signs first[4], last[4];
    for (int i = 0; i < 4; ++i) {
        const Ends found = chord_signs(tests.q[i], tests.bounds[i], y, rooted);
        first[i] = found.first, last[i] = found.last;
    }
    const int open = rooted & ~(verdict(first).free & verdict(last).free);
    for (int i = 0; i < 4; ++i) {
        const Ends found = quadratic_signs(tests.q[i], tests.bounds[i], y, {first[i], last[i]}, open);
        first[i] = found.first, last[i] = found.last;
    }
    const Status at_first = verdict(first), at_last = verdict(last);
    status.free |= at_first.free & at_last.free & rooted;
    status.hit = (at_first.hit | at_last.hit) & rooted;
    return status;
};

// the status in some lanes, from the inside tests of their axis
auto classify_with = [&](Cubic k, Doubles bound, const InsideTests& tests, int lanes) -> Status {
    const Status constant = constant_verdict(tests);
    Curve curve = curve_of(k, bound);
    const Signs ends = product(curve.start, sign(k.k3, bound));
    Status status = {constant.free, constant.hit & ends.negative & ~constant.free};
    lanes &= ~(status.free | status.hit) & known(ends);
    if (!lanes)
        return status;
    Shape shape = curve_class(curve);
    // a cubic with two extrema is split at its inflection
    const int split = lanes & shape.two_extrema;
    Doubles a, b, sum, square;
    if (split) {
        const Doubles e0 = absolute((k.k2 - k.k1) - (k.k1 - k.k0));
        const Doubles e1 = absolute((k.k3 - k.k2) - (k.k2 - k.k1));
        const Doubles scale = inverse_power_of_two(most(e0, e1));
        a = scale * e0, b = scale * e1, sum = a + b, square = sum * sum;
    }
    lanes &= shape.monotone | shape.extremum;
    Status split_status = {split, 0};
    InsideTests part_tests = tests;
    for (int part = lanes ? 0 : 1; part < (split ? 3 : 1); ++part) {
        Status found = {0, 0};
        if (part > 0) {
            const Doubles k01 = b * k.k0 + a * k.k1, k12 = b * k.k1 + a * k.k2, k23 = b * k.k2 + a * k.k3;
            const Doubles k012 = b * k01 + a * k12, k123 = b * k12 + a * k23, middle = b * k012 + a * k123;
            const Cubic part_k = part == 1 ? Cubic{square * sum * k.k0, square * k01, sum * k012, middle}
                                           : Cubic{middle, sum * k123, square * k23, square * sum * k.k3};
            for (int i = 0; i < 4; ++i) {
                const Vectors q = tests.q[i];
                const Doubles q01 = b * q.x + a * q.y, q12 = b * q.y + a * q.z, q012 = b * q01 + a * q12;
                part_tests.q[i] =
                    part == 1 ? Vectors{square * q.x, sum * q01, q012} : Vectors{q012, sum * q12, square * q.z};
                part_tests.bounds[i] = split_error * square * tests.bounds[i];
            }
            curve = curve_of(part_k, split_error * square * sum * bound);
            shape = curve_class(curve);
            found.free = one_sign(part_k, curve.bound) | constant_verdict(part_tests).free;
            lanes = split & ~found.free & known(curve.start) & known(sign(part_k.k3, curve.bound)) &
                    (shape.monotone | shape.extremum);
        }
        if (lanes) {
            const Status piece = classify_piece(curve, part_tests, shape.extremum, lanes);
            found.free |= piece.free & lanes;
            found.hit |= piece.hit & lanes;
        }
        Status& into = part == 0 ? status : split_status;
        into.free = part == 0 ? status.free | found.free : split_status.free & found.free;
        into.hit |= part == 0 ? found.hit : found.hit & split;
    }
    return {status.free | split_status.free, status.hit | split_status.hit};
};

// with a roundoff of zero: the lanes that touch at the start or at the end
auto touching = [&](Cubic k, const InsideTests& tests) -> int {
    auto weakly_inside = [&](Doubles a, Doubles b, Doubles c, Doubles d) {
        const Doubles low = least(least(a, b), least(c, d)), high = most(most(a, b), most(c, d));
        return ((low >= 0.0) & (high > 0.0)) | ((high <= 0.0) & (low < 0.0));
    };
    const Vectors* q = tests.q;
    return bits(((k.k0 == 0.0) & weakly_inside(q[0].x, q[1].x, q[2].x, q[3].x)) |
                ((k.k3 == 0.0) & weakly_inside(q[0].z, q[1].z, q[2].z, q[3].z)));
};
auto without_zeros = [&](Cubic k) -> Cubic {
    const Doubles tiny = tiny_share * curve_of(k, Doubles(0.0)).size;
    const Doubles start = where(k.k1 != 0.0, k.k1, where(k.k2 != 0.0, k.k2, k.k3));
    const Doubles end = where(k.k2 != 0.0, k.k2, where(k.k1 != 0.0, k.k1, k.k0));
    return {where(k.k0 == 0.0, where(start < 0.0, -tiny, tiny), k.k0), k.k1, k.k2,
            where(k.k3 == 0.0, where(end < 0.0, -tiny, tiny), k.k3)};
};

unsigned long long statuses = 0;
for (int begin = 0; begin < count; begin += 8) {
    const int filled = count - begin < 8 ? count - begin : 8;
    const int all = (1 << filled) - 1;
    int usable = all;
    const Motion motion = scaled_motion(read_points([&](int lane) { return first + begin + lane; }, filled), usable);
    const Coplanarity y = coplanarity(motion);
    int free = one_sign(y.k, y.bound), hit = 0, left = usable & ~free;
    if (left) {
        const InsideTests tests = inside_tests(motion, y, largest_axis(plus(plus(plus(y.n0, y.nh), y.nh), y.n1)));
        Cubic k = y.k;
        int lanes = left;
        for (int attempt = 0; attempt < 2 && lanes; ++attempt) {
            const Status found = classify_with(k, y.bound, tests, lanes);
            free |= found.free & lanes;
            hit |= found.hit & ~found.free & lanes;
            left &= ~(free | hit);
            if (roundoff > 0.0)
                break;
            // signs that floating point computes: zeros at the ends need no subdivision
            lanes = left & bits((k.k0 == 0.0) | (k.k3 == 0.0));
            if (!lanes)
                break;
            hit |= touching(k, tests) & lanes;
            k = without_zeros(k);
            free |= one_sign(k, Doubles(0.0)) & lanes & ~hit;
            left &= ~(free | hit);
            lanes = left & lanes;
        }
        if (left && !(roundoff > 0.0)) {
            const Vectors u = plus(motion.u0, motion.u1), v = plus(motion.v0, motion.v1);
            const Vectors w = plus(motion.w0, motion.w1);
            const int apart = direction_separates(motion, between(closest_coordinates(u, v, w), u, v, w));
            free |= left & apart;
            hit |= left & ~apart;
        }
    }
    free &= usable, hit &= usable;
    const int unsure = usable & ~(free | hit), open = all & ~usable;
    auto spread = [](unsigned x) {
        x = (x | (x << 4)) & 0x0f0fu;
        x = (x | (x << 2)) & 0x3333u;
        return (x | (x << 1)) & 0x5555u;
    };
    const unsigned long long packet = spread(hit | open) | (spread(unsure | open) << 1);
    statuses |= packet << (2 * begin);
}
return statuses;
