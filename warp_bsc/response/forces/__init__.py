"""Contact forces: what contacts did to momentum in a step, by contact, particle, body, shape and world."""
