"""Reads moving meshes from USD files. OpenUSD is imported only here; Warp is not imported."""
