"""One hash of the arrays of a mesh, which some formats spread over several files."""

from __future__ import annotations

import hashlib

import numpy as np

from softgrasp.fem.mesh.arrays import MeshArrays, Sets


def mesh_digest(arrays: MeshArrays) -> str:
    """SHA-256 of coordinates, cells, tags and sets, 64 hex digits."""
    digest = hashlib.sha256()
    for array in (arrays.points, arrays.cells, arrays.cell_tags, arrays.facets, arrays.facet_tags):
        if array is None:
            digest.update(b"none")
            continue
        digest.update(repr((array.dtype.str, array.shape)).encode())
        digest.update(np.ascontiguousarray(array))
    for sets in (arrays.cell_sets, arrays.facet_sets):
        digest.update(_text(sets).encode())
    return digest.hexdigest()


def _text(sets: Sets) -> str:
    """The same for equal sets, in whatever order they were read."""
    return repr(sorted((repr(name), tuple(int(mark) for mark in marks)) for name, marks in sets.items()))
