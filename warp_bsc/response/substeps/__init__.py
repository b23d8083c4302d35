"""Steps that are taken again in substeps of the inner solver."""
