"""Gradients through implicit time steps, by the implicit function theorem."""
