"""From a USD file to moving meshes. OpenUSD is imported here, Warp is not."""
