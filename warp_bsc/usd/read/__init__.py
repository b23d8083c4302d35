"""From prims of a stage to the positions of their meshes: schemas, instances, skinning, clips and topology."""
