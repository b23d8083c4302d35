"""How the inner solver takes a step: as a whole, in substeps, with springs of contacts, in some worlds, in a coupled solver."""
