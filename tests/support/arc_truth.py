"""Points on arcs to 60 digits, distances of pairs at samples of a motion, and bounds of how far it is in between."""

from decimal import Decimal, localcontext

import numpy as np

from warp_bsc import RigidMotion

_DIGITS = 60


def _sine_and_cosine(angle: Decimal) -> tuple[Decimal, Decimal]:
    """Returns both of an angle by their series, halving the angle before and doubling it after."""
    halvings = 0
    while abs(angle) > Decimal("0.5"):
        angle, halvings = angle / 2, halvings + 1
    sine, cosine, term = Decimal(0), Decimal(0), Decimal(1)
    for n in range(60):
        if n % 2:
            sine += -term if n % 4 == 3 else term
        else:
            cosine += -term if n % 4 == 2 else term
        term = term * angle / (n + 1)
    for _ in range(halvings):
        sine, cosine = 2 * sine * cosine, cosine * cosine - sine * sine
    return sine, cosine


def path(x0, x1, centre, turn, time) -> list[Decimal]:
    """Returns the point of a turning body at a time, from its formula, with an error below 1e-40 of its size."""
    with localcontext() as context:
        context.prec = _DIGITS + 30
        start, end, origin, axis = ([Decimal(float(v)) for v in values] for values in (x0, x1, centre, turn))
        time = Decimal(float(time))
        angle = sum(v * v for v in axis).sqrt()
        straight = [(1 - time) * a + time * b for a, b in zip(start, end, strict=True)]
        if not angle:
            return straight
        k, r = [v / angle for v in axis], [a - c for a, c in zip(start, origin, strict=True)]
        (sine, cosine), (whole_sine, whole_cosine) = _sine_and_cosine(time * angle), _sine_and_cosine(angle)
        across = _cross(k, r)
        inward = _cross(k, across)
        factors = sine - time * whole_sine, 1 - cosine - time * (1 - whole_cosine)
        return [s + factors[0] * p + factors[1] * q for s, p, q in zip(straight, across, inward, strict=True)]


def _cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def speed_bounds(motion: RigidMotion, x0, x1) -> np.ndarray:
    """Returns a bound of the speed of each vertex, in lengths a step."""
    turn = np.where(motion.body[:, None] >= 0, motion.turn[motion.body], 0.0)
    angle = np.linalg.norm(turn, axis=1)
    r = np.linalg.norm(x0 - motion.centre[motion.body], axis=1)
    # of x' = x1 - x0 + R' r - (R(1) - I) r
    return np.linalg.norm(x1 - x0, axis=1) + (angle + 2.0) * r


def sampled_distances(kind, points) -> np.ndarray:
    """Returns the distances of pairs, from their points, shape [..., n, 3], to about 1e-12 of their size."""
    if kind == "vertex_face":
        p, a, b, c = np.moveaxis(points, -2, 0)
        best = np.minimum.reduce([_from_segment(p, *ends) for ends in ((a, b), (b, c), (c, a))])
        normal = np.cross(b - a, c - a)
        size = np.maximum(np.einsum("...i,...i", normal, normal), 1e-300)
        v = np.einsum("...i,...i", np.cross(p - a, c - a), normal) / size
        w = np.einsum("...i,...i", np.cross(b - a, p - a), normal) / size
        inside = (v >= 0) & (w >= 0) & (v + w <= 1)
        height = np.abs(np.einsum("...i,...i", p - a, normal)) / np.sqrt(size)
        return np.where(inside, height, best)
    a, b, c, d = np.moveaxis(points, -2, 0)
    best = np.minimum.reduce([_from_segment(a, c, d), _from_segment(b, c, d), _from_segment(c, a, b)])
    best = np.minimum(best, _from_segment(d, a, b))
    u, v, w = b - a, d - c, c - a
    normal = np.cross(u, v)
    size = np.maximum(np.einsum("...i,...i", normal, normal), 1e-300)
    s = np.einsum("...i,...i", np.cross(w, v), normal) / size
    r = np.einsum("...i,...i", np.cross(w, u), normal) / size
    inside = (s >= 0) & (s <= 1) & (r >= 0) & (r <= 1)
    return np.where(inside, np.abs(np.einsum("...i,...i", w, normal)) / np.sqrt(size), best)


def _from_segment(p, a, b):
    along = b - a
    size = np.maximum(np.einsum("...i,...i", along, along), 1e-300)
    t = np.clip(np.einsum("...i,...i", p - a, along) / size, 0.0, 1.0)
    return np.linalg.norm(p - a - t[..., None] * along, axis=-1)
