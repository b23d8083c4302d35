"""Collision response behind Newton's solvers: step.py reads as one step, schedule.py says when it does what.

Guide: docs/newton.md.
"""
