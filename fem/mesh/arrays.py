"""A mesh file as arrays: what was read, before DOLFINx distributes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from softgrasp.fem.mesh.parts import Parts

Floats = npt.NDArray[np.float64]


Integers = npt.NDArray[np.int64]
Tags = npt.NDArray[np.int32]


Sets = dict[int | str, tuple[int, ...]]


@dataclass(frozen=True)
class MeshArrays:
    """A simplex mesh in arrays, before distribution.

    Attributes:
        points: shape (n_points, d) [m].
        cells: shape (n_cells, d + 1).
        cell_tags: one integer a cell, or None.
        facets: tagged facets, shape (n_facets, d).
        facet_tags: one integer a tagged facet, or None.
        part_tags: number of the facet-connected part of each cell, or None if there is one part only.
        parts: what is known of these parts, or None.
        facet_sets: marks in ``facet_tags`` of each tag number and named set.
        cell_sets: marks in ``cell_tags`` of each tag number and named set.
        notes: warnings, one sentence each.
    """

    points: Floats
    cells: Integers
    cell_tags: Tags | None
    facets: Integers
    facet_tags: Tags | None
    part_tags: Tags | None
    parts: Parts | None
    facet_sets: Sets
    cell_sets: Sets
    notes: tuple[str, ...] = ()
