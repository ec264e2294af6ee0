"""Reduced models in the frame of a turning hand."""
