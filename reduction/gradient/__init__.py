"""Exact derivatives of runs, reduced or full, behind one name."""
