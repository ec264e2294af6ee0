"""Factors and solves of the tissue's matrices."""
