"""What a detection found: which contacts count, and their constraints and dividing planes."""
