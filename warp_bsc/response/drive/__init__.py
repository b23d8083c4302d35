"""How the inner solver takes a step: whole, in substeps, with springs, in some worlds, in a coupled solver."""
