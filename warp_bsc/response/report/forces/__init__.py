"""The contacts of a step and their impulses."""
