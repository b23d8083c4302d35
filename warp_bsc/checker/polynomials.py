"""Polynomials in time: lists of coefficients, constant first, integers in exact arithmetic, arrays in the filter."""

import functools
import itertools


def add(f, g):
    """Returns the sum of two polynomials."""
    return [a + b for a, b in itertools.zip_longest(f, g, fillvalue=0)]


def multiply(f, g):
    """Returns the product of two polynomials."""
    product = [0] * (len(f) + len(g) - 1)
    for i, a in enumerate(f):
        for j, b in enumerate(g):
            product[i + j] = product[i + j] + a * b
    return product


def dot(x, y):
    """Returns the scalar product of two vectors of polynomials."""
    return functools.reduce(add, map(multiply, x, y))


def negate(f):
    """Returns the negative of a polynomial."""
    return [-a for a in f]


def cross(x, y):
    """Returns the cross product of two vectors of three polynomials."""
    minus_y = [negate(f) for f in y]
    return [add(multiply(x[i], y[j]), multiply(x[j], minus_y[i])) for i, j in ((1, 2), (2, 0), (0, 1))]


def triangle_areas(x, y, z):
    """Returns the vectors X, Y, Z of the docstring of :mod:`warp_bsc.checker`."""
    return cross(y, z), cross(z, x), cross(x, y)


def triangle_weights(areas):
    """Returns n.X, n.Y and n.Z, the barycentric coordinates of the origin times n.n."""
    normal = [functools.reduce(add, components) for components in zip(*areas, strict=True)]
    return [dot(normal, area) for area in areas]


def trim(f):
    """Returns the polynomial without leading zeros; the zero polynomial is the empty list."""
    degree = len(f)
    while degree and f[degree - 1] == 0:
        degree -= 1
    return f[:degree]


def differentiate(f):
    """Returns the derivative of a polynomial."""
    return [i * a for i, a in enumerate(f)][1:]


def sign_at(f, time):
    """Returns the sign of f at a time: an int, a Fraction or a float, taken exactly."""
    return sign_at_ratio(f, *time.as_integer_ratio())


def sign_at_ratio(f, numerator, denominator):
    """Returns the sign of f at a fraction of a positive denominator."""
    value, power = 0, 1
    for a in reversed(f):  # Horner's rule, times denominator^degree
        value = value * numerator + a * power
        power *= denominator
    return (value > 0) - (value < 0)
