"""Marks of tests of what the oldest versions of Newton that the package supports lack."""

import newton
import pytest

HAS_OBSERVABLES = hasattr(newton.solvers.SolverBase, "observables")
"""Whether solvers have observables: those of Newton 1.6 have none."""

HAS_ATTACHMENTS = hasattr(newton.ModelBuilder, "add_attachment_particle_body")
"""Whether particles can be attached to bodies: not in Newton 1.6."""

needs_attachments = pytest.mark.skipif(
    not HAS_ATTACHMENTS, reason="Newton 1.6 has no attachments of particles to bodies"
)

HAS_HARD_ATTACHMENTS = HAS_ATTACHMENTS and not newton.__version__.startswith("1.7.")
"""Whether their stiffness may be infinite: Newton 1.7 refuses it."""

needs_hard_attachments = pytest.mark.skipif(
    not HAS_HARD_ATTACHMENTS, reason="Newton before 1.8 has no attachments of infinite stiffness"
)
