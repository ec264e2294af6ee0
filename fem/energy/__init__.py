"""Energies of the user's own, written in UFL: translated, checked at rest, compiled for the points of finite strain."""
