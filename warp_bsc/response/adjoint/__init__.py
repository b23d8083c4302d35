"""The adjoint of a step: goes back through its record."""
