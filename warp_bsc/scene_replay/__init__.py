"""Finds the contacts in the intervals of a scene, sums them up, and writes them to files. Guide: docs/usd/replay.md."""
