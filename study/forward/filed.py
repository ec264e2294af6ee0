"""A coarser copy of the body of a large mesh file, which `explain` does not assemble."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mpi4py import MPI

from softgrasp.fem import Scene
from softgrasp.fem.errors import MeshError, SceneError, raise_on_all_ranks
from softgrasp.fem.mesh.check import Flags, Floats, outer_facets, sizes_of
from softgrasp.fem.mesh.singular import Ends
from softgrasp.fem.mesh.tissue_mesh import MeshArrays, TissueMesh, spread
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.model.contact import BOX_TOLERANCE
from softgrasp.fem.model.memory import check_memory
from softgrasp.fem.model.refined import ends_at, sampled_cells, too_large
from softgrasp.fem.scene.scene import Contact, check_dimension
from softgrasp.study.forward.copies import (
    MOST_LOOKED_AT,
    NOT_ASSEMBLED,
    SAMPLED,
    Copy,
    boundary_nodes,
    computed,
    node_pairs_of,
    step_text,
    too_many,
)
from softgrasp.study.report import percent

if TYPE_CHECKING:  # meshio is not imported where no file is read
    from softgrasp.fem.mesh.file import Body

LARGE = {2: 30_000, 3: 7_000}  # unknowns, about, from which on a mesh is not assembled
CELLS = {2: 1000, 3: 250}  # lattice cells of a copy, about
VERTICES = {2: 0.5, 3: 0.177}  # a cell that bisection adds [1]: 0.166 to 0.187 in 3D
LIKE = 0.05, 0.15, 0.3, 0.02  # most that volume, surface and contact zone of a copy may differ, and be buried [1]


class Outline(NamedTuple):
    """What the sizes of a mesh file follow from, and how its copy differs."""

    counts: tuple[int, ...]  # simplices of the file by dimension, by Euler's formula for a body without holes
    skin: int  # vertices of the file on its boundary
    held: int  # vertices of the file in the contact zone
    finer: float  # edges of the cells of the file over those of the copy [1]
    differs: str  # by how much, in words
    ends: Ends | None = None  # singular ends of the body, where its cells follow them
    grew: bool = False  # whether the tolerance of these cells grew until their unknowns fit

    def unknowns(self, order: int) -> float:
        """Of the tissue, with elements of this order."""
        d = len(self.counts) - 1
        return float(d * (node_pairs_of(self.counts, order)[0] - self.held * order ** (d - 1)))

    def grown(self, cells: float, ends: Ends, grew: bool) -> Outline:
        """Of a mesh bisected to so many cells, which crowd at singular ends."""
        d, before = len(self.counts) - 1, self.counts[-1]
        ratio = (cells / before) ** ((d - 1) / d)
        even = before / math.factorial(d)  # vertices of a large regular mesh; the others lie on the boundary
        vertices = even + VERTICES[d] * (cells - before) + ratio * (self.counts[0] - even)
        skin, held = (int(ratio * n) for n in (self.skin, self.held))
        return outlined((int(vertices), d), int(cells), skin, held, self.finer, self.differs)._replace(
            ends=ends, grew=grew
        )


def outlined(shape: tuple[int, ...], cells: int, skin: int, held: int, finer: float, differs: str) -> Outline:
    """The outline of a mesh with so many points, in as many dimensions, and cells."""
    vertices, d = shape
    facets = ((d + 1) * cells + (skin if d == 2 else 2 * skin - 4)) // 2
    counts = (vertices, facets, cells) if d == 2 else (vertices, vertices + facets - cells - 1, facets, cells)
    return Outline(counts, skin, held, finer, differs)


def file_copy(scene: Scene, comm: MPI.Intracomm) -> tuple[Copy | None, TissueMesh | None]:
    """Of a large mesh file, a lattice with quadratic elements; else None, and the mesh, if it was read. Collective.

    A body to be repaired is mended first. With [tissue.refine] the copy has even cells: those of the scene are counted
    on a sample, around the singular ends of the body itself.

    None too where volume, surface or contact zone of the copy differ by more than `LIKE`, where it closes a slit, or
    misses a layer.
    """
    tissue = scene.tissue
    if not tissue.mesh or scene._given is not None:
        return None, None
    from softgrasp.fem.mesh.file import checked, load_body, mended  # meshio is needed for mesh files only

    body = arrays = outline = None
    with raise_on_all_ranks(comm):
        if comm.rank == 0:
            body = load_body(scene.directory / str(tissue.mesh), tissue.scale, tissue.read_limit)
            if tissue.refine is not None or large(body.points.shape[1], tissue.order, len(body.cells)):
                body = mended(body, tissue.seam) if tissue.repair else body
                arrays, outline = _lattice(scene, body)
            if tissue.refine is None:
                arrays = arrays or checked(body, tissue.repair, tissue.seam)
    outline = comm.bcast(outline)
    if outline is None and tissue.refine is not None:
        return None, None
    mesh = spread(comm, arrays)
    scene._mesh_digest = mesh.digest
    if outline is None:
        return None, mesh
    check_dimension(scene, d := mesh.dimension)
    check_memory(scene, comm, False, d, outline.counts[-1])
    coarse = scene.model_copy(update={"tissue": tissue.model_copy(update={"order": 2, "refine": None})})
    try:
        model = build(coarse, comm=comm, mesh=mesh, run=False)
    except (MeshError, SceneError):  # it misses a layer, or a part of it is not held
        if tissue.refine is not None:
            return None, None
        with raise_on_all_ranks(comm):
            arrays = None if body is None else checked(body, tissue.repair, tissue.seam)
        return None, spread(comm, arrays)
    return _copy(scene, model, outline), mesh


def _copy(scene: Scene, model: Model, outline: Outline) -> Copy:
    """Of the model of a lattice, with the sizes of the file. Collective."""
    order, d = scene.tissue.order, len(outline.counts) - 1
    n_e = int(float(f"{outline.unknowns(order):.2e}"))
    sizes = computed(model, order, outline.counts, n_e)
    exact = "to 1 % of the unknowns and 10 % of the non-zeros. Singular ends and faults"
    if outline.ends is not None:
        exact = f"{SAMPLED[d]} of the unknowns, as cells are counted on a sample of those of the file. Faults"
    text = (
        f"{NOT_ASSEMBLED}a coarser copy of the body with {'even cells and ' * (outline.ends is not None)}quadratic "
        f"elements, n_e = {model.system.layout.n_e}, {outline.differs}. Sizes with about are computed, {exact} of the "
        f"file are not looked for.{step_text(d, order) * outline.grew}"
    )
    boundary = boundary_nodes(d, outline.skin, order)
    notes = too_many(scene, sizes.n_e)
    return Copy(model, sizes, text, outline.finer, boundary, alike=False, ends=outline.ends, notes=notes)


def large(d: int, order: int, cells: float) -> bool:
    """Whether so many cells have so many unknowns, and could not be looked at with quadratic in place of cubic ones."""
    linear = d * cells / math.factorial(d)  # in large regular meshes
    return order**d * linear > LARGE[d] and not (order == 3 and 2**d * linear <= MOST_LOOKED_AT[d])


def _lattice(scene: Scene, body: Body) -> tuple[MeshArrays, Outline] | tuple[None, None]:
    """The copy of a body and its outline, where they are alike and the mesh of the scene is large."""
    from softgrasp.fem.mesh.lattice import lattice_copy  # only large files need it

    d, contact, refine = body.points.shape[1], scene.contact, scene.tissue.refine
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
    volume, surface = (percent(abs(share)) for share in (copy.volume, copy.surface))
    differs = f"whose volume differs by {volume} and surface by {surface}"
    outline = outlined(body.points.shape, len(body.cells), int(copy.ends.sum()), int(on.sum()), copy.finer, differs)
    if refine is None:
        return copy.arrays, outline
    order, cells = scene.tissue.order, len(body.cells)
    base = d * node_pairs_of(outline.counts, order)[0]
    if base > 1.01 * refine.most:  # a body with holes has a few more
        raise too_large(refine, base)
    ends = _ends(scene, body, low, high)
    if ends is None:
        return None, None
    many, grew = sampled_cells(scene, refine, ends, (body.points, body.cells), base / cells)
    return (copy.arrays, outline.grown(many, ends, grew)) if large(d, order, many) else (None, None)


def _ends(scene: Scene, body: Body, low: Floats, high: Floats) -> Ends | None:
    """Singular ends of the body of a file, zone and layers selected as those of a mesh; None without a zone."""
    contact, points, cells = scene.contact, body.points, body.cells
    sides = outer_facets(cells, len(points))
    held = sides.nodes[sides.outer]
    held = held[_in_zone(points[held].mean(axis=1), low, high, contact)]
    if contact.facet_tag is not None:
        if body.facet_tags is None:
            return None
        marked = np.sort(body.facets[np.isin(body.facet_tags, body.facet_sets.get(contact.facet_tag, ()))], axis=1)
        code = np.array([len(points) ** k for k in range(len(low))], dtype=np.int64)
        held = held[np.isin(held @ code, marked @ code)]
    layers = np.full(len(cells), len(scene.tissue.layers))
    for i, layer in enumerate(scene.tissue.layers.values()):
        if layer.box is not None:
            near = BOX_TOLERANCE * float(np.ptp(np.asarray(layer.box), axis=0).max())
            layers[inside(points[cells].mean(axis=1), layer.box, near)] = i
        elif body.cell_tags is not None and layer.tag is not None:
            layers[np.isin(body.cell_tags, body.cell_sets.get(layer.tag, ()))] = i
    return ends_at(scene, (points, cells), held, layers) if len(held) else None


def _in_zone(places: Floats, low: Floats, high: Floats, contact: Contact) -> Flags:
    """Whether places lie on a side and in the box of the contact zone."""
    near = BOX_TOLERANCE * float((high - low).max())
    result = np.ones(len(places), dtype=np.bool_)
    if contact.sides:
        planes = contact.axes(len(low))
        on = [np.abs(places[:, axis] - (high if end > 0 else low)[axis]) <= near for axis, end in planes]
        result &= np.any(on, axis=0)
    return result if contact.box is None else result & inside(places, contact.box, near)


def inside(places: Floats, box: Any, near: float) -> Flags:
    """Whether places lie in a box or so near to it [m]."""
    low, high = np.asarray(box)
    return np.asarray(((places >= low - near) & (places <= high + near)).all(axis=1))
