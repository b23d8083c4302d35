"""Vectors as lists of numbers of any type: exact in fractions, with many digits in decimals."""


def minus(a, b):
    """Returns the difference of two points."""
    return [i - j for i, j in zip(a, b, strict=True)]


def dot(a, b):
    """Returns the scalar product."""
    return sum(i * j for i, j in zip(a, b, strict=True))


def along(a, s, direction):
    """Returns the point at a multiple of a direction from a point."""
    return [i + s * j for i, j in zip(a, direction, strict=True)]


def cross(a, b):
    """Returns the cross product."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
