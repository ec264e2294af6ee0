"""Boxes whose lines are moved: they meet the ends of contact zone and layers, and crowd towards them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from softgrasp.fem.errors import SceneError
from softgrasp.fem.mesh.grading import graded_line, merged
from softgrasp.fem.mesh.make import structured_mesh
from softgrasp.fem.mesh.tissue_mesh import TissueMesh

if TYPE_CHECKING:
    from softgrasp.fem.scene.scene import Scene

Floats = npt.NDArray[np.float64]

SAME = 1e-9  # of the side: far above rounding of coordinates, far below any cell
CLOSE = 0.1  # of the side: a line through a point of an output keeps this distance from others


@dataclass(frozen=True)
class Axis:
    """One axis of a box."""

    cuts: tuple[float, ...]  # coordinates that a line must meet, the sides first and last [m]
    ends: tuple[float, ...]  # those of them where the contact zone ends [m]


def box_axes(scene: Scene) -> tuple[Axis, ...]:
    """What the lines of a structured box must meet.

    Lines meet the box of the contact zone, the boxes of layers and the points of outputs, and the zone ends at its
    sides and at its box.

    Raises:
        SceneError: the scene has no structured box.
    """
    tissue, contact = scene.tissue, scene.contact
    if tissue.size is None:
        raise SceneError("tissue.refine.method = 'lines' needs tissue.size; a mesh file can only be bisected.")
    d = len(tissue.size)
    origin = tissue.origin or [0.0] * d
    sides = contact.axes(d)
    result = []
    for axis, (low, length) in enumerate(zip(origin, tissue.size, strict=True)):
        high = low + length

        def inner(values: Sequence[float], low: float = low, high: float = high) -> list[float]:
            return [v for v in values if low + SAME * (high - low) < v < high - SAME * (high - low)]

        ends = [high if end > 0 else low for a, end in sides if a == axis]
        across = {a for a, _ in sides} - {axis} or not sides
        if across:
            ends += [low, high]
            if contact.box is not None:
                lo, hi = (corner[axis] for corner in contact.box)
                ends = [e for e in ends if lo - SAME * length <= e <= hi + SAME * length] + inner([lo, hi])
        cuts = [low, high, *inner(ends)]
        cuts += inner([corner[axis] for layer in tissue.layers.values() for corner in layer.box or []])
        points = [o.point[axis] for o in (scene.control.outputs if scene.control else []) if o.point is not None]
        unique = merged([], sorted(cuts), SAME * length)
        result.append(Axis(tuple(merged(unique, inner(points), CLOSE * length)), tuple(sorted(set(ends)))))
    return tuple(result)


def even_cells(axis: Axis, h: float) -> int:
    """Number of cells no longer than h between the cuts."""
    return sum(int(np.ceil((b - a) / h - SAME)) for a, b in pairwise(axis.cuts))


def box_of_lines(comm: MPI.Intracomm, scene: Scene, cells: Sequence[int], mu: float, radius: float) -> TissueMesh:
    """The structured box with lines at all cuts that crowd towards the ends; mu = 1: even between cuts. Collective.

    Args:
        comm: communicator.
        scene: with a structured box.
        cells: along each side.
        mu: grading, see :func:`softgrasp.fem.mesh.grading.graded_line`.
        radius: R [m].
    """
    axes, tissue = box_axes(scene), scene.tissue
    lines = [graded_line(a.cuts, a.ends, n, mu, radius) for a, n in zip(axes, cells, strict=True)]
    box = structured_mesh(comm, tissue.size or [], [len(line) - 1 for line in lines], tissue.origin)
    x = box.mesh.geometry.x
    for i, (line, length) in enumerate(zip(lines, tissue.size or [], strict=True)):
        x[:, i] = line[np.rint((x[:, i] - line[0]) / length * (len(line) - 1)).astype(np.int64)]
    return box
