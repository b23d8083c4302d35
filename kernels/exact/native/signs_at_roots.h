// The body of near_signs_at_roots; after numbers.h.

const Integer* of_p[4] = {&p0, &p1, &p2, &p3};
const Integer* of_q[3] = {&c0, &c1, &leading};
Number p[4], q[3];
scale(of_p, 4, p);
scale(of_q, 3, q);
const Number g0 = q[2] * p[0], g1 = q[2] * p[1] - p[3] * q[0], g2 = q[2] * p[2] - p[3] * q[1];
const Number k0 = g0 * q[2] - g2 * q[0], k1 = g1 * q[2] - g2 * q[1], j = g0 * q[1] - g1 * q[0];
const int s0 = sign(k0), s1 = sign(k1);
if (s0 == 0 || s1 == 0)
    return unknown;
const auto signs = [](int first, int second) { return 3 * first + second; };
if (s0 == s1)
    return signs(s1, s1);
const int inside = sign(k0 * k0 - k1 * j);
if (inside == 0)
    return unknown;
const int at_root = -inside * s1;
if (roots == 1)
    return signs(at_root, at_root);
if (inside < 0)
    return signs(-s1, s1);
const int side = sign(q[1] * k1 - q[2] * k0 * 2.0) * sign(q[2]) * s1;
const int at_both = -side * s1;
return side == 0 ? unknown : signs(at_both, at_both);
