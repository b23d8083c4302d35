"""Contacts: their detection, the rules by which they count, and the constraints and planes that they become."""
