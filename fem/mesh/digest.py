"""One hash of the arrays of a mesh, which some formats spread over several files."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.mesh.arrays import MeshArrays, Sets
from softgrasp.fem.sealed import digest


def mesh_digest(arrays: MeshArrays) -> str:
    """SHA-256 of coordinates, cells, tags and sets, 64 hex digits."""
    sets = [np.frombuffer(_text(each).encode(), dtype=np.uint8) for each in (arrays.cell_sets, arrays.facet_sets)]
    return digest(arrays.points, arrays.cells, arrays.cell_tags, arrays.facets, arrays.facet_tags, *sets)


def _text(sets: Sets) -> str:
    """The same for equal sets, in whatever order they were read."""
    return repr(sorted((repr(name), tuple(int(mark) for mark in marks)) for name, marks in sets.items()))
