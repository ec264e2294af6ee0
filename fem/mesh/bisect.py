"""Local bisection of a simplex mesh on rank 0; contact zone, tags and layers pass to the children.

DOLFINx bisects distributed meshes too, but passes tags on only where no cell is shared by ranks, and keeps children on
the rank of their parent. On rank 0 the mesh is the same for every rank count and is spread evenly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import dolfinx.mesh
import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from softgrasp.fem.errors import MeshError
from softgrasp.fem.mesh.check import FLAT, counted, find_parts, longest_edges, place_text, signed_volumes, sort_facets
from softgrasp.fem.mesh.tissue_mesh import Marks, TissueMesh, Whole, spread

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

MOST_LEVELS = 60  # each halves the longest edge at most; 2^-30 of a body is below any useful cell


def bisect(whole: Whole, marked: Ints) -> Whole:
    """Split the marked cells, and others until no node hangs, through their longest edges [PC00].

    Args:
        marked: numbers of the cells to split, in the order of ``whole.simplices``.

    Raises:
        MeshError: a child would be flat to rounding.
    """
    mesh, d = whole.mesh, whole.dimension
    for a, b in ((d, 1), (1, d), (d - 1, d), (d, d - 1)):
        mesh.topology.create_connectivity(a, b)
    edges = dolfinx.mesh.compute_incident_entities(mesh.topology, np.sort(marked).astype(np.int32), d, 1)
    option = dolfinx.mesh.RefinementOption.parent_cell_and_facet
    fine, parent, parent_facet = dolfinx.mesh.refine(mesh, edges, option=option)
    for a, b in ((d - 1, d), (d, d - 1)):
        fine.topology.create_connectivity(a, b)
    facets = {
        name: dolfinx.mesh.transfer_meshtag(tags, fine, parent, parent_facet) for name, tags in whole.facets.items()
    }
    above = parent[fine.topology.original_cell_index]  # DOLFINx numbers parents in the order before its own reordering
    result = replace(whole, mesh=fine, cells={k: v[above] for k, v in whole.cells.items()}, facets=facets)
    points, cells = result.points, result.simplices
    quality = np.abs(signed_volumes(points, cells)) / longest_edges(points, cells) ** d
    if (flat := quality <= FLAT).any():
        place = place_text(points[cells[int(np.argmin(quality))]].mean(axis=0))
        raise MeshError(
            f"{whole.source} cannot be bisected further: {counted(int(flat.sum()), 'cell')} would be flat, the worst "
            f"around {place}; remesh the body there or take a larger tissue.refine.tolerance."
        )
    return result


def bisect_to(whole: Whole, size: Callable[[Floats], Floats], slack: float, most: int) -> Whole:
    """Bisect until no cell is larger than ``slack`` times its size(points (n, d)) [m], or there are more than ``most``.

    Raises:
        MeshError: see :func:`bisect`.
    """
    for _ in range(MOST_LEVELS):
        points, cells = whole.points, whole.simplices
        large = longest_edges(points, cells) > slack * size(points[cells].mean(axis=1))
        if not large.any() or len(cells) > most:
            break
        whole = bisect(whole, np.flatnonzero(large).astype(np.int32))
    return whole


def distribute(comm: MPI.Intracomm, whole: Whole | None, dimension: int) -> TissueMesh:
    """Spread a mesh from rank 0 over the ranks (None on the others), with all it carries. Collective.

    ``mesh.topology.original_cell_index`` of the result counts the cells as ``whole.simplices`` does.
    """
    facts, body = None, None
    marks: Marks = {}
    if whole is not None:
        body = points, cells = whole.points, whole.simplices
        parts = find_parts(points, cells, sort_facets(cells), whole.source)
        marks = {f"{name} of cells": (dimension, cells, values) for name, values in whole.cells.items()}
        for name, tags in whole.facets.items():
            marks[f"{name} of facets"] = dimension - 1, whole.facet_nodes(name), tags.values
        if parts is not None:
            marks["parts"] = dimension, cells, parts[0]
        facts = whole.source, None if parts is None else parts[1], whole.facet_sets, whole.cell_sets
    source, known, facet_sets, cell_sets = comm.bcast(facts)
    mesh, found = spread(comm, dimension, body, marks)
    return TissueMesh(
        mesh=mesh,
        dimension=dimension,
        facet_tags=found.get("tags of facets"),
        cell_tags=found.get("tags of cells"),
        source=source,
        part_tags=found.get("parts"),
        parts=known,
        facet_sets=facet_sets,
        cell_sets=cell_sets,
        contact=found.get("contact of facets"),
        layers=found.get("layers of cells"),
        whole=whole,
    )
