"""The measurements: what they run, and what a row of their tables has."""
