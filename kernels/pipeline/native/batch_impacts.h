// The body of impact_batch; after simd_query.h and append.h.

auto mix = [](Doubles a, Doubles b, Doubles t) { return (1.0 - t) * a + t * b; };
auto mix_vector = [=](Vectors a, Vectors b, Doubles t) { return plus(times(1.0 - t, a), times(t, b)); };
auto restrict_quadratic = [&](Vectors q, Doubles start, Doubles end) {
    const Doubles s01 = mix(q.x, q.y, start), s12 = mix(q.y, q.z, start);
    const Doubles e01 = mix(q.x, q.y, end), e12 = mix(q.y, q.z, end);
    return Vectors{mix(s01, s12, start), mix(s01, s12, end), mix(e01, e12, end)};
};
auto restrict_cubic = [&](Cubic k, Doubles start, Doubles end) {
    const Vectors at_start = {mix(k.k0, k.k1, start), mix(k.k1, k.k2, start), mix(k.k2, k.k3, start)};
    const Vectors at_end = {mix(k.k0, k.k1, end), mix(k.k1, k.k2, end), mix(k.k2, k.k3, end)};
    const Vectors from_start = restrict_quadratic(at_start, start, end);
    return Cubic{from_start.x, from_start.y, from_start.z, restrict_quadratic(at_end, start, end).z};
};

auto restrict_motion = [&](const Motion& m, Doubles start, Doubles end) {
    Motion part = m;
    part.u0 = mix_vector(m.u0, m.u1, start), part.u1 = mix_vector(m.u0, m.u1, end);
    part.v0 = mix_vector(m.v0, m.v1, start), part.v1 = mix_vector(m.v0, m.v1, end);
    part.w0 = mix_vector(m.w0, m.w1, start), part.w1 = mix_vector(m.w0, m.w1, end);
    return part;
};

struct Query {
    Motion motion;
    Coplanarity y;
};

// status of some lanes over a part of the time
auto status_between = [&](const Query& query, Cubic k, Doubles start, Doubles end, int lanes) -> Status {
    const Doubles k_bound = cubic_error * query.y.bound;
    Status found = {one_sign(k, k_bound) & lanes, 0};
    lanes &= ~found.free;
    if (!lanes)
        return found;
    const Motion& m = query.motion;
    const Motion part = restrict_motion(m, start, end);
    const Vectors u = times(0.5, plus(part.u0, part.u1)), v = times(0.5, plus(part.v0, part.v1));
    const Vectors w = times(0.5, plus(part.w0, part.w1));
    const int crossing = product(sign(k.k0, k_bound), sign(k.k3, k_bound)).negative;
    Axes axes = largest_axis(cross(u, v));
    for (int attempt = 0; attempt < 3 && lanes; ++attempt) {
        InsideTests tests = inside_tests(m, query.y, axes);
        for (int i = 0; i < 4; ++i) {
            tests.q[i] = restrict_quadratic(tests.q[i], start, end);
            tests.bounds[i] = quadratic_error * tests.bounds[i];
        }
        const Status verdict = constant_verdict(tests);
        found.free |= verdict.free & lanes;
        found.hit |= verdict.hit & crossing & lanes;
        lanes &= ~(verdict.free | verdict.hit);
        if (attempt == 0 && lanes) {
            const int apart = direction_separates(part, between(closest_coordinates(u, v, w), u, v, w)) & lanes;
            found.free |= apart;
            lanes &= ~apart;
        }
        axes = {~(axes.one | axes.two), axes.one};
    }
    return found;
};

// a time at which a cubic with opposite signs at 0 and at 1 is about zero, in some lanes
auto approximate_root = [&](Cubic k, int lanes) -> Doubles {
    const Doubles end = newton_end * absolute(k.k3 - k.k0);
    const Longs rising = k.k0 > 0.0;
    Doubles low = 0.0, high = 1.0, t = k.k0 / (k.k0 - k.k3);
    Longs running = lanes_of(lanes);
    for (int step = 0; step < newton_steps; ++step) {
        const Doubles k01 = mix(k.k0, k.k1, t), k12 = mix(k.k1, k.k2, t), k23 = mix(k.k2, k.k3, t);
        const Doubles k012 = mix(k01, k12, t), k123 = mix(k12, k23, t), value = mix(k012, k123, t);
        running &= ~(absolute(value) <= end);
        if (!bits(running))
            break;
        const Longs before = ~((value > 0.0) ^ rising);
        low = where(running & before, t, low);
        high = where(running & ~before, t, high);
        const Doubles next = t - value / (3.0 * (k123 - k012));
        const Doubles moved = where((low < next) & (next < high), next, 0.5 * (low + high));
        t = where(running, moved, t);
    }
    return t;
};
auto approximate_extremum = [&](Cubic k) -> Doubles {
    const Doubles d0 = k.k1 - k.k0, d1 = k.k2 - k.k1, d2 = k.k3 - k.k2, zero = 0.0, one = 1.0;
    const Doubles discriminant = d1 * d1 - d0 * d2;
    const Doubles size = __builtin_elementwise_sqrt(most(discriminant, zero));
    const Doubles root = where(k.k0 > 0.0, size, -size), b = d0 - d1;
    const Longs along = b * root >= 0.0;
    const Doubles time = where(along, b + root, d0) / where(along, b - d1 + d2, b - root);
    return where(discriminant <= 0.0, zero, least(most(zero, time), one));
};

auto approximate_meeting_time = [&](const Motion& m, Doubles start, Doubles end) -> Doubles {
    const Motion part = restrict_motion(m, start, end);
    const Vectors gap = between(closest_coordinates(part.u0, part.v0, part.w0), part.u0, part.v0, part.w0);
    const Vectors direction = vertex_face ? gap : times(-1.0, gap);
    const Doubles u0 = dot(direction, part.u0), v0 = dot(direction, part.v0), w0 = dot(direction, part.w0);
    const Doubles u1 = dot(direction, part.u1), v1 = dot(direction, part.v1), w1 = dot(direction, part.w1);
    Doubles time = 1.0;
    auto first_crossing = [&](Doubles at_start, Doubles at_end) {
        time = where(at_end < 0.0, least(time, at_start / (at_start - at_end)), time);
    };
    first_crossing(w0, w1);
    first_crossing(w0 - u0, w1 - u1);
    first_crossing(vertex_face ? w0 - v0 : w0 + v0, vertex_face ? w1 - v1 : w1 + v1);
    if (!vertex_face)
        first_crossing(w0 - u0 + v0, w1 - u1 + v1);
    return time;
};

// the lanes whose features touch, but nowhere with strict signs, see batch_impacts.py
auto touching = [&](const Points& points, const Query& query, int lanes) -> int {
    typedef decltype(Scalars() == Scalars()) Words;
    auto alike = [&](int axis, int a, int b) -> Words {
        auto word = [&](int point) { return __builtin_bit_cast(Words, points.x[3 * point + axis]); };
        return (word(a) == word(b)) & (word(a + 4) == word(b + 4));
    };
    constexpr int tests_of_borders = vertex_face ? 3 : 4, omitted[2][4] = {{1, 0, 3, 2}, {2, 3, 1}};
    Vectors n = plus(plus(plus(query.y.n0, query.y.nh), query.y.nh), query.y.n1);
    int zero[4] = {}, planar = 0, rest = lanes;
    for (int axis = 0; axis < 3; ++axis) {
        int here = 0, all = rest;
        for (int i = 0; i < tests_of_borders; ++i) {
            const int a = (omitted[vertex_face][i] + 1) % 4, b = (a + 1) % 4, c = (a + 2) % 4;
            const int in_plane = bits(alike(axis, a, b) & alike(axis, b, c)) & rest;
            zero[i] |= in_plane, here |= in_plane, all &= in_plane;
        }
        // the axis of the tests is another one or, if all four points are in the plane, this one
        Doubles* of_n[3] = {&n.x, &n.y, &n.z};
        for (int other = 0; other < 3; ++other)
            *of_n[other] = where(lanes_of(other == axis ? here & ~all : all), Doubles(0.0), *of_n[other]);
        planar |= all;
        rest &= ~here;
    }
    if (rest == lanes)
        return 0;
    const Axes axes = largest_axis(n);
    const InsideTests tests = inside_tests(query.motion, query.y, axes);
    Curve curve = curve_of(query.y.k, query.y.bound);
    const Shape shape = curve_class(curve);
    curve.one = product(curve.start, sign(curve.k.k3, curve.bound)).negative & (shape.monotone | shape.extremum) &
                bits(component(n, axes) != 0.0) & lanes & ~rest;
    Signs start[4], end[4], at_root[4];
    for (int i = 0; i < 4; ++i) {
        const Vectors q = tests.q[i];
        const Doubles bound = tests.bounds[i];
        const int others = curve.one & ~zero[i];
        const Signs s = quadratic_signs(q, bound, curve, chord_signs(q, bound, curve, others), others).first;
        at_root[i] = {s.positive | zero[i], s.negative | zero[i]};
        start[i] = sign(q.x, bound), end[i] = sign(q.z, bound);
    }
    return (curve.one & verdict(at_root).hit) | (planar & (verdict(start).hit | verdict(end).hit));
};

unsigned long long open = 0, touched = 0;
int selected[batch + 8], selected_count = 0;
for (int i = 0; i < count; ++i) {
    selected[selected_count] = i;
    selected_count += timed || status.data[first + i] != HIT;
}
// the queries that are to be searched, and the numbers of their pairs
constexpr int rows = sizeof(Query) / sizeof(Doubles), rows_of_motion = sizeof(Motion) / sizeof(Doubles);
double queries[rows][batch + 8];
int numbers[batch + 8], query_count = 0;
for (int begin = 0; begin < selected_count; begin += 8) {
    const int filled = selected_count - begin < 8 ? selected_count - begin : 8;
    int usable = (1 << filled) - 1;
    const Points points = read_points([&](int lane) { return first + selected[begin + lane]; }, filled);
    const Motion motion = scaled_motion(points, usable);
    const Query query = {motion, coplanarity(motion)};
    const int touches = timed ? 0 : touching(points, query, usable);
    for (int i = 0; i < rows; ++i)
        append(queries[i] + query_count, ((const Doubles*)&query)[i], usable & ~touches);
    query_count += append(numbers + query_count, *(const Ints*)(selected + begin), usable & ~touches);
    for (int lane = 0; lane < filled; ++lane) {
        open |= (unsigned long long)(~usable >> lane & 1) << selected[begin + lane];
        touched |= (unsigned long long)(touches >> lane & 1) << selected[begin + lane];
    }
}
// puts the values at the beginning of a list into some lanes, in order
auto insert = [](Doubles into, const double* list, unsigned lanes) {
#ifdef __AVX512VL__
    typedef double Eight __attribute__((vector_size(64), aligned(8)));
    return (Doubles)__builtin_ia32_expanddf512_mask(*(const Eight*)list, (Eight)into, lanes);
#else
    for (; lanes; lanes &= lanes - 1)
        into[__builtin_ctz(lanes)] = *list++;
    return into;
#endif
};

// the search of each lane for its first contact, see first_contact
const double shortest = finest * length;
Query query = {};
double time_found[batch], time_of_contact[batch + 8];
signed char outcome[batch];
Doubles start = 0.0, end = 1.0, root = 0.0;
int ahead = 0, passing = 0, halved = 0, probing = 0, probed = 0, begun = 0, certain = 0, running = 0;
int entry[8], visits[8], next = 0;  // the next query whose search has not begun
for (;;) {
    int fresh = ~running & 255;
    while (__builtin_popcount(fresh) > query_count - next)
        fresh &= fresh - 1;
    if (fresh) {
        for (int i = 0; i < rows; ++i)
            ((Doubles*)&query)[i] = insert(((const Doubles*)&query)[i], queries[i] + next, fresh);
        for (int left = fresh; left; left &= left - 1) {
            const int lane = __builtin_ctz(left), bit = 1 << lane;
            certain = status.data[first + numbers[next]] == HIT ? certain | bit : certain & ~bit;
            entry[lane] = next++, visits[lane] = 0;
        }
        const Doubles zero = 0.0, one = 1.0, k0 = query.y.k.k0, bound = query.y.bound;
        const Longs begins = lanes_of(fresh);
        start = where(begins, zero, start), end = where(begins, one, end), root = where(begins, zero, root);
        ahead &= ~fresh, passing &= ~fresh, halved &= ~fresh, probing &= ~fresh, begun &= ~fresh, running |= fresh;
        probed = (probed & ~fresh) | (bits((k0 > bound) | (k0 < -bound)) & fresh);
    }
    if (!running)
        break;

    const Doubles width = end - start;
    const Longs in_probe = lanes_of(probing);
    const Doubles low = where(in_probe, most(root - shortest, start), start);
    const Doubles high = where(in_probe, least(root + shortest, end), end);
    const Cubic k = restrict_cubic(query.y.k, low, high);
    const int known_hit = certain & ~begun;
    Status current = status_between(query, k, low, high, running & ~known_hit);
    current.hit |= known_hit;
    begun |= running;
    const int unsure = running & ~(current.free | current.hit);
    const Doubles half = shortest * __builtin_elementwise_floor(0.5 * width / shortest);

    const int probe_unsure = probing & unsure, probe_done = probing & running & ~unsure;
    const int others = running & ~probing, found = others & current.hit & bits(width <= length);
    const int passed = others & current.free, over = passed & bits(end == 1.0), go_on = passed & ~over;
    int search = others & ~(found | passed);
    const Doubles k_size = most(most(absolute(k.k0), absolute(k.k1)), most(absolute(k.k2), absolute(k.k3)));
    const Longs is_planar = k_size <= cubic_error * query.y.bound;
    const int stuck = search & bits((width <= shortest) | ((width <= planar * length) & is_planar));
    search &= ~stuck;
    const int probe = search & bits(start == 0.0) & ~probed;
    search &= ~probe;

    Doubles next_start = where(lanes_of(go_on), end, start), next_end = end;
    if (go_on) {
        const Doubles one = 1.0, ahead_by = length;
        const Doubles step = where(lanes_of(ahead), ahead_by, where(lanes_of(halved), width, width + width));
        const Doubles until = where(lanes_of(passing), one, least(next_start + step, one));
        next_end = where(lanes_of(go_on), until, next_end);
    }
    int halve = probe_done, to_probe = probe, look_ahead = 0, pass = go_on & ahead;
    const int renewed = go_on | search;
    if (search) {
        const int turning = search & ~bits(k.k0 * k.k3 < 0.0);
        Doubles time = approximate_root(k, search & ~turning);
        if (turning)
            time = where(lanes_of(turning), approximate_extremum(k), time);
        if (search & bits(is_planar))
            time = where(is_planar, approximate_meeting_time(query.motion, start, end), time);
        const Doubles at = start + shortest * __builtin_elementwise_floor(width * time / shortest);
        root = where(lanes_of(search), at, root);
        const int wide = bits(width > length);
        const int astray = search & (~bits((time > 0.0) & (time < 1.0)) | (probed & ~wide));
        halve |= astray;
        search &= ~astray;
        const Doubles before_root = root - 0.5 * length;
        look_ahead = search & bits(before_root > start);
        next_end = where(lanes_of(look_ahead), before_root, next_end);
        search &= ~look_ahead;
        next_end = where(lanes_of(search & wide), start + length, next_end);
        pass |= search & wide;
        to_probe |= search & ~wide;
    }
    next_end = where(lanes_of(halve), start + half, next_end);

    const int ended = found | over | probe_unsure | stuck;
    int done = ended;
    for (int lane = 0; lane < 8; ++lane)
        done |= ((running >> lane) & 1) && ++visits[lane] == max_visits ? 1 << lane : 0;
    for (int left = done; left; left &= left - 1) {
        const int lane = __builtin_ctz(left), bit = 1 << lane, e = entry[lane];
        // a hit that is free is possible only with signs that floating point computes: its only lower bound is 0
        const bool refuted = over & certain & bit;
        outcome[e] = found & bit ? HIT : (over & bit) && !refuted ? FREE : UNSURE;
        time_found[e] = refuted ? 0.0 : over & bit ? 2.0 : ended & bit ? start[lane] : next_start[lane];
        time_of_contact[e] = time_found[e];
        if (found & bit) {
            const double t = k.k0[lane] / (k.k0[lane] - k.k3[lane]);
            time_of_contact[e] = (1.0 - t) * start[lane] + t * end[lane];
        }
    }
    probing = (probing & ~probe_done) | to_probe;
    probed = (probed & ~go_on) | probe_done;
    halved = (halved & ~renewed) | halve;
    ahead = (ahead & ~renewed) | look_ahead;
    passing = (passing & ~renewed) | pass;
    start = next_start;
    end = next_end;
    running &= ~done;
}

auto contact_at = [&](const Motion& m, Doubles t, Coordinates& at) -> Vectors {
    const Vectors u = mix_vector(m.u0, m.u1, t), v = mix_vector(m.v0, m.v1, t), w = mix_vector(m.w0, m.w1, t);
    auto unit_scale = [&](Vectors a) {
        const Doubles size = largest_of(a);
        const Doubles divisor = where(size > 0.0, size, Doubles(1.0));
        return Vectors{a.x / divisor, a.y / divisor, a.z / divisor};
    };
    auto select = [&](Longs lanes, Vectors a, Vectors b) {
        return Vectors{where(lanes, a.x, b.x), where(lanes, a.y, b.y), where(lanes, a.z, b.z)};
    };
    at = closest_coordinates(u, v, w);
    const Vectors velocity = unit_scale(between(at, minus(m.u1, m.u0), minus(m.v1, m.v0), minus(m.w1, m.w0)));
    const Vectors unit_u = unit_scale(u), unit_v = unit_scale(v);
    Vectors normal = cross(unit_u, unit_v);
    normal = select(dot(normal, normal) <= flat * dot(unit_u, unit_u) * dot(unit_v, unit_v), velocity, normal);
    const Doubles zero = 0.0, one = 1.0;
    normal = select(dot(normal, normal) == 0.0, Vectors{zero, zero, one}, normal);
    normal = select(dot(normal, velocity) > 0.0, times(-1.0, normal), normal);
    const Doubles size = __builtin_elementwise_sqrt(dot(normal, normal));
    return Vectors{normal.x / size, normal.y / size, normal.z / size};
};
typedef wp::vec_t<3, double> Point;
for (int begin = 0; begin < query_count; begin += 8) {
    const int filled = query_count - begin < 8 ? query_count - begin : 8;
    Vectors normals;
    Coordinates at;
    if (timed) {
        Motion motion;
        for (int i = 0; i < rows_of_motion; ++i)
            __builtin_memcpy((Doubles*)&motion + i, queries[i] + begin, sizeof(Doubles));
        Doubles t;
        __builtin_memcpy(&t, time_of_contact + begin, sizeof(t));
        normals = contact_at(motion, t, at);
    }
    for (int lane = 0; lane < filled; ++lane) {
        const int i = first + numbers[begin + lane], e = begin + lane;
        if (outcome[e] != UNSURE)
            status.data[i] = outcome[e];
        if (!timed)
            continue;
        within_tolerance.data[i] = outcome[e] == HIT;
        toi.data[i] = time_found[e];
        if (outcome[e] == FREE)
            continue;
        const double a = at.first[lane], b = at.second[lane];
        coordinates.data[i] = vertex_face ? Point(1.0 - a - b, a, b) : Point(a, b, 0.0);
        normal.data[i] = Point(normals.x[lane], normals.y[lane], normals.z[lane]);
    }
}
return {open, touched};
