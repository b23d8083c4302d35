"""Whether pairs collide on arcs, by interval arithmetic: proofs, not samples.

A part of the step is free of a collision if the coplanarity, or what says that a point is within an element, has one
sign over all of it, by intervals; for coplanarity the mean value theorem as well, with its derivative over the part. It
has a collision if the point is within the element all the time, and coplanarity has different signs at its ends. Parts
that are neither are halved. NumPy decides nearly all pairs at once, with each operation rounded outwards; mpmath
decides the others, with 50 digits and much shorter parts.

Coordinates are taken as exact, and motions as of :class:`warp_bsc.RigidMotion`.
"""

from dataclasses import dataclass

import numpy as np

FREE, HIT, UNDECIDED = 0, 1, 2
_NUMPY_LEVELS, _MPMATH_LEVELS = 26, 60
_CHUNK = 8192
_SINE_ERROR = 2.0**-50  # of NumPy's sine and cosine, with room to spare


@dataclass
class Pairs:
    """Pairs of one kind, each with its own two bodies.

    Attributes:
        kind: "vertex_face" or "edge_edge".
        x0: Points at the start, p a b c or a b c d, float64, shape [n, 4, 3].
        x1: Points at the end.
        centre: A point of the axis of each body at the start, shape [n, 2, 3].
        turn: Axis of each body times its turn [rad], shape [n, 2, 3].
    """

    kind: str
    x0: np.ndarray
    x1: np.ndarray
    centre: np.ndarray
    turn: np.ndarray

    def __len__(self):
        return len(self.x0)

    @property
    def body(self):
        """Which of its bodies each point belongs to."""
        return np.array([0, 1, 1, 1] if self.kind == "vertex_face" else [0, 0, 1, 1])

    def rows(self, which):
        """Some of the pairs."""
        return Pairs(self.kind, self.x0[which], self.x1[which], self.centre[which], self.turn[which])


@dataclass
class Truth:
    """What is known of pairs: FREE, HIT or UNDECIDED, and the end of a part with a collision, 2 if there is none."""

    status: np.ndarray
    before: np.ndarray


class Interval:
    """Closed intervals of real numbers, as arrays of their ends; each operation is rounded outwards."""

    def __init__(self, low, high=None):
        self.low, self.high = low, low if high is None else high

    @staticmethod
    def around(low, high):
        return Interval(np.nextafter(low, -np.inf), np.nextafter(high, np.inf))

    def __add__(self, other):
        return Interval.around(self.low + other.low, self.high + other.high)

    def __sub__(self, other):
        return Interval.around(self.low - other.high, self.high - other.low)

    def __mul__(self, other):
        products = self.low * other.low, self.low * other.high, self.high * other.low, self.high * other.high
        return Interval.around(np.minimum.reduce(products), np.maximum.reduce(products))

    def __getitem__(self, index):
        return Interval(self.low[index], self.high[index])


def _sine(x):
    """The sine of intervals of angles from 0 on."""
    values = np.sin(x.low), np.sin(x.high)
    low, high = np.minimum(*values) - _SINE_ERROR, np.maximum(*values) + _SINE_ERROR
    for extreme, place in ((1.0, 0.25), (-1.0, 0.75)):  # in turns; the margin is more than the rounding
        turns = np.floor(x.low / (2.0 * np.pi) - place - 1e-9), np.floor(x.high / (2.0 * np.pi) - place + 1e-9)
        reached = turns[1] > turns[0]
        low = np.where(reached & (extreme < 0.0), -1.0, low)
        high = np.where(reached & (extreme > 0.0), 1.0, high)
    return Interval(np.maximum(low, -1.0), np.minimum(high, 1.0))


def _cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _minus(a, b):
    return [x - y for x, y in zip(a, b, strict=True)]


def _features(kind, points):
    """Coplanarity, and what is all positive where points are within their elements, for any numbers."""
    a, b, c, d = points
    if kind == "vertex_face":
        u, v, w = _minus(c, b), _minus(d, b), _minus(a, b)
        n = _cross(u, v)
        first, second = _dot(_cross(w, v), n), _dot(_cross(u, w), n)
        return _dot(w, n), [first, second, _dot(n, n) - first - second]
    u, v, w = _minus(b, a), _minus(d, c), _minus(c, a)
    n = _cross(u, v)
    first, second, size = _dot(_cross(w, v), n), _dot(_cross(w, u), n), _dot(n, n)
    return _dot(w, n), [first, size - first, second, size - second]


def _slope(kind, points, velocities):
    """The derivative of coplanarity."""
    vectors = []
    for a, b, c, d in (points, velocities):
        if kind == "vertex_face":
            vectors.append((_minus(c, b), _minus(d, b), _minus(a, b)))
        else:
            vectors.append((_minus(b, a), _minus(d, c), _minus(c, a)))
    (u, v, w), (du, dv, dw) = vectors
    return _dot(dw, _cross(u, v)) + _dot(w, _cross(du, v)) + _dot(w, _cross(u, dv))


class _Paths:
    """Constants of the paths of the points of pairs, as intervals."""

    def __init__(self, pairs):
        exact = lambda values: [Interval(values[..., axis]) for axis in range(3)]  # noqa: E731
        body = pairs.body
        turn, centre = pairs.turn[:, body], pairs.centre[:, body]
        length = np.linalg.norm(turn, axis=-1)
        self.angle = Interval(length * (1.0 - 2.0**-50), length * (1.0 + 2.0**-50))
        size = np.where(length > 0.0, length, 1.0)
        inverse = Interval((1.0 - 2.0**-49) / size, (1.0 + 2.0**-49) / size)
        self.start, self.end = exact(pairs.x0), exact(pairs.x1)
        axis = [value * inverse for value in exact(turn)]
        self.across = _cross(axis, _minus(self.start, exact(centre)))
        self.inward = _cross(axis, self.across)
        self.sine = _sine(self.angle)
        self.versine = _versine(self.angle)

    def at(self, which, time):
        """The points of some pairs at intervals of times, each as three coordinates."""
        one = Interval(np.ones_like(time.low))
        straight = [x[which] * (one - time) + y[which] * time for x, y in zip(self.start, self.end, strict=True)]
        angle = self.angle[which] * time
        sine = _sine(angle) - time * self.sine[which]
        versine = _versine(angle) - time * self.versine[which]
        terms = zip(straight, self.across, self.inward, strict=True)
        x = [s + sine * p[which] + versine * q[which] for s, p, q in terms]
        return [[value[:, j] for value in x] for j in range(4)]

    def velocities(self, which, time):
        """The velocities of some pairs at intervals of times, each as three coordinates."""
        angle = self.angle[which]
        of_sine = angle * _sine(Interval.around(*_quarter_more(angle * time))) - self.sine[which]
        of_versine = angle * _sine(angle * time) - self.versine[which]
        ways = [y[which] - x[which] for x, y in zip(self.start, self.end, strict=True)]
        v = [
            w + of_sine * p[which] + of_versine * q[which]
            for w, p, q in zip(ways, self.across, self.inward, strict=True)
        ]
        return [[value[:, j] for value in v] for j in range(4)]


def _quarter_more(x):
    """Ends of angles and a quarter of a turn, of which the sine is the cosine."""
    return x.low + (0.5 * np.pi - 1e-15), x.high + (0.5 * np.pi + 1e-15)


def _versine(x):
    """1 - cos, as twice the square of the sine of half."""
    half = _sine(Interval(0.5 * x.low, 0.5 * x.high))
    square = half * half
    return Interval(np.maximum(2.0 * square.low, 0.0), 2.0 * square.high)


def decide_by_numpy(pairs: Pairs, levels: int = _NUMPY_LEVELS) -> Truth:
    """Decides pairs all at once, in parts of the step of at least 2^-levels."""
    n = len(pairs)
    status, before = np.full(n, FREE), np.full(n, 2.0)
    which, part = np.arange(n), np.zeros(n)
    with np.errstate(all="ignore"):
        paths = _Paths(pairs)
        for level in range(levels + 1):
            left = []
            for first in range(0, len(which), _CHUNK):
                chunk, at = which[first : first + _CHUNK], part[first : first + _CHUNK]
                start, end = at * 2.0**-level, (at + 1.0) * 2.0**-level
                free, hit = _decide_parts(pairs.kind, paths, chunk, start, end)
                status[chunk[hit]] = HIT
                np.minimum.at(before, chunk[hit], end[hit])
                left.append(first + np.flatnonzero(~free))
            left = np.concatenate(left)
            left = left[status[which[left]] != HIT]
            which, part = np.repeat(which[left], 2), np.repeat(2.0 * part[left], 2)
            part[1::2] += 1.0
            if not len(which):
                break
    status[which] = UNDECIDED
    return Truth(status, before)


def _decide_parts(kind, paths, which, start, end):
    """Which parts are free of a collision, and which have one."""
    points = paths.at(which, Interval(start[:, None], end[:, None]))
    first = points[:1] if kind == "vertex_face" else points[:2]
    second = points[len(first) :]
    free = np.zeros(len(which), dtype=bool)
    for axis in range(3):
        low, high = (min_of([p[axis].low for p in side]) for side in (first, second))
        top, other_top = (max_of([p[axis].high for p in side]) for side in (first, second))
        free |= (low > other_top) | (high > top)
    volume, inside = _features(kind, points)
    free |= (volume.low > 0.0) | (volume.high < 0.0)
    rows = np.flatnonzero(~free)
    middle = Interval(0.5 * (start + end)[rows, None])
    time = Interval(start[rows, None], end[rows, None])
    slope = _slope(kind, [[x[rows] for x in p] for p in points], paths.velocities(which[rows], time))
    half = 0.5 * (end - start)[rows]
    volume = _features(kind, paths.at(which[rows], middle))[0] + slope * Interval(-half, half)
    free[rows] = (volume.low > 0.0) | (volume.high < 0.0)
    within = np.ones(len(which), dtype=bool)
    for value in inside:
        free |= value.high < 0.0
        within &= value.low > 0.0
    signs = []
    rows = np.flatnonzero(within & ~free)
    for time in (start, end):
        at_end = paths.at(which[rows], Interval(time[rows, None]))
        volume = _features(kind, at_end)[0]
        signs.append(np.sign(volume.low) + np.sign(volume.high))
    hit = np.zeros(len(which), dtype=bool)
    hit[rows] = signs[0] * signs[1] == -4.0
    return free, hit


def min_of(values):
    return np.minimum.reduce(values)


def max_of(values):
    return np.maximum.reduce(values)


def decide_by_mpmath(pairs: Pairs, row: int, levels: int = _MPMATH_LEVELS) -> tuple[int, float]:
    """Decides one pair, with 50 digits; returns its status, and the end of a part with a collision or 2."""
    from mpmath import iv  # noqa: PLC0415 (where NumPy decides all, nothing else is needed)

    iv.dps = 50
    numbers = lambda values: [[iv.mpf(float(v)) for v in point] for point in values]  # noqa: E731
    body = pairs.body
    start, end = numbers(pairs.x0[row]), numbers(pairs.x1[row])
    turn, centre = numbers(pairs.turn[row][body]), numbers(pairs.centre[row][body])
    paths = []
    for x0, x1, axis, origin in zip(start, end, turn, centre, strict=True):
        angle = iv.sqrt(_dot(axis, axis))
        unit = [v / angle for v in axis] if angle.a > 0 else axis
        across = _cross(unit, _minus(x0, origin))
        paths.append((x0, x1, angle, across, _cross(unit, across)))

    def at(time):
        points = []
        for x0, x1, angle, across, inward in paths:
            sine = iv.sin(time * angle) - time * iv.sin(angle)
            versine = 2 * iv.sin(time * angle / 2) ** 2 - time * (2 * iv.sin(angle / 2) ** 2)
            terms = zip(x0, x1, across, inward, strict=True)
            points.append([(1 - time) * a + time * b + sine * p + versine * q for a, b, p, q in terms])
        return points

    def velocities(time):
        found = []
        for x0, x1, angle, across, inward in paths:
            sine = angle * iv.cos(time * angle) - iv.sin(angle)
            versine = angle * iv.sin(time * angle) - 2 * iv.sin(angle / 2) ** 2
            terms = zip(x0, x1, across, inward, strict=True)
            found.append([b - a + sine * p + versine * q for a, b, p, q in terms])
        return found

    def sign(time):
        volume, _inside = _features(pairs.kind, at(time))
        return int(volume.a > 0) - int(volume.b < 0)

    parts, undecided = [(0, 0)], False
    while parts:
        level, part = parts.pop()
        low, high = iv.mpf(part) / 2**level, iv.mpf(part + 1) / 2**level
        time = iv.mpf([low.a, high.b])
        points = at(time)
        volume, inside = _features(pairs.kind, points)
        if volume.a > 0 or volume.b < 0 or any(value.b < 0 for value in inside):
            continue
        middle, half = iv.mpf(2 * part + 1) / 2 ** (level + 1), iv.mpf(1) / 2 ** (level + 1)
        slope = _slope(pairs.kind, points, velocities(time))
        volume = _features(pairs.kind, at(middle))[0] + slope * iv.mpf([-half.b, half.b])
        if volume.a > 0 or volume.b < 0:
            continue
        if all(value.a > 0 for value in inside) and sign(low) * sign(high) < 0:
            return HIT, float(high.b)
        if level == levels:
            undecided = True
            continue
        parts += [(level + 1, 2 * part + 1), (level + 1, 2 * part)]
    return (UNDECIDED if undecided else FREE), 2.0


def decide(pairs: Pairs) -> Truth:
    """Decides pairs by NumPy, and what it leaves by mpmath; UNDECIDED are those that touch to within all digits."""
    truth = decide_by_numpy(pairs)
    for row in np.flatnonzero(truth.status == UNDECIDED):
        truth.status[row], truth.before[row] = decide_by_mpmath(pairs, row)
    return truth
