"""A coarser copy of the body of a large mesh file, which `explain` does not assemble."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI

from softgrasp.fem import Scene
from softgrasp.fem.errors import MeshError, SceneError, raise_on_all_ranks
from softgrasp.fem.mesh.check import Flags, Floats, sizes_of
from softgrasp.fem.mesh.tissue_mesh import MeshArrays, TissueMesh, spread
from softgrasp.fem.model.build import build
from softgrasp.fem.model.contact import BOX_TOLERANCE
from softgrasp.fem.model.memory import check_memory
from softgrasp.fem.scene.scene import Contact, check_dimension
from softgrasp.study.forward.copies import MOST_LOOKED_AT, NOT_ASSEMBLED, Copy, computed, node_pairs_of, planned
from softgrasp.study.report import percent

if TYPE_CHECKING:  # meshio is not imported where no file is read
    from softgrasp.fem.mesh.file import Body

LARGE = {2: 30_000, 3: 7_000}  # unknowns, about, from which on a mesh is not assembled
CELLS = {2: 1000, 3: 250}  # lattice cells of a copy, about
LIKE = 0.05, 0.15, 0.3, 0.02  # most that volume, surface and contact zone of a copy may differ, and be buried [1]


class Outline(NamedTuple):
    """What the sizes of a mesh file follow from, and how its copy differs."""

    counts: tuple[int, ...]  # simplices of the file by dimension, by Euler's formula for a body without holes
    held: int  # vertices of the file in the contact zone
    finer: float  # edges of the cells of the file over those of the copy [1]
    differs: str  # by how much, in words


def file_copy(scene: Scene, comm: MPI.Intracomm) -> tuple[Copy | None, TissueMesh | None]:
    """Of a large mesh file, a lattice with quadratic elements; else None, and the mesh, if it was read. Collective.

    A body to be repaired is mended first. Meshes are assembled where singular ends give the cells ([tissue.refine]), as
    those of lattice cells are not those of the body, and where a plan asks for the nodes themselves.

    None too where volume, surface or contact zone of the copy differ by more than `LIKE`, where it closes a slit, or
    misses a layer.
    """
    tissue = scene.tissue
    if not tissue.mesh or scene._given is not None or tissue.refine is not None or planned(scene):
        return None, None
    from softgrasp.fem.mesh.file import checked, load_body, mended  # meshio is needed for mesh files only

    body = arrays = outline = None
    with raise_on_all_ranks(comm):
        if comm.rank == 0:
            body = load_body(scene.directory / str(tissue.mesh), tissue.scale, tissue.read_limit)
            if _large(body, tissue.order):
                body = mended(body, tissue.seam) if tissue.repair else body
                arrays, outline = _lattice(scene, body)
            arrays = arrays or checked(body, tissue.repair, tissue.seam)
    mesh, outline = spread(comm, arrays), comm.bcast(outline)
    scene._mesh_digest = mesh.digest
    if outline is None:
        return None, mesh
    check_dimension(scene, d := mesh.dimension)
    check_memory(scene, comm, False, d, outline.counts[-1])
    coarse = scene.model_copy(update={"tissue": tissue.model_copy(update={"order": 2})})
    try:
        model = build(coarse, comm=comm, mesh=mesh, run=False)
    except (MeshError, SceneError):  # it misses a layer, or a part of it is not held
        with raise_on_all_ranks(comm):
            arrays = None if body is None else checked(body, tissue.repair, tissue.seam)
        return None, spread(comm, arrays)
    nodes, _ = node_pairs_of(outline.counts, tissue.order)
    n_e = int(float(f"{d * (nodes - outline.held * tissue.order ** (d - 1)):.2e}"))
    sizes = computed(model, tissue.order, outline.counts, n_e)
    text = (
        f"{NOT_ASSEMBLED}a coarser copy of the body with quadratic elements, n_e = {model.system.layout.n_e}, "
        f"{outline.differs}. Sizes with about are computed, to 1 % of the unknowns and 10 % of the non-zeros. Singular "
        "ends and faults of the file are not looked for."
    )
    return Copy(model, sizes, text, outline.finer, alike=False), mesh


def _large(body: Body, order: int) -> bool:
    """Whether a mesh has so many unknowns, and could not be looked at with quadratic in place of cubic elements."""
    d = body.points.shape[1]
    linear = d * len(body.cells) / math.factorial(d)  # in large regular meshes
    return order**d * linear > LARGE[d] and not (order == 3 and 2**d * linear <= MOST_LOOKED_AT[d])


def _lattice(scene: Scene, body: Body) -> tuple[MeshArrays, Outline] | tuple[None, None]:
    """The copy of a body and its outline, where they are alike."""
    from softgrasp.fem.mesh.lattice import lattice_copy  # only large files need it

    d, contact = body.points.shape[1], scene.contact
    boxes = [box for box in (contact.box, *(layer.box for layer in scene.tissue.layers.values())) if box is not None]
    try:
        contact.axes(d)
    except ValueError:  # assembly says what is wrong
        return None, None
    copy = lattice_copy(body, CELLS[d], boxes) if all(len(box[0]) == d for box in boxes) else None
    if copy is None:
        return None, None
    low, high = body.points.min(axis=0), body.points.max(axis=0)
    marks = [] if contact.facet_tag is None else body.facet_sets.get(contact.facet_tag, ())
    on, outer = copy.ends & _in_zone(body.points, low, high, contact), copy.outer
    _, facets, tags = copy.arrays.marks["facet_tags"]
    if contact.facet_tag is not None and body.facet_tags is not None and tags is not None:
        on &= np.isin(np.arange(len(on)), body.facets[np.isin(body.facet_tags, marks)])
        outer = facets[np.isin(tags, marks)]
    corners = copy.arrays.points
    zone = sizes_of(corners, outer[_in_zone(corners[outer].mean(axis=1), low, high, contact)]).sum()
    shares = copy.volume, copy.surface, zone / copy.area[on].sum() - 1 if on.any() else np.inf, copy.buried
    if any(abs(share) > most for share, most in zip(shares, LIKE, strict=True)):
        return None, None
    vertices, cells, skin = len(body.points), len(body.cells), int(copy.ends.sum())
    facets_of = ((d + 1) * cells + (skin if d == 2 else 2 * skin - 4)) // 2
    counts = (vertices, facets_of, cells) if d == 2 else (vertices, vertices + facets_of - cells - 1, facets_of, cells)
    volume, surface = (percent(abs(share)) for share in (copy.volume, copy.surface))
    differs = f"whose volume differs by {volume} and surface by {surface}"
    return copy.arrays, Outline(counts, int(on.sum()), copy.finer, differs)


def _in_zone(places: Floats, low: Floats, high: Floats, contact: Contact) -> Flags:
    """Whether places lie on a side and in the box of the contact zone."""
    near = BOX_TOLERANCE * float((high - low).max())
    result = np.ones(len(places), dtype=np.bool_)
    if contact.sides:
        planes = contact.axes(len(low))
        on = [np.abs(places[:, axis] - (high if end > 0 else low)[axis]) <= near for axis, end in planes]
        result &= np.any(on, axis=0)
    if contact.box is not None:
        box = np.asarray(contact.box)
        result &= ((places >= box[0] - near) & (places <= box[1] + near)).all(axis=1)
    return result
