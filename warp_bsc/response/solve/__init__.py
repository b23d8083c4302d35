"""Solves constraints: positions, velocities, bodies, dividing planes and truncation."""
