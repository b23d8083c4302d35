"""Gradients through implicit time steps, by the implicit function theorem. Guide: docs/newton/gradients_vbd.md."""
