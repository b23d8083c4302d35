"""Measurements, and the baselines that they compare with. Nothing is printed here. Results: docs/measurements.md."""
