"""Exact derivatives of a full run by its adjoint, the midpoint rule backwards with the factor of the run."""
