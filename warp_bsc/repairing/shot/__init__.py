"""Repairs a USD shot: its meshes follow it in time, and leave it before and after a collision as little as needed."""
