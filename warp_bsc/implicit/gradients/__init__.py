"""Gradients through the steps of the solver with contact inside."""
