"""Finite strain of the tissue as plain arrays: laws of the material, and the points at which they are evaluated."""
