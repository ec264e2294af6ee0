"""Reduced models with contact: `softgrasp reduce` of scenes with effects.obstacles."""
