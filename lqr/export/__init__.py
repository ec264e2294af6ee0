"""Controllers as C99 for robots, by the writer of :mod:`softgrasp.reduction.export`."""
