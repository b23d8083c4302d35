"""The first contact of a moving triangle or polygon with the origin, exactly."""

import functools

from .polynomials import add, cross, dot, multiply, negate, sign_at, triangle_areas, triangle_weights, trim
from .roots import inner_part, isolated_roots, sign_at_root


class Triangle:
    """The polynomials of one moving triangle, see :mod:`warp_bsc.checker`; each corner is three polynomials."""

    def __init__(self, x, y, z):
        areas = triangle_areas(x, y, z)
        self.volume = trim(dot(x, areas[0]))
        self.weights = [trim(weight) for weight in triangle_weights(areas)]
        self._corners = x, y, z
        self._areas = areas

    @functools.cached_property
    def edges(self):
        """The polynomials Z.Z and x.y of each edge xy."""
        x, y, z = self._corners
        pairs = (y, z), (z, x), (x, y)
        return [(trim(dot(area, area)), trim(dot(*pair))) for area, pair in zip(self._areas, pairs, strict=True)]

    def touches(self, sign):
        """Returns whether the origin is in the triangle at the time at which sign(polynomial) gives the signs."""
        if sign(self.volume) != 0:
            return False
        signs = [sign(weight) for weight in self.weights]
        if any(signs):
            return min(signs) >= 0
        return any(sign(square) == 0 and sign(product) <= 0 for square, product in self.edges)

    def critical(self):
        """Yields the polynomials among whose roots the first time of contact is, unless it is 0, each with a test."""
        if self.volume:
            yield self.volume, self.touches
        else:
            for square, product in self.edges:
                if critical := square or product:
                    yield critical, self.touches


class Polygon:
    """The polynomials of one moving polygon and a distance, see :mod:`warp_bsc.checker`; a corner is three of them.

    Attributes:
        lines: The lines of that docstring, one for each corner, each side and the plane: the polynomial of the last
            condition, which is at most 0; those that must be positive; and those that must not be negative.
    """

    def __init__(self, corners, distance):
        minus_d2 = -distance * distance

        def line(square, length, *inside):
            positive = [trim(length)] if length != [1] else []
            last = add(square, [minus_d2 * a for a in length])
            return trim(last), positive, [trim(f) for f in inside]

        def minus(x, y):
            return [add(f, negate(g)) for f, g in zip(x, y, strict=True)]

        n = len(corners)
        sides = [(corners[i], corners[(i + 1) % n]) for i in range(n if n > 2 else n - 1)]
        areas = [cross(q, r) for q, r in sides]
        self.lines = [line(dot(q, q), [1]) for q in corners]
        for (q, r), area in zip(sides, areas, strict=True):
            e = minus(r, q)
            self.lines.append(line(dot(area, area), dot(e, e), negate(dot(q, e)), dot(r, e)))
        if n > 2:
            x, y, z = corners[:3]
            normal = cross(minus(y, x), minus(z, y))
            volume = dot(x, normal)
            self.lines.append(
                line(multiply(volume, volume), dot(normal, normal), *(dot(normal, area) for area in areas))
            )

    def touches(self, sign):
        """Returns whether the polygon is within the distance at the time at which sign(polynomial) gives the signs."""
        return any(sign(last) <= 0 and self._foot_is_inside(i, sign) for i, (last, *_) in enumerate(self.lines))

    def critical(self):
        """Yields the polynomials among whose roots the first time of contact is, unless it is 0, each with a test."""
        for i, (last, *_) in enumerate(self.lines):
            if last:
                yield last, functools.partial(self._foot_is_inside, i)

    def _foot_is_inside(self, i, sign):
        """Returns whether all conditions but the last of a line hold."""
        _, positive, inside = self.lines[i]
        return all(sign(f) > 0 for f in positive) and all(sign(f) >= 0 for f in inside)


def contacts(shape):
    """Yields times of contact of a Triangle or a Polygon, the earliest one among them.

    Yields:
        (f, lower, upper): the only root of f between two times; or (None, time, time).
    """
    if shape.touches(lambda q: sign_at(q, 0)):
        yield None, 0, 0
        return
    for critical, touches in shape.critical():
        f = inner_part(critical)
        for lower, upper in isolated_roots(f):
            if touches(lambda q, known=critical, root=(f, lower, upper): 0 if q is known else sign_at_root(q, *root)):
                yield f, lower, upper
                break
    if shape.touches(lambda q: sign_at(q, 1)):
        yield None, 1, 1
