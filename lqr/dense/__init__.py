"""Riccati equations of small plants, dense."""
