"""Is the closed loop stable: exact abscissa and certificates."""
