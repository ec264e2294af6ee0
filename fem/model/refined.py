"""The mesh that `[tissue.refine]` describes: graded before any solve, the same for every rank count.

    h(r) = max(smallest, h0 min(1, r / R)^(1 - mu)),  R = half the shortest side of the body,

with r the distance from the nearest end of the contact zone, re-entrant corner or corner of a layer.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import dolfinx.mesh
import numpy as np
from mpi4py import MPI

from softgrasp.fem.errors import SceneError, raise_on_all_ranks
from softgrasp.fem.mesh.bisected import bisected_count
from softgrasp.fem.mesh.check import Floats, Integers, longest_edges, sort_facets
from softgrasp.fem.mesh.grading import (
    BISECTION,
    LINES,
    SLACK,
    SizeField,
    bisect_to,
    box_of_lines,
    distribute,
    even_cells,
)
from softgrasp.fem.mesh.make import make_mesh
from softgrasp.fem.mesh.singular import Ends, singular_ends
from softgrasp.fem.mesh.tissue_mesh import TissueMesh, Whole
from softgrasp.fem.model.assembly import layer_numbers
from softgrasp.fem.model.contact import contact_facets
from softgrasp.fem.petsc import on_root

if TYPE_CHECKING:
    from softgrasp.fem.scene.scene import Scene
    from softgrasp.fem.scene.tissue import Refine

# Measured on the scenes that ship: cells across the shortest side that leave 1e-2 of the deformation away from the
# ends, and the power of the tolerance with which they grow: 1 / (2 p), as outputs converge with twice the order.
ACROSS = {2: {1: 32.0, 2: 3.5, 3: 3.0}, 3: {1: 8.0, 2: 1.8, 3: 2.0}}
MORE = {1: 0.0, 2: 0.7, 3: 0.0}  # cells beside these, for coarse meshes: with them the first estimate meets 1e-2
LINES_ACROSS = {2: {1: 24.0, 2: 8.0, 3: 5.0}, 3: {1: 16.0, 2: 6.0, 3: 4.0}}
# Smallest cell over tolerance times shortest side: the cells at an end are about proportional to it.
SMALLEST = {2: {1: 0.1, 2: 0.4, 3: 1.0}, 3: {1: 16.0, 2: 48.0, 3: 96.0}}
DEEPEST = {2: 1 / 256, 3: 1 / 8}  # smallest over largest cell without a tolerance: edges in 3D fill a body quickly
MEDIAN_OF = 20_000  # cells that give the median of their edges where cells are counted on a sample, about
SHRINK = 1.25  # of the tolerance, from mesh to mesh, until the unknowns fit


def aims(refine: Refine, order: int, d: int, tolerance: float) -> tuple[float, float, float]:
    """Cells across the shortest side, grading, and smallest cell over that side, for a tolerance of the deformation."""
    p = min(order, 3)
    mu = refine.grading if isinstance(refine.grading, float) else BISECTION[p]
    across = MORE[p] + ACROSS[d][p] * (1e-2 / tolerance) ** (1 / (2 * p))
    return across, mu, SMALLEST[d][p] * tolerance


def by_lines(scene: Scene) -> bool:
    """Whether the scene's graded mesh is a box with moved lines."""
    refine, tissue = scene.tissue.refine, scene.tissue
    if refine is None or tissue.size is None or refine.method == "bisect":
        return False
    return refine.method == "lines" or len(tissue.size) == 3 or refine.tolerance is None


def refined_mesh(comm: MPI.Intracomm, scene: Scene, tolerance: float | None = None) -> TissueMesh:
    """The a-priori mesh of a scene with `[tissue.refine]`. Collective; rank 0 bisects.

    Raises:
        SceneError: even the coarsest mesh has more than ``tissue.refine.most`` unknowns.
        MeshError: the mesh file is wrong, or its cells cannot be bisected.
    """
    refine = scene.tissue.refine
    if refine is None:
        return make_mesh(comm, scene)
    goal = tolerance or refine.tolerance
    if by_lines(scene):
        return _lined(comm, scene, refine, goal)
    whole: Whole | None = None
    with raise_on_all_ranks(comm):
        if comm.rank == 0:
            whole = _bisected(scene, refine, goal)
    return distribute(comm, whole)


def _lined(comm: MPI.Intracomm, scene: Scene, refine: Refine, goal: float | None) -> TissueMesh:
    size, p = scene.tissue.size or [], min(scene.tissue.order, 3)
    mu = LINES[p] if refine.grading == "auto" else 1.0 if refine.grading == "off" else refine.grading
    return box_of_lines(comm, scene, lined_cells(scene, refine, goal), mu, min(size) / 2)


def lined_cells(scene: Scene, refine: Refine, goal: float | None) -> list[int]:
    """Numbers of cells along the sides of a box with moved lines, for a tolerance or else those of the scene.

    Raises SceneError: even the fewest have more than ``tissue.refine.most`` unknowns.
    """
    size, cells, p = scene.tissue.size or [], list(scene.tissue.cells or []), min(scene.tissue.order, 3)
    if goal is None:
        if lattice(cells, p) > refine.most:
            raise too_large(refine, lattice(cells, p))
        return cells
    across = LINES_ACROSS[len(size)][p] * (1e-2 / goal) ** (1 / (2 * p))
    while lattice(cells := even_cells(scene, min(size) / across), p) > refine.most:
        if across <= 1:
            raise too_large(refine, lattice(cells, p))
        across = max(across / 1.1, 1.0)
    return cells


def _bisected(scene: Scene, refine: Refine, goal: float | None) -> Whole:
    """The bisected mesh, on one rank."""
    order, aim = scene.tissue.order, goal
    while True:
        whole = _base(scene, refine, aim)
        if unknowns(whole, order) > refine.most and (aim is None or aim > 1):
            raise too_large(refine, unknowns(whole, order))
        whole = graded(whole, scene, refine, aim)
        if unknowns(whole, order) <= refine.most:
            break
        if aim is None:
            raise too_large(refine, unknowns(whole, order))
        aim *= SHRINK
    if refine.contact == "inherit":
        return whole
    cells, facets = ({k: v for k, v in marks.items() if k.endswith("_tags")} for marks in (whole.cells, whole.facets))
    return replace(whole, cells=cells, facets=facets)  # zone and layers are selected again


def _base(scene: Scene, refine: Refine, aim: float | None) -> Whole:
    """The mesh to bisect with contact zone and layers marked."""
    return marked(_even(scene, _base_cells(scene, refine, aim)), scene)


def _base_cells(scene: Scene, refine: Refine, aim: float | None) -> list[int] | None:
    """Numbers of cells along the sides of a box that is to be bisected."""
    size = scene.tissue.size
    if size is None or aim is None:
        return scene.tissue.cells
    across, *_ = aims(refine, scene.tissue.order, len(size), aim)
    return even_cells(scene, min(size) / across)


def marked(tissue: TissueMesh, scene: Scene) -> Whole:
    """A mesh on one rank with its contact zone, layers and tags as marks."""
    facets = contact_facets(tissue, scene.contact)
    on_cells = {"layers": layer_numbers(tissue, scene)[1].astype(np.int32)}
    if tissue.cell_tags is not None:
        tags = np.zeros(tissue.owned, dtype=np.int32)
        tags[tissue.cell_tags.indices] = tissue.cell_tags.values
        on_cells["cell_tags"] = tags
    contact = dolfinx.mesh.meshtags(
        tissue.mesh, tissue.dimension - 1, np.sort(facets), np.ones(len(facets), dtype=np.int32)
    )
    on_facets = {"contact": contact}
    if tissue.facet_tags is not None:
        on_facets["facet_tags"] = tissue.facet_tags
    return Whole(tissue.mesh, tissue.source, on_cells, on_facets, tissue.facet_sets, tissue.cell_sets)


def ends_of(whole: Whole, scene: Scene) -> Ends:
    """Singular ends of a marked mesh."""
    number = whole.cells["layers"].astype(np.int64)
    return ends_at(scene, (whole.points, whole.simplices), whole.facet_nodes("contact"), number)


def ends_at(scene: Scene, mesh: tuple[Floats, Integers], held: Integers, layers: Integers) -> Ends:
    """Singular ends of a mesh of points and cells, with its contact facets and the number of each cell's layer."""
    materials = [*(layer.material for layer in scene.tissue.layers.values()), scene.tissue.material]
    return singular_ends(*mesh, held, layers, np.array([m.nu for m in materials])[layers])


def graded(whole: Whole, scene: Scene, refine: Refine, aim: float | None) -> Whole:
    """Bisect until the cells have their a-priori sizes."""
    if refine.grading == "off":
        return whole
    lengths = _lengths(whole.points, whole.simplices)
    return bisect_to(whole, size_field(scene, refine, aim, ends_of(whole, scene), lengths), SLACK, refine.most)


def _lengths(points: Floats, cells: Integers) -> tuple[float, float]:
    """Shortest side of the box around a body, and median of the longest edges of its cells [m]."""
    return float(np.ptp(points, axis=0).min()), float(np.median(longest_edges(points, cells)))


def size_field(scene: Scene, refine: Refine, aim: float | None, ends: Ends, lengths: tuple[float, float]) -> SizeField:
    """The a-priori sizes of cells. ``lengths``: of :func:`_lengths`."""
    (short, h0), d, order = lengths, ends.at.shape[2], scene.tissue.order
    p = min(order, 3)
    if aim is None:
        mu = BISECTION[p] if refine.grading == "auto" else refine.grading
        assert isinstance(mu, float)  # graded meshes only
        return SizeField(ends, h0, max(short / 2, h0), mu, DEEPEST[d] * h0)
    across, mu, smallest = aims(refine, order, d, aim)
    return SizeField(ends, np.sqrt(d) * short / across, short / 2, mu, smallest * short)


def sampled_cells(
    scene: Scene, refine: Refine, ends: Ends, base: tuple[Floats, Integers], each: float
) -> tuple[float, bool]:
    """About how many cells the bisected mesh has, and whether its tolerance grew; see :func:`bisected_count`.

    Args:
        ends: singular ends of the body.
        base: points (n, d) [m] and cells (m, d + 1) of the mesh to bisect.
        each: unknowns a cell [1].
    """
    points, cells = base
    if refine.grading == "off":
        return float(len(cells)), False
    lengths = _lengths(points, cells[:: max(len(cells) // MEDIAN_OF, 1)])

    def count(shrunk: int) -> float:
        aim = None if refine.tolerance is None else refine.tolerance * SHRINK**shrunk
        return bisected_count(points, cells, size_field(scene, refine, aim, ends, lengths))

    found = count(0)
    if refine.tolerance is None or each * found <= refine.most:
        return found, False
    low, high = 0, math.ceil(math.log(1 / refine.tolerance, SHRINK))  # too fine, and as coarse as may be
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if each * count(middle) <= refine.most else (middle, high)
    return count(high), True


def sampled_box(scene: Scene, refine: Refine) -> tuple[Whole, Ends, float, float | None]:
    """The mesh from which a box is bisected, its singular ends, about how many cells are left, and for which tolerance.

    On one rank; see :func:`bisected_count`. Raises SceneError: see :func:`refined_mesh`.
    """
    order, aim = scene.tissue.order, refine.tolerance
    while True:
        count = lattice(_base_cells(scene, refine, aim) or [], order)
        if count <= refine.most:
            whole = _base(scene, refine, aim)
            points, cells, ends = whole.points, whole.simplices, ends_of(whole, scene)
            many = float(len(cells))
            if refine.grading != "off":
                many = bisected_count(points, cells, size_field(scene, refine, aim, ends, _lengths(points, cells)))
            each = whole.dimension * order**whole.dimension / math.factorial(whole.dimension)  # far from the boundary
            if aim is None or count + each * (many - len(cells)) <= refine.most:
                return whole, ends, many, aim
        elif aim is None or aim > 1:
            raise too_large(refine, count)
        assert aim is not None  # a mesh without a tolerance was returned or refused
        aim *= SHRINK


def unknowns(whole: Whole, order: int) -> int:
    """Displacement unknowns of a mesh, the hand's contact zone included."""
    cells, d = np.sort(whole.simplices, axis=1), whole.dimension
    count = len(whole.points)
    if order > 1:
        pairs = np.concatenate([cells[:, list(pair)] for pair in combinations(range(d + 1), 2)])
        count += (order - 1) * len(np.unique(pairs[:, 0] * len(whole.points) + pairs[:, 1]))
    if order > 2:
        count += len(cells) if d == 2 else (4 * len(cells) + int(sort_facets(cells).outer.sum())) // 2
    return d * count


def lattice(cells: list[int], order: int) -> int:
    """Displacement unknowns of a structured box."""
    return len(cells) * int(np.prod([order * n + 1 for n in cells]))


def too_large(refine: Refine, count: int) -> SceneError:
    """The error of a mesh of so many unknowns."""
    return SceneError(
        f"tissue.refine.most = {refine.most} unknowns are fewer than the {count} of the coarsest mesh that "
        "[tissue.refine] allows; raise it, or use larger cells or a lower tissue.order."
    )


def scene_ends(comm: MPI.Intracomm, tissue: TissueMesh, scene: Scene) -> Ends:
    """Singular ends of a scene's body, on all ranks; rank 0 looks at the whole mesh. Collective.

    Raises MeshError: the mesh file cannot be read again.
    """

    def ends() -> Ends:
        whole = tissue.whole
        if whole is None or "contact" not in whole.facets:
            whole = marked(_even(scene, scene.tissue.cells), scene)
        return ends_of(whole, scene)

    return on_root(comm, ends)


def _even(scene: Scene, cells: list[int] | None) -> TissueMesh:
    """The scene's mesh without grading, on one rank; a box meets the ends where the graded one does."""
    if scene.tissue.refine is None or scene.tissue.size is None:
        return make_mesh(MPI.COMM_SELF, scene)
    return box_of_lines(MPI.COMM_SELF, scene, cells or [], 1.0, min(scene.tissue.size) / 2)
