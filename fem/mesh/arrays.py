"""A mesh file as arrays: what was read, before DOLFINx distributes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from softgrasp.fem.mesh.parts import Parts
from softgrasp.fem.sealed import digest

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Tags = npt.NDArray[np.int32]
Sets = dict[int | str, tuple[int, ...]]


@dataclass(frozen=True)
class MeshArrays:
    """A simplex mesh in arrays, before distribution."""

    points: Floats  # shape (n_points, d) [m]
    cells: Integers  # shape (n_cells, d + 1)
    cell_tags: Tags | None  # one integer a cell, or None
    facets: Integers  # tagged facets, shape (n_facets, d)
    facet_tags: Tags | None  # one integer a tagged facet, or None
    part_tags: Tags | None  # number of the facet-connected part of each cell, or None if there is one part only
    parts: Parts | None  # what is known of these parts, or None
    facet_sets: Sets  # marks in ``facet_tags`` of each tag number and named set
    cell_sets: Sets  # marks in ``cell_tags`` of each tag number and named set
    notes: tuple[str, ...] = ()  # warnings, one sentence each

    def digest(self) -> str:
        """SHA-256 of coordinates, cells, tags and sets, which some formats spread over several files; 64 hex digits."""
        sets = [np.frombuffer(_text(each).encode(), dtype=np.uint8) for each in (self.cell_sets, self.facet_sets)]
        return digest(self.points, self.cells, self.cell_tags, self.facets, self.facet_tags, *sets)


def _text(sets: Sets) -> str:
    """The same for equal sets, in whatever order they were read."""
    return repr(sorted((repr(name), tuple(int(mark) for mark in marks)) for name, marks in sets.items()))
