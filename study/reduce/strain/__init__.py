"""Reduced models at finite strain."""
