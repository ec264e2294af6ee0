"""Meshes: structured or from a file, their cells, parts and checks."""
