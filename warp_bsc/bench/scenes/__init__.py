"""The scenes that benchmarks measure, read from files or generated."""
