"""Benchmarks against other codes, and of the limits in the source."""

import softgrasp as softgrasp  # before numpy: it keeps each rank to one thread
