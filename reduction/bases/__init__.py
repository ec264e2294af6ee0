"""Bases from snapshots: states, inner products, factorisations, POD, symplectic ones, Craig-Bampton, by name."""
