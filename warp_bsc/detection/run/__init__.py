"""Settings of a detection, and how kernels are launched, timed and compiled."""
