"""Reduced models with contact: static responses of the nodes that may touch beside modes, and their compiled run."""
