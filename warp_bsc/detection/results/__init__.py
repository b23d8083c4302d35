"""Collisions as results of a detection: on the host, and on the device with gradients."""
