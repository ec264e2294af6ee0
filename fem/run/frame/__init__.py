"""Runs in the frame of a turning hand: the step with its inertia loads, and the hand, led or free."""
