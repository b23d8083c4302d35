// The body of near_signs_at_roots; after numbers.h.

const Integer* of_p[4] = {&p0, &p1, &p2, &p3};
const Integer* of_q[3] = {&c0, &c1, &leading};
Number p[4], q[3];
scale(of_p, 4, p);
scale(of_q, 3, q);
const Number c = q[0], b = q[1], a = q[2];
const Number g0 = times(a, p[0]);
const Number g1 = minus(times(a, p[1]), times(p[3], c));
const Number g2 = minus(times(a, p[2]), times(p[3], b));
const Number k0 = minus(times(g0, a), times(g2, c)), k1 = minus(times(g1, a), times(g2, b));
const int s0 = sign(k0), s1 = sign(k1);
if (s0 == 0 || s1 == 0)
    return unknown;
const auto signs = [](int first, int second) { return 3 * first + second; };
if (s0 == s1)
    return signs(s1, s1);
const Number j = minus(times(g0, b), times(g1, c));
const int inside = sign(minus(times(k0, k0), times(k1, j)));
if (inside == 0)
    return unknown;
const int at_root = -inside * s1;
if (roots == 1)
    return signs(at_root, at_root);
if (inside < 0)
    return signs(-s1, s1);
const int side = sign(minus(times(b, k1), times(by(2.0, a), k0))) * sign(a) * s1;
const int at_both = -side * s1;
return side == 0 ? unknown : signs(at_both, at_both);
