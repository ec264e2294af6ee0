"""Reduced runs that prove their error: residual norms, bounds, two nested bases, the greedy that builds them."""
