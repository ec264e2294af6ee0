"""Benchmarks against other codes, and of the limits in the source."""
