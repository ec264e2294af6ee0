"""The contact zone: which facets the hand holds, their nodes, and the rigid motions it gives them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import dolfinx.fem
import dolfinx.mesh
import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fem.errors import MeshError, SceneError

if TYPE_CHECKING:
    from fem.geometry import TissueMesh
    from fem.scene import Contact

Ints = npt.NDArray[np.int32]
Floats = npt.NDArray[np.float64]

BOX_TOLERANCE = 1e-8  # of the largest extent: far above round-off of midpoints, far below any cell


def contact_facets(tissue: TissueMesh, contact: Contact) -> Ints:
    """Owned exterior facets in the contact zone, sorted.

    A facet belongs to the zone if its midpoint lies on one of ``contact.sides`` (planes of the bounding box)
    and inside ``contact.box``; or if it carries ``contact.facet_tag``. What is not given does not restrict.

    Collective.

    Raises:
        SceneError: a side is unknown, the tag is absent, or no facet is in the zone.
    """
    mesh, fdim = tissue.mesh, tissue.dimension - 1
    mesh.topology.create_connectivity(fdim, fdim + 1)
    facets = np.sort(dolfinx.mesh.exterior_facet_indices(mesh.topology))
    midpoints = dolfinx.mesh.compute_midpoints(mesh, fdim, facets)[:, : tissue.dimension]
    low, high = bounding_box(tissue)
    tolerance = BOX_TOLERANCE * float(np.max(high - low))
    chosen = np.ones(len(facets), dtype=np.bool_)
    keys = []
    if contact.facet_tag is not None:
        keys.append(f"contact.facet_tag = {contact.facet_tag}")
        chosen &= np.isin(facets, _tagged_facets(tissue, contact.facet_tag))
    if contact.sides:
        keys.append(f"contact.sides = {list(contact.sides)}")
        on_side = np.zeros(len(facets), dtype=np.bool_)
        for axis, end in _planes(contact, tissue.dimension):
            on_side |= np.abs(midpoints[:, axis] - (high if end > 0 else low)[axis]) <= tolerance
        chosen &= on_side
    if contact.box is not None:
        keys.append(f"contact.box = {[list(corner) for corner in contact.box]}")
        chosen &= _inside(midpoints, contact.box, tolerance, "contact.box")
    if mesh.comm.allreduce(int(chosen.sum())) == 0:
        raise SceneError(
            f"No boundary facet of the {tissue.source} mesh has its midpoint in the contact zone "
            f"{' and '.join(keys) or 'of [contact]'}: the boundary spans {_text(low)} to {_text(high)}."
        )
    return np.asarray(facets[chosen], dtype=np.int32)


def held_check(tissue: TissueMesh, facets: Ints) -> None:
    """Refuse a mesh with a connected part that no contact facet holds: it could float freely.

    Collective.

    Args:
        tissue: the mesh.
        facets: owned contact facets, from `contact_facets`.

    Raises:
        MeshError: some part has no contact facet.
    """
    if tissue.parts is None:
        return
    mesh, dimension = tissue.mesh, tissue.dimension
    mesh.topology.create_connectivity(dimension - 1, dimension)
    facet_cells = mesh.topology.connectivity(dimension - 1, dimension)
    labels = np.zeros(len(cell_midpoints(tissue)), dtype=np.int64)
    owned = tissue.parts.indices < len(labels)
    labels[tissue.parts.indices[owned]] = tissue.parts.values[owned]
    count = mesh.comm.allreduce(int(labels.max(initial=-1)), op=MPI.MAX) + 1
    # An owned exterior facet has one cell, and that cell is owned too.
    cells = np.array([facet_cells.links(f)[0] for f in facets], dtype=np.int64)
    held = np.zeros(count, dtype=np.int64)
    held[labels[cells]] = 1
    total = np.bincount(labels, minlength=count)
    middle = np.stack([np.bincount(labels, weights=x, minlength=count) for x in cell_midpoints(tissue).T])
    held, total, middle = (mesh.comm.allreduce(a) for a in (held, total, middle))
    loose = np.flatnonzero(held == 0)
    if loose.size:
        part = loose[0]
        raise MeshError(
            f"{loose.size} of {count} separate parts of {tissue.source} touch no contact facet, "
            f"the first with {total[part]} cells around {_text(middle[:, part] / total[part])}: "
            "remove such parts, join them to the body or extend [contact]."
        )


def contact_blocks(space: dolfinx.fem.FunctionSpace, facets: Ints) -> tuple[Ints, Ints]:
    """Owned nodes of a blocked space on and off the contact zone, local numbering, sorted.

    Collective. A node counts as contact node on its owner even if only another rank sees the facet.
    """
    mesh = space.mesh
    found = dolfinx.fem.locate_dofs_topological(space, mesh.topology.dim - 1, facets, remote=True)
    owned = space.dofmap.index_map.size_local
    on = np.zeros(owned, dtype=np.bool_)
    on[found[found < owned]] = True
    return np.flatnonzero(on).astype(np.int32), np.flatnonzero(~on).astype(np.int32)


def rigid_modes(points: Floats, dimension: int, rotation: bool, reference: npt.ArrayLike) -> Floats:
    """Rigid motions R of nodes, u = R q_s: translations, then linearised rotations about ``reference``.

    With (x, y, z) measured from the reference, the rotations are (-y, x) in 2D and (0, -z, y), (z, 0, -x),
    (-y, x, 0) in 3D.

    Not collective.

    Args:
        points: coordinates, shape (n_nodes, 2 or 3) [m].
        dimension: 2 or 3.
        rotation: append the rotations.
        reference: point the hand turns about, ``dimension`` entries [m].

    Returns:
        R, shape (n_nodes * dimension, n_s), rows blocked by node.
    """
    n = len(points)
    modes = [np.tile(unit, (n, 1)) for unit in np.eye(dimension)]
    if rotation:
        r = points[:, :dimension] - np.asarray(reference, dtype=np.float64)[:dimension]
        zero = np.zeros(n)
        if dimension == 2:
            modes.append(np.stack([-r[:, 1], r[:, 0]], axis=1))
        else:
            x, y, z = r.T
            modes += [np.stack(c, axis=1) for c in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return np.stack([mode.ravel() for mode in modes], axis=1)


def cells_in(tissue: TissueMesh, layer: Any) -> Ints:
    """Owned cells with the layer's ``tag``, or with their midpoint in its ``box``; sorted, maybe empty here.

    Not collective.

    Raises:
        SceneError: the layer has a tag but the mesh has no cell tags, or it has neither tag nor box.
    """
    midpoints = cell_midpoints(tissue)
    if layer.tag is not None:
        if tissue.cell_tags is None:
            raise SceneError(f"A layer has tag = {layer.tag}, but the {tissue.source} mesh has no cell tags: use box.")
        cells = tissue.cell_tags.find(layer.tag)
        return np.asarray(np.sort(cells[cells < len(midpoints)]), dtype=np.int32)
    if layer.box is None:
        raise SceneError("A layer has neither tag nor box: give one of them.")
    # The tolerance must not depend on the rank: lengths of the layer's own box, not of the local mesh.
    tolerance = BOX_TOLERANCE * float(np.max(np.ptp(np.asarray(layer.box, dtype=np.float64), axis=0)))
    return np.flatnonzero(_inside(midpoints, layer.box, tolerance, "box of a layer")).astype(np.int32)


def cell_midpoints(tissue: TissueMesh) -> Floats:
    """Midpoints of the owned cells, shape (n_owned, dimension) [m]. Not collective."""
    owned = tissue.mesh.topology.index_map(tissue.dimension).size_local
    cells = np.arange(owned, dtype=np.int32)
    midpoints = dolfinx.mesh.compute_midpoints(tissue.mesh, tissue.dimension, cells)
    return np.asarray(midpoints[:, : tissue.dimension], dtype=np.float64)


def bounding_box(tissue: TissueMesh) -> tuple[Floats, Floats]:
    """Lower and upper corner of the mesh over all ranks [m]. Collective."""
    x = tissue.mesh.geometry.x[:, : tissue.dimension]
    low, high = x.min(axis=0, initial=np.inf), x.max(axis=0, initial=-np.inf)
    comm = tissue.mesh.comm
    comm.Allreduce(MPI.IN_PLACE, low, op=MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, high, op=MPI.MAX)
    return low, high


def _tagged_facets(tissue: TissueMesh, tag: int) -> Ints:
    if tissue.facet_tags is None:
        raise SceneError(
            f"contact.facet_tag = {tag} needs facet tags, but the {tissue.source} mesh has none: use sides."
        )
    present = sorted(set().union(*tissue.mesh.comm.allgather(set(tissue.facet_tags.values.tolist()))))
    if tag not in present:
        raise SceneError(f"contact.facet_tag = {tag} is not in {tissue.source}: its facet tags are {present}.")
    return np.asarray(tissue.facet_tags.find(tag), dtype=np.int32)


def _planes(contact: Contact, dimension: int) -> list[tuple[int, int]]:
    try:
        return contact.axes(dimension)
    except ValueError as error:
        raise SceneError(f"{error}") from error


def _inside(points: Floats, box: Any, tolerance: float, key: str) -> npt.NDArray[np.bool_]:
    corners = np.asarray(box, dtype=np.float64)
    if corners.shape != (2, points.shape[1]):
        raise SceneError(
            f"{key} = {corners.tolist()} must have two corners with {points.shape[1]} coordinates each, "
            "as in [[x_min, ...], [x_max, ...]]."
        )
    inside = (points >= corners[0] - tolerance) & (points <= corners[1] + tolerance)
    return np.asarray(inside.all(axis=1), dtype=np.bool_)


def _text(point: Floats) -> str:
    return "(" + ", ".join(f"{x:.6g}" for x in point) + ")"
