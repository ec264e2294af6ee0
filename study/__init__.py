"""Across the packages: command line, pictures, reports, accuracy against time."""
