"""Reduced models with contact: few columns, and static answers of the nodes that may touch; their compiled run."""
