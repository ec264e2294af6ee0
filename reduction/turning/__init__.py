"""Reduced models in the frame of a hand that turns by any angle."""
