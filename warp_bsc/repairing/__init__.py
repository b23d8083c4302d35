"""Moves positions that cross to the nearest positions that do not, and certifies them. Guide: docs/usd/repair.md."""
