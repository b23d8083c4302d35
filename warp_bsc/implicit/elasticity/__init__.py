"""Energies that Newton's VBD gives to elements, a file for each kind of them, with derivatives by hand."""
