"""Riccati equations of large plants, low rank."""
