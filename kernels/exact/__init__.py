"""Exact arithmetic on the device: wide integers, and what is decided with them."""
