"""From a mesh and a scene to the blocks of hand and tissue, and to the quadrature points of finite strain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import basix
import dolfinx.fem
import numpy as np
import scipy.sparse
import ufl

from softgrasp.fem.errors import MeshError, SceneError
from softgrasp.fem.layout import BlockLayout, bounding_box
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.mesh.tissue_mesh import TissueMesh
from softgrasp.fem.model.contact import (
    cells_in,
    contact_blocks,
    contact_centre,
    contact_facets,
    held_check,
    rigid_modes,
)
from softgrasp.fem.model.patches import make_patches
from softgrasp.fem.model.symmetric import Mirror
from softgrasp.fem.petsc import Array, PETSc, total
from softgrasp.fem.scene.scene import FiniteStrain, Scene
from softgrasp.fem.system import Component, LayerBlocks

if TYPE_CHECKING:
    from softgrasp.fem.energy.layers import LayerEnergy
    from softgrasp.fem.strain.points import QuadraturePoints


@dataclass
class Inventory:
    """Names of the forms and tissue operators that an assembly made."""

    forms: list[str] = field(default_factory=list)  # names of the compiled forms
    operators: list[str] = field(default_factory=list)  # names of the allocated tissue operators


@dataclass(frozen=True)
class Discretisation:
    """Function space and the split of its nodes into contact and free ones."""

    mesh: TissueMesh  # distributed mesh with its marks
    V: Any  # displacement space (Lagrange P1 or P2, blocked)
    contact: np.ndarray  # local numbers of the owned nodes that follow the hand, (k,)
    free: np.ndarray  # local numbers of the owned nodes of the tissue unknowns, (n_local / d,)
    is_e: PETSc.IS  # PETSc index set of the free dofs (blocked)
    R: Array  # rigid modes on the contact rows, zero elsewhere, (owned dofs, n_s)
    layout: BlockLayout  # sizes and ownership of the unknowns
    layers: tuple[str, ...]  # names of the layers
    layer: np.ndarray  # number of the layer of each owned cell, (owned cells,)

    def nodal(self, free: Array, held: Array | float = 0.0) -> Any:
        """The function with these values (n_local,) on the free dofs and ``held`` on the bonded ones. Collective."""
        result = dolfinx.fem.Function(self.V)
        result.x.array[: len(self.R)] = held
        result.x.array.reshape(-1, self.layout.dimension)[self.free] = free.reshape(-1, self.layout.dimension)
        result.x.scatter_forward()
        return result

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Which of the owned free nodes and which of the bonded ones lie on the boundary of the body. Collective."""
        mesh = self.mesh.mesh
        mesh.topology.create_connectivity(self.mesh.dimension - 1, self.mesh.dimension)
        on, _ = contact_blocks(self.V, dolfinx.mesh.exterior_facet_indices(mesh.topology))
        return np.isin(self.free, on), np.isin(self.contact, on)

    def gradients(self, at: Array) -> Array:
        """Gradients of the shape functions at points (q, d) of the reference cell, (owned cells, q, nodes, d) [1/m]."""
        table = self.V.element.basix_element.tabulate(1, at)[1:, :, :, 0]  # (d, q, nodes)
        return np.asarray(np.einsum("kqa,cjk->cqaj", table, np.linalg.inv(self.mesh.edges)))


def discretise(mesh: TissueMesh, scene: Scene) -> Discretisation:
    """Build the space and the block dof maps. Collective.

    Raises:
        SceneError: the contact zone is empty, or a layer has no cell.
        MeshError: part of the body is not held, or every node is in the contact zone.
    """
    d, comm = mesh.dimension, mesh.mesh.comm
    V = dolfinx.fem.functionspace(mesh.mesh, ("Lagrange", scene.tissue.order, (d,)))
    facets = contact_facets(mesh, scene.contact)
    contact, free = contact_blocks(V, facets)
    held_check(mesh, facets)
    index_map = V.dofmap.index_map
    n_e = comm.allreduce(len(free)) * d
    if n_e == 0:
        raise MeshError(
            f"{mesh.source}: every node lies in the contact zone; make [contact] smaller or refine the mesh"
        )
    X = V.tabulate_dof_coordinates()[: index_map.size_local]
    if scene.hand.reference is not None:
        reference = np.asarray(scene.hand.reference, dtype=float)
    else:
        reference = contact_centre(mesh, facets)
    modes = rigid_modes(X, d, scene.effects.rotation, reference)
    R = np.zeros(modes.shape, order="F")
    rows = (contact[:, None] * d + np.arange(d)).ravel()
    R[rows] = modes[rows]
    is_e = PETSc.IS().createBlock(d, (free + index_map.local_range[0]).astype(PETSc.IntType), comm=comm)
    n_local = len(free) * d
    nodes = np.ascontiguousarray(X[free, :d])
    low, high = bounding_box(comm, nodes)
    layout = BlockLayout(
        comm=comm,
        dimension=d,
        n_s=R.shape[1],
        n_e=n_e,
        n_local=n_local,
        start=int(comm.exscan(n_local) or 0),
        nodes=nodes,
        reference=reference,
        order=scene.tissue.order,
        extent=float((high - low).max()) or 1.0,
        held=np.ascontiguousarray(X[contact, :d]),
        patches=cache(partial(make_patches, V, free)) if scene.tissue.order > 1 else None,
    )
    return Discretisation(mesh, V, contact, free, is_e, R, layout, *layer_numbers(mesh, scene))


def _bilinear(V: Any) -> dict[str, Callable[[Any], Any]]:
    """The three affine bilinear forms as functions of the measure."""
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)

    def eps(w: Any) -> Any:
        return ufl.sym(ufl.grad(w))

    return {
        "K_mu": lambda dx: 2 * ufl.inner(eps(u), eps(v)) * dx,
        "K_lambda": lambda dx: ufl.inner(ufl.div(u), ufl.div(v)) * dx,
        "M_1": lambda dx: ufl.inner(u, v) * dx,
    }


def _component(space: Discretisation, A: PETSc.Mat, thickness: float) -> Component:
    """Cut a full matrix into blocks and free it. Collective."""
    if thickness != 1.0:
        A.scale(thickness)
    n_s = space.layout.n_s
    es = np.zeros((space.layout.n_local, n_s), order="F")
    ss = np.zeros((n_s, n_s))
    r, y = A.createVecs()
    for j in range(n_s):
        r.array_w[:] = space.R[:, j]
        A.mult(r, y)
        ss[:, j] = space.R.T @ y.array_r
        part = y.getSubVector(space.is_e)
        es[:, j] = part.array_r
        y.restoreSubVector(space.is_e, part)
    ee = A.createSubMatrix(space.is_e, space.is_e)
    for used in (r, y, A):
        used.destroy()
    return Component(ee, es, total(space.layout.comm, ss))


class Blocks:
    """Forms of one scene as blocks of hand and tissue, layer by layer, in one pattern. Making one is collective."""

    def __init__(self, space: Discretisation, scene: Scene) -> None:
        self.space, self.thickness, self.domain = space, scene.tissue.thickness, space.mesh.mesh
        self.layered = bool(scene.tissue.layers)
        self.cells = [np.flatnonzero(space.layer == i).astype(np.int32) for i in range(len(space.layers))]
        self.csr: Any = None
        self.mirror: Mirror | None = None  # of the pattern of csr
        if len(self.cells) > 1:
            # DOLFINx gives a layer the pattern of its own cells, and sums of layers need one pattern for all
            owned = np.arange(space.mesh.owned, dtype=np.int32)
            whole = ufl.Measure("dx", domain=self.domain, subdomain_data=[(1, owned)])(1)
            self.csr = dolfinx.fem.create_matrix(dolfinx.fem.form(_bilinear(space.V)["M_1"](whole)))

    def __call__(self, form: Callable[[Any], Any], layer: int) -> Component:
        """The blocks of a bilinear form, a function of the measure, on the cells of a layer. Collective."""
        dx = ufl.dx(self.domain)
        if self.layered:
            dx = ufl.Measure("dx", domain=self.domain, subdomain_data=[(1, self.cells[layer])])(1)
        return self.whole(form(dx))

    def whole(self, form: Any, symmetric: bool = True) -> Component:
        """The blocks of a bilinear form, of its symmetric part if it is known to be symmetric. Collective."""
        compiled = dolfinx.fem.form(form)
        self.csr = self.csr or dolfinx.fem.create_matrix(compiled)
        return _component(self.space, self._assembled(compiled, symmetric), self.thickness)

    def _assembled(self, form: Any, symmetric: bool) -> PETSc.Mat:
        """The form's matrix as PETSc AIJ, with the same bits in every run on the same number of ranks. Collective.

        PETSc adds what other ranks give to a row in the order their messages arrive; DOLFINx's own matrix adds it in
        the order of the ranks.
        """
        csr, comm = self.csr, self.domain.comm
        csr.set_value(0.0)
        dolfinx.fem.assemble_matrix(csr, form)
        csr.scatter_reverse()
        rows, columns, d = csr.index_map(0), csr.index_map(1), csr.block_size[0]
        n = rows.size_local
        used = csr.indptr[n]
        numbers = columns.local_to_global(csr.indices[:used].astype(np.int32))
        blocks = csr.data[: used * d * d].reshape(-1, d, d)
        if symmetric:
            self.mirror = self.mirror or Mirror(comm, rows.local_range[0], csr.indptr[: n + 1], numbers)
            blocks = self.mirror.symmetric_part(blocks)
        shape = n * d, columns.size_global * d
        A = scipy.sparse.bsr_matrix((blocks, numbers, csr.indptr[: n + 1]), shape=shape).tocsr()
        A.sort_indices()
        size = ((n * d, rows.size_global * d), (columns.size_local * d, columns.size_global * d))
        entries = (A.indptr.astype(PETSc.IntType), A.indices.astype(PETSc.IntType), A.data)
        return PETSc.Mat().createAIJ(size, bsize=d, csr=entries, comm=comm)


def assemble(
    space: Discretisation, blocks: Blocks, inventory: Inventory, elastic: bool = True
) -> tuple[LayerBlocks, ...]:
    """Assemble K_mu, K_lambda and M_1, once per layer; a uniform body is one layer. Collective.

    One form is compiled for each component: layers share it and differ in their cells only. Without ``elastic`` M_1
    stands in all three places: an own energy brings its stiffness.
    """
    forms = _bilinear(space.V)
    if not elastic:
        forms = {"M_1": forms["M_1"]}
    inventory.forms += list(forms)
    result = []
    for i, name in enumerate(space.layers):
        parts: dict[str, Component] = {}
        for key, form in forms.items():
            parts[key] = blocks(form, i)
            inventory.operators.append(f"{key}[{name}]")
        M_1 = parts["M_1"]
        result.append(LayerBlocks(name, parts.get("K_mu", M_1), parts.get("K_lambda", M_1), M_1))
    return tuple(result)


def layer_materials(scene: Scene, layers: tuple[LayerBlocks, ...]) -> tuple[LayerMaterial, ...]:
    """Material and Kelvin-Voigt time of each layer; cells of no layer carry tissue.material."""
    damping = scene.effects.damping
    beta = damping.beta if damping is not None else 0.0
    result = []
    for blocks in layers:
        layer = scene.tissue.layers.get(blocks.name)
        m = scene.tissue.material if layer is None else layer.material
        own = None if layer is None or damping is None else layer.beta
        result.append(LayerMaterial(m.lam, m.mu, m.rho, beta if own is None else own))
    return tuple(result)


def layer_numbers(mesh: TissueMesh, scene: Scene) -> tuple[tuple[str, ...], np.ndarray]:
    """Names of the layers in the order of their blocks, and the number of the layer of each owned cell. Collective.

    Later layers win where boxes overlap, the rest comes last as ``tissue``. Raises SceneError: a layer has no cell.
    """
    names = (*scene.tissue.layers, "tissue")
    numbers = np.full(mesh.owned, len(names) - 1, dtype=np.intp)
    if mesh.layers is not None and scene.tissue.layers:
        here = mesh.layers.indices < mesh.owned
        numbers[mesh.layers.indices[here]] = mesh.layers.values[here]
    else:
        for i, layer in enumerate(scene.tissue.layers.values()):
            numbers[cells_in(mesh, layer)] = i
    counts = total(mesh.mesh.comm, np.bincount(numbers, minlength=len(names)).astype(np.float64))
    if not counts[:-1].all():
        empty = names[int(np.argmin(counts[:-1] > 0))]
        raise SceneError(f"tissue.layers.{empty} has no cell of the mesh; check its tag or box")
    return names if counts[-1] else names[:-1], numbers


def make_points(
    space: Discretisation, scene: Scene, effect: FiniteStrain, energy: LayerEnergy | None = None
) -> QuadraturePoints:
    """Points of the owned cells; K(0) = K_ee to rounding. Collective."""
    from softgrasp.fem.strain.points import QuadraturePoints, make_gradient  # only scenes with finite strain pay for it

    d, V = space.mesh.dimension, space.V
    edges, cells = space.mesh.edges, space.mesh.owned
    at, weights, _ = quadrature(space)
    volume = np.abs(np.linalg.det(edges)) * scene.tissue.thickness
    vol = (volume[:, None] * weights).ravel()
    first = space.mesh.mesh.topology.index_map(d).local_range[0]
    layout, each = space.layout, len(weights)
    nodes = free_nodes(space)[V.dofmap.list[:cells]]
    law = effect.law if energy is None else energy.law
    B = make_gradient(layout.comm, space.gradients(at), nodes, (layout.n_local, layout.n_e))
    cell = np.repeat(np.arange(first, first + cells), each)
    places = (space.mesh.vertices[:, :1] + at @ edges).reshape(-1, d)
    return QuadraturePoints(B, vol, np.repeat(space.layer, each), cell, places, d, law, effect.tol, energy)


def quadrature(space: Discretisation) -> tuple[Array, Array, int]:
    """Points, positive weights and degree of a rule on the reference cell that is exact for K(0)."""
    element = space.V.element.basix_element
    degree = 1 if element.degree == 1 else 2 * element.degree
    return *basix.make_quadrature(element.cell_type, degree), degree


def free_nodes(space: Discretisation) -> np.ndarray:
    """Number among all free nodes of each local node, ghosts included; -1 where it follows the hand. Collective."""
    d, layout = space.layout.dimension, space.layout
    numbers = np.repeat(layout.start // d + np.arange(len(space.free), dtype=float), d)
    return np.asarray(np.rint(space.nodal(numbers, -1.0).x.array.reshape(-1, d)[:, 0]), dtype=np.intp)
