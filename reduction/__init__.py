"""Reduced bases and reduced models; imports fem only, knows matrices and vectors but no DOLFINx."""
