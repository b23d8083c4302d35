"""Detection of vertices that move on arcs, with rigid bodies that turn."""
