"""Reads triangle meshes from files, and writes them again with other positions and nothing else changed."""
