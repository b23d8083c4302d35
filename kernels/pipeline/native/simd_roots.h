// Signs at the roots of cubics, of eight queries; after simd_query.h.

auto evaluate_cubic = [](Cubic k, Doubles a, Doubles b) {
    return ((k.k0 * b + 3.0 * k.k1 * a) * b + 3.0 * k.k2 * a * a) * b + k.k3 * a * a * a;
};
auto evaluate_quadratic = [](Vectors q, Doubles a, Doubles b) { return (q.x * b + 2.0 * q.y * a) * b + q.z * a * a; };

// a cubic with one extremum at most, the signs of its ends, and the lanes in which it has one or two roots
struct Curve {
    Cubic k;
    Doubles bound, size;
    Vectors d;
    Signs start;
    int one, two;
};
struct Ends {
    Signs first, last;
};
auto linear_signs = [&](Doubles l0, Doubles l1, Doubles line_bound, const Curve& y) -> Ends {
    const Signs s0 = sign(l0, line_bound), s1 = sign(l1, line_bound);
    const int equal = ~((s0.positive ^ s1.positive) | (s0.negative ^ s1.negative));
    const Doubles a = where(lanes_of(known(s0)), absolute(l0), 4.0 * line_bound);
    const Doubles b = where(lanes_of(known(s1)), absolute(l1), 4.0 * line_bound);
    const int vague = ~(known(s0) & known(s1)) & bits(most(a, b) < 8.0 * line_bound);
    const Doubles sum = a + b, square = sum * sum;
    const Doubles y_bound = square * (2.0 * y.bound * sum + crossing_error * y.size * line_bound) + underflow * y.bound;
    const Signs side = product(sign(evaluate_cubic(y.k, a, b), y_bound), y.start);
    const Doubles slope_bound =
        sum * (2.0 * difference_of_cubic * y.bound * sum + slope_crossing_error * y.size * line_bound) +
        underflow * y.bound;
    const Signs before = product(sign(evaluate_quadratic(y.d, a, b), slope_bound), y.start);
    // with two roots, a root of the line outside of them is before or after both
    const int after_line = (y.one & side.positive) | (y.two & side.positive & before.negative);
    const int before_line = (y.one & side.negative) | (y.two & side.positive & before.positive);
    const int amid = y.two & side.negative;
    auto at = [&](int of_start, int of_end) {
        const Signs found = {((of_start & s0.positive) | (of_end & s1.positive)) & ~vague,
                             ((of_start & s0.negative) | (of_end & s1.negative)) & ~vague};
        return chosen(equal, s0, found);
    };
    return {at(before_line | amid, after_line), at(before_line, after_line | amid)};
};
// signs of a quadratic at the roots: of its coefficients, or of its chord
auto chord_signs = [&](Vectors q, Doubles q_bound, const Curve& y, int lanes) -> Ends {
    const Signs constant = quadratic_sign(q, q_bound);
    lanes &= ~known(constant);
    if (!lanes)
        return {constant, constant};
    const Doubles leading = (q.z - q.y) - (q.y - q.x);
    const Doubles chord_bound = q_bound + 0.25 * (absolute(leading) + 6.0 * q_bound);
    const Ends chord = linear_signs(q.x, q.z, chord_bound, y);
    return {chosen(lanes, chord.first, constant), chosen(lanes, chord.last, constant)};
};
// and, if some lanes have an unknown one, by division of the cubic by the quadratic
auto quadratic_signs = [&](Vectors q, Doubles q_bound, const Curve& y, Ends result, int lanes) -> Ends {
    if (!(lanes & ~(known(result.first) & known(result.last))))
        return result;
    const Doubles d0 = q.y - q.x, d1 = q.z - q.y;
    const Doubles e0 = (y.k.k2 - y.k.k1) - (y.k.k1 - y.k.k0), e1 = (y.k.k3 - y.k.k2) - (y.k.k2 - y.k.k1);
    const Doubles leading_q = d1 - d0, leading_k = e1 - e0, square = leading_q * leading_q;
    const Doubles l0 = 3.0 * e0 * leading_q - 2.0 * d0 * leading_k;
    const Doubles l1 = 3.0 * e1 * leading_q - 2.0 * d1 * leading_k;
    const Doubles r0 = square * y.k.k0 - l0 * q.x, r1 = square * y.k.k3 - l1 * q.z;
    const Doubles q_size = largest_of(q);
    const Doubles unit = y.size * q_bound + q_size * y.bound;
    const Ends factor = linear_signs(l0, l1, factor_error * unit + underflow * y.bound, y);
    const Ends rest = linear_signs(r0, r1, division_error * q_size * unit + underflow * y.bound, y);
    return {chosen(known(result.first), result.first, negated(product(factor.first, rest.first))),
            chosen(known(result.last), result.last, negated(product(factor.last, rest.last)))};
};

// the lanes in which a cubic certainly has no extremum, one, or may have two
struct Shape {
    int monotone, extremum, two_extrema;
};
auto curve_class = [&](const Curve& y) -> Shape {
    const Doubles bound = difference_of_cubic * y.bound;
    const Signs s0 = sign(y.d.x, bound), s1 = sign(y.d.y, bound), s2 = sign(y.d.z, bound);
    const Signs outer = product(s0, s2), inner = product(s0, s1);
    const Doubles discriminant = y.d.y * y.d.y - y.d.x * y.d.z;
    const int rootless = bits(discriminant < -y.bound * (discriminant_error * largest_of(y.d) + underflow));
    const int monotone = outer.positive & (inner.positive | rootless);
    return {monotone, outer.negative, outer.positive & ~monotone & inner.negative};
};
auto curve_of = [&](Cubic k, Doubles bound) -> Curve {
    const Doubles size = most(most(absolute(k.k0), absolute(k.k1)), most(absolute(k.k2), absolute(k.k3)));
    return {k, bound, size, {k.k1 - k.k0, k.k2 - k.k1, k.k3 - k.k2}, sign(k.k0, bound), 0, 0};
};
