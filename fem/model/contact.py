"""The contact zone: its facets, their nodes, and the rigid motions of these nodes."""

from __future__ import annotations

from typing import Any

import dolfinx.fem
import dolfinx.mesh
import numpy as np
import numpy.typing as npt

from softgrasp.fem.errors import MeshError, SceneError
from softgrasp.fem.layout import bounding_box
from softgrasp.fem.mesh.check import Flags, Floats, Ints, Parts, place_text
from softgrasp.fem.mesh.tissue_mesh import TissueMesh
from softgrasp.fem.petsc import on_root, total
from softgrasp.fem.scene.scene import Contact
from softgrasp.fem.shown import counted

HINGE = 1e-12  # eigenvalue of C^T C over the largest, below which a motion is free [1]: nodes 1e-6 of the part apart
MOST_LOOSE = 300  # largest number of parts without contact facet [1]: a dense problem of at most 1800 unknowns
BOX_TOLERANCE = 1e-8  # tolerance of places over the largest extent [1]: far above rounding, far below any cell


def contact_facets(tissue: TissueMesh, contact: Contact) -> Ints:
    """Owned exterior facets in the contact zone, sorted.

    A facet belongs to the zone if its midpoint lies on one of ``contact.sides`` (planes of the bounding box)
    and inside ``contact.box``; or if it carries ``contact.facet_tag``. What is not given does not restrict. A bisected
    mesh has inherited its zone.

    Collective. Raises SceneError: a side is unknown, the tag is absent, or no facet is in the zone.
    """
    mesh, fdim = tissue.mesh, tissue.dimension - 1
    mesh.topology.create_connectivity(fdim, fdim + 1)
    facets = np.sort(dolfinx.mesh.exterior_facet_indices(mesh.topology))
    if tissue.contact is not None:
        return np.asarray(facets[np.isin(facets, tissue.contact.indices)], dtype=np.int32)
    midpoints = dolfinx.mesh.compute_midpoints(mesh, fdim, facets)[:, : tissue.dimension]
    low, high = bounding_box(mesh.comm, mesh.geometry.x[:, : tissue.dimension])
    tolerance = BOX_TOLERANCE * float(np.max(high - low))
    chosen = np.ones(len(facets), dtype=np.bool_)
    keys = []
    if contact.facet_tag is not None:
        keys.append(f"contact.facet_tag = {contact.facet_tag}")
        chosen &= np.isin(facets, _tagged_facets(tissue, contact.facet_tag))
    if contact.sides:
        keys.append(f"contact.sides = {list(contact.sides)}")
        on_side = np.zeros(len(facets), dtype=np.bool_)
        try:
            planes = contact.axes(tissue.dimension)
        except ValueError as error:
            raise SceneError(f"{error}") from error
        for axis, end in planes:
            on_side |= np.abs(midpoints[:, axis] - (high if end > 0 else low)[axis]) <= tolerance
        chosen &= on_side
    if contact.box is not None:
        keys.append(f"contact.box = {[list(corner) for corner in contact.box]}")
        chosen &= _inside(midpoints, contact.box, tolerance, "contact.box")
    if mesh.comm.allreduce(int(chosen.sum())) == 0:
        raise SceneError(
            f"No boundary facet of the {tissue.source} mesh has its midpoint in the contact zone "
            f"{' and '.join(keys) or 'of [contact]'}: the boundary spans {place_text(low)} to {place_text(high)}."
        )
    return np.asarray(facets[chosen], dtype=np.int32)


def held_check(tissue: TissueMesh, facets: Ints) -> None:
    """Refuse a mesh of which a part could move freely, alone or about the nodes by which it hangs on the rest.

    Collective. Raises MeshError: parts that share no node with the rest have no contact facet, or parts are joined to
    the rest by so few nodes that they can turn.
    """
    tags, parts = tissue.part_tags, tissue.parts
    if tags is None or parts is None:
        return
    mesh, dimension = tissue.mesh, tissue.dimension
    mesh.topology.create_connectivity(dimension - 1, dimension)
    facet_cells = mesh.topology.connectivity(dimension - 1, dimension)
    labels = np.zeros(tissue.owned, dtype=np.int64)
    owned = tags.indices < len(labels)
    labels[tags.indices[owned]] = tags.values[owned]
    # An owned exterior facet has one cell, and that cell is owned too.
    cells = np.array([facet_cells.links(f)[0] for f in facets], dtype=np.int64)
    held = np.zeros(len(parts.cells), dtype=np.int64)
    held[labels[cells]] = 1
    held = mesh.comm.allreduce(held)
    on_root(mesh.comm, lambda: check_parts(parts, held > 0, tissue.source))


def check_parts(parts: Parts, held: Flags, source: str) -> None:
    """Refuse parts that keep a free motion when those with contact facets are fixed.

    A part that hangs together through facets moves without strain as a rigid body only, u = R q, and a contact
    facet fixes it. The q of the other parts must agree at each shared node, C q = 0; a null vector of C^T C is
    a free motion.

    ``held``: whether a part has a contact facet, shape (n_parts,). Raises MeshError: see `held_check`.
    """
    groups = int(parts.groups.max()) + 1
    loose = np.setdiff1d(np.arange(groups), parts.groups[held])
    if loose.size:
        chosen = parts.groups == loose[0]
        cells = parts.cells[chosen]
        middle = (cells @ parts.middles[chosen]) / cells.sum()
        raise MeshError(
            f"{loose.size} of {groups} separate parts of {source} touch no contact facet, "
            f"the first with {counted(cells.sum(), 'cell')} around {place_text(middle)}: "
            "join them to the body (tissue.repair = true joins doubled nodes), remove them or extend [contact]."
        )
    moving = _moving(parts, held, source)
    if not moving.any():
        return
    point, part = parts.joints.T
    fixed = np.isin(point, point[~moving[part]]) & moving[part]  # joints of moving parts to parts at rest
    counts = np.bincount(part[fixed], minlength=len(held))
    worst = int(np.argmin(np.where(counts > 0, counts, len(point) + 1)))
    place = parts.points[point[fixed & (part == worst)]].mean(axis=0)
    raise MeshError(
        f"{int(moving.sum())} of {len(held)} parts of {source} can turn freely about the nodes they share with the "
        f"rest, the loosest with {counted(parts.cells[worst], 'cell')} and {counted(counts[worst], 'such node')} "
        f"around {place_text(place)}: "
        "join the parts through whole facets, remove them or extend [contact]."
    )


def _moving(parts: Parts, held: Flags, source: str) -> Flags:
    """Whether each part moves in some null vector of C^T C, (n_parts,)."""
    d = parts.points.shape[1]
    free = np.flatnonzero(~held)
    if not free.size:
        return np.zeros(len(held), dtype=np.bool_)
    if len(free) > MOST_LOOSE:
        raise MeshError(
            f"{len(free)} parts of {source} have no contact facet and hang on the rest by single nodes or edges: "
            "join the cells through whole facets."
        )
    point, part = parts.joints.T
    arms = (parts.points[point] - parts.middles[part]) / parts.radii[part, None]
    size = d * (d + 1) // 2
    R = rigid_modes(arms, d, True, np.zeros(d)).reshape(len(point), d, size)
    slot = np.full(len(held), -1)
    slot[free] = np.arange(len(free))
    gram = np.zeros((len(free), len(free), size, size))
    every = np.arange(len(point))
    start = np.maximum.accumulate(np.where(np.diff(point, prepend=-1) > 0, every, 0))  # first joint of the same node
    for one, sign in ((start, -1.0), (every, 1.0)):  # C: motion of a joint minus that of the first one
        for other, sign2 in ((start, -1.0), (every, 1.0)):
            a, b = slot[part[one]], slot[part[other]]
            both = (a >= 0) & (b >= 0) & (start < every)
            blocks = np.einsum("kdi,kdj->kij", R[one[both]], R[other[both]])
            np.add.at(gram, (a[both], b[both]), sign * sign2 * blocks)
    values, vectors = np.linalg.eigh(gram.transpose(0, 2, 1, 3).reshape(len(free) * size, len(free) * size))
    null = vectors[:, values <= HINGE * max(values.max(initial=0.0), 1.0)].reshape(len(free), size, -1)
    moving = np.zeros(len(held), dtype=np.bool_)
    moving[free] = np.abs(null).max(axis=(1, 2), initial=0.0) > 1e-6  # unit vectors; round-off is far below
    return moving


def contact_blocks(space: dolfinx.fem.FunctionSpace, facets: Ints) -> tuple[Ints, Ints]:
    """Owned nodes of a blocked space on and off the contact zone, local numbering, sorted.

    Collective. A node counts as contact node on its owner even if only another rank sees the facet.
    """
    mesh = space.mesh
    located = dolfinx.fem.locate_dofs_topological(space, mesh.topology.dim - 1, facets, remote=True)
    owned = space.dofmap.index_map.size_local
    on = np.zeros(owned, dtype=np.bool_)
    on[located[located < owned]] = True
    return np.flatnonzero(on).astype(np.int32), np.flatnonzero(~on).astype(np.int32)


def contact_centre(tissue: TissueMesh, facets: Ints) -> Floats:
    """Centroid of the contact zone, (d,) [m]: by area, so that no other mesh of the zone has another. Collective.

    ``facets``: owned facets of the zone.
    """
    mesh, d = tissue.mesh, tissue.dimension
    mesh.topology.create_connectivity(d - 1, d)
    x = mesh.geometry.x[dolfinx.mesh.entities_to_geometry(mesh, d - 1, facets), :d]
    edges = x[:, 1:] - x[:, :1]
    area = np.sqrt(np.linalg.det(edges @ edges.transpose(0, 2, 1)))  # times (d - 1)!
    sums = total(mesh.comm, np.append(area @ x.mean(axis=1), area.sum()))
    return np.asarray(sums[:d] / sums[d])


def rigid_modes(points: Floats, dimension: int, rotation: bool, reference: npt.ArrayLike) -> Floats:
    """Rigid motions R of nodes, u = R q_s: translations, then linearised rotations about ``reference``.

    With (x, y, z) measured from the reference, the rotations are (-y, x) in 2D and (0, -z, y), (z, 0, -x),
    (-y, x, 0) in 3D.

    ``points``: coordinates, (n_nodes, 2 or 3) [m];
    ``reference``: point the hand turns about, ``dimension`` entries [m].

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

    Raises SceneError: the layer has a tag that the mesh does not have.
    """
    owned = np.arange(tissue.owned, dtype=np.int32)
    midpoints = dolfinx.mesh.compute_midpoints(tissue.mesh, tissue.dimension, owned)[:, : tissue.dimension]
    if layer.tag is not None:
        if tissue.cell_tags is None:
            raise SceneError(f"A layer has tag = {layer.tag}, but the {tissue.source} mesh has no cell tags: use box.")
        if layer.tag not in tissue.cell_sets:
            raise SceneError(
                f"The tag = {layer.tag} of a layer is not in {tissue.source}: "
                f"its cell tags are {_present(tissue.cell_sets)}."
            )
        cells = tissue.cell_tags.indices[np.isin(tissue.cell_tags.values, tissue.cell_sets[layer.tag])]
        return np.asarray(np.sort(cells[cells < len(owned)]), dtype=np.int32)
    assert layer.box is not None  # a layer has the one or the other
    # The tolerance must not depend on the rank: lengths of the layer's own box, not of the local mesh.
    tolerance = BOX_TOLERANCE * float(np.max(np.ptp(np.asarray(layer.box, dtype=np.float64), axis=0)))
    return np.flatnonzero(_inside(midpoints, layer.box, tolerance, "box of a layer")).astype(np.int32)


def _tagged_facets(tissue: TissueMesh, tag: int | str) -> Ints:
    if tissue.facet_tags is None:
        raise SceneError(
            f"contact.facet_tag = {tag} needs facet tags, but the {tissue.source} mesh has none: use sides."
        )
    if tag not in tissue.facet_sets:
        present = _present(tissue.facet_sets)
        raise SceneError(f"contact.facet_tag = {tag} is not in {tissue.source}: its facet tags are {present}.")
    marks = tissue.facet_tags
    return np.asarray(marks.indices[np.isin(marks.values, tissue.facet_sets[tag])], dtype=np.int32)


def _present(sets: dict[int | str, tuple[int, ...]]) -> list[int | str]:
    return [*sorted(k for k in sets if isinstance(k, int)), *sorted(k for k in sets if isinstance(k, str))]


def _inside(points: Floats, box: Any, tolerance: float, key: str) -> Flags:
    corners = np.asarray(box, dtype=np.float64)
    if corners.shape != (2, points.shape[1]):
        raise SceneError(
            f"{key} = {corners.tolist()} must have two corners with {points.shape[1]} coordinates each, "
            "as in [[x_min, ...], [x_max, ...]]."
        )
    inside = (points >= corners[0] - tolerance) & (points <= corners[1] + tolerance)
    return np.asarray(inside.all(axis=1), dtype=np.bool_)
