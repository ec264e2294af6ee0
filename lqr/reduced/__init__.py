"""The reduced Riccati equations and their gains."""
