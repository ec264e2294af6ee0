"""Rigid obstacles: their geometry over time, for contact and for constrained control."""

from __future__ import annotations

from softgrasp.fem.obstacles.obstacle import Obstacle, make_obstacles
from softgrasp.fem.obstacles.shapes import Ball, HalfSpace, Polytope, Shape

__all__ = ["Ball", "HalfSpace", "Obstacle", "Polytope", "Shape", "make_obstacles"]
