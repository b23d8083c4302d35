"""Exact arithmetic on the device: wide integers, signs at algebraic numbers, and the first contact of a query."""
