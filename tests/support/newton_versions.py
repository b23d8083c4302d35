"""Marks of tests of what the oldest versions of Newton that the package supports lack."""

import inspect

import newton
import pytest

__all__ = ["HAS_OBSERVABLES", "needs_attachments", "needs_truncation_before_shapes"]

HAS_OBSERVABLES = hasattr(newton.solvers.SolverBase, "observables")
"""Whether solvers have observables: those of Newton 1.6 have none."""

needs_attachments = pytest.mark.skipif(
    not hasattr(newton.ModelBuilder, "add_attachment_particle_body"),
    reason="Newton 1.6 has no attachments of particles to bodies",
)

needs_truncation_before_shapes = pytest.mark.skipif(
    "rigid_soft_enable_dat" not in inspect.signature(newton.solvers.SolverVBD).parameters,
    reason="VBD of Newton 1.6 does not truncate before shapes",
)
