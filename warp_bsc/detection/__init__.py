"""From a mesh and two sets of positions to collisions, on a device or in a graph."""
