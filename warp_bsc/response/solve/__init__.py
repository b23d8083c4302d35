"""Solves constraints: sweeps on positions and velocities, bodies, division, truncation and freezing."""
