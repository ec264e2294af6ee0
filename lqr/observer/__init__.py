"""Estimates of the tissue from measurements: the full Kalman filter, a reduced one that runs, and its judgement."""
