"""From prims of a USD stage to the positions of their meshes: schemas, instances, skinning, clips and topology."""
