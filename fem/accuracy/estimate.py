"""Error of the outputs of a whole run from static solves on its mesh and on a finer space, and where it comes from.

    delta y(t) = y'(t) - y_h(t)

is the difference of two small models (:mod:`softgrasp.fem.accuracy.krylov`) under the scene's own motion, start,
damping and coupling: one of the mesh itself, one of elements of the next order on the same cells, or of a graded mesh
where the mesh has no grading of its own. Both share the time step, whose error cancels. The graded mesh of a mesh file
has its cells, some bisected, and the next order, or it would be no finer away from the ends; that of a box has cells of
its own, and an error too near to its tolerance is left to the next order.

With e_j the differences of static solutions on the finer space and on the mesh, for the loads of the hand's motion (G),
of the lowest modes (M phi_k) and of the outputs (C'), a cell T owes [BR01]

    eta_T = max_t |k_T(e_C, e(t))| + sum_k |C phi_k| |xi_k| omega_k^3 end k_T(e_k, e_k) / 2,

the first for the static response to the momentary load and acceleration, e(t) = e_G c(t) - sum_k e_k xi_k''(t), the
second for the phase that the modes lose until the end.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

import basix
import dolfinx.fem
import dolfinx.mesh
import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from softgrasp.fem.accuracy.krylov import KrylovModel, krylov_model, run_krylov, static_solves
from softgrasp.fem.accuracy.surplus import MODES, prolong, surplus_model
from softgrasp.fem.errors import SceneError
from softgrasp.fem.layout import bounding_box
from softgrasp.fem.mesh.tissue_mesh import TissueMesh
from softgrasp.fem.model.build import MeshEstimate, Model, build
from softgrasp.fem.model.contact import contact_facets
from softgrasp.fem.petsc import Array, rows_on_root, times_columns
from softgrasp.fem.scene.tissue import Material, Refine
from softgrasp.fem.system import layered_viscosity

if TYPE_CHECKING:
    from softgrasp.fem.scene.scene import Scene


# Error over estimate is at most 1 / (1 - q) when the finer space leaves the share q of the error: 0.28 from P1 to P2
# and 0.51 from P2 to P3 on uniform meshes with exponents of 1/2, where both converge with order 1.
BOUNDS = {1: 1.5, 2: 2.2, 3: 3.0}
GRADED_BOUND = 1.5
SHARE = 0.2  # of the estimate that a graded mesh may leave by its own tolerance
COMPARED = {2: (1e-2, 1e-3), 3: (3e-2,)}  # tolerances of graded meshes to compare with, by dimension
MOST_COMPARED = 60_000  # unknowns of such a mesh


def estimate(
    model: Model,
    coarse: KrylovModel | None = None,
    finer: KrylovModel | None = None,
    *,
    surplus: bool = False,
    cells: list[int] | None = None,
) -> MeshEstimate:
    """Estimate the error that the mesh leaves in the outputs of the scene's run. Collective.

    Args:
        coarse: its small model, if there is one.
        finer: that of :func:`next_order`, likewise, for scenes with ``tissue.refine``.
        surplus: correct the next order by some iterations instead of solving there, for scenes with ``tissue.refine``.
        cells: of a coarser box, whose error is extrapolated to the model's.

    Raises:
        SolverError: a static solve fails.
        SceneError, MeshError: the graded mesh to compare with cannot be made, or is too large.
    """
    begin = time.perf_counter()
    if cells is not None:
        tissue = model.scene.tissue.model_copy(update={"cells": cells})
        result = estimate(like(model, model.scene.model_copy(update={"tissue": tissue})))
        seconds = model.system.layout.comm.allreduce(time.perf_counter() - begin, MPI.MAX)
        return replace(extrapolated(result, model), seconds=seconds)
    small = coarse or krylov_model(model)
    run = small.run
    if model.scene.tissue.refine is not None:
        up = next_order(model) if finer is None else finer.model
        other = finer or (surplus_model(small, up) if surplus else krylov_model(up))
        by, bound, offer = "order", BOUNDS[min(model.scene.tissue.order, 3)], None
        relative, delta = difference(small, other)
        bound *= relative
    else:
        other, relative, delta, bound, by, offer = _compared(model, small)
    halved = run_krylov(small, 2 * model.scene.time.steps).deformation[::2]
    late, _ = difference(small, small, halved)
    delta = delta + other.run.rigid - run.rigid
    seen = min(2, len(small.M), len(other.M))  # a mesh of one free node has one mode that the run can see
    omega = small.modes[0][:seen] / other.modes[0][:seen] - 1
    return MeshEstimate(
        estimate=relative,
        bound=bound,
        delta=delta,
        omega=tuple(float(x) for x in omega),
        time_error=late * 4 / 3,
        shift=zone_shift(model),
        n_e=model.system.layout.n_e,
        finer=other.model.system.layout.n_e,
        by=by,
        offer=offer,
        seconds=model.system.layout.comm.allreduce(time.perf_counter() - begin, MPI.MAX),
    )


def extrapolated(result: MeshEstimate, model: Model, n_e: int | None = None) -> MeshEstimate:
    """The estimate of a box from that of the same box on coarser cells. Collective.

    On lines that crowd at singular ends errors fall with the order of the elements, on even cells with order 1, in
    n_e^(1/d). So the estimate is 0.6 to 1.8 of that on the cells themselves, see the tests; the bound allows twice.

    ``n_e``: unknowns of the box; None: those of the model.
    """
    layout, tissue = model.system.layout, model.scene.tissue
    graded = tissue.refine is not None and tissue.refine.grading != "off"
    unknowns = n_e or layout.n_e
    share = (result.n_e / unknowns) ** ((tissue.order if graded else 1) / layout.dimension)
    return replace(
        result,
        estimate=share * result.estimate,
        bound=min(2 * share, 1.0) * result.bound,
        delta=np.zeros_like(result.delta),
        omega=tuple(share * x for x in result.omega),
        shift=zone_shift(model),
        n_e=unknowns,
        by="coarser",
    )


def _compared(
    model: Model, small: KrylovModel
) -> tuple[KrylovModel, float, Array, float, str, tuple[float, int] | None]:
    """Finer model, estimate, delta y, bound, by and offer of :class:`MeshEstimate` for an ungraded mesh. Collective."""
    by, offer, box, order = "graded", None, model.scene.tissue.size is not None, model.scene.tissue.order
    count = next_unknowns(model)
    if not box and count > MOST_COMPARED:
        raise SceneError(
            f"elements of the next order to compare with would have about {count} unknowns, more than the "
            f"{MOST_COMPARED} of an estimate; run the scene with another tissue.order and compare the outputs."
        )
    for goal in COMPARED[model.system.layout.dimension]:
        other = krylov_model(like(model, comparison(model.scene, goal)))
        relative, delta = difference(small, other)
        if other.model.scene.tissue.order == 2:
            offer = (goal, other.model.system.layout.n_e)
        if relative > goal / SHARE or relative == 0:
            return other, relative, delta, GRADED_BOUND * relative, by, offer
    bound = GRADED_BOUND * relative + goal
    if box and count <= MOST_COMPARED:
        up = krylov_model(next_order(model))
        more, change = difference(small, up)
        if more > relative:
            return up, more, change, max(bound, BOUNDS[min(order, 3)] * more), "order", offer
    return other, relative, delta, bound, by, offer


def difference(small: KrylovModel, other: KrylovModel, finer: Array | None = None) -> tuple[float, Array]:
    """Largest difference of two runs over the largest deformation [1], and the difference (steps + 1, p).

    Outputs that are the hand's count only where there are no others.

    ``finer``: deformation (steps + 1, p) instead of that of the other's run.
    """
    finer = other.run.deformation if finer is None else finer
    tissue = np.abs(small.C).max(axis=1) + np.abs(other.C).max(axis=1) > 0
    if not tissue.any():
        tissue[:] = True
    delta = finer - small.run.deformation
    scale = np.linalg.norm(finer[:, tissue], axis=1).max()
    largest = np.linalg.norm(delta[:, tissue], axis=1).max()
    return float(largest / scale) if scale > 0 else 0.0, delta


def next_order(model: Model) -> Model:
    """The same cells with elements of the next order. Collective."""
    tissue = model.scene.tissue.model_copy(update={"order": model.scene.tissue.order + 1})
    return like(model, model.scene.model_copy(update={"tissue": tissue}), model.space.mesh)


def like(model: Model, scene: Scene, mesh: TissueMesh | None = None) -> Model:
    """The model of another mesh or order with the materials and the damping of a model, linear. Collective.

    Raises SceneError, MeshError, ResourceError: see :func:`softgrasp.fem.model.build.build`.
    """
    system, tissue, damping = model.system, scene.tissue, model.system.damping
    own = {blocks.name: m for blocks, m in zip(system.layers, system.materials, strict=True)}

    def material(name: str, of: Material) -> Material:
        m = own.get(name)  # None: every cell of the model is in a layer
        return of if m is None else of.model_copy(update={"lam": m.lam, "mu": m.mu, "rho": m.rho})

    layers = {k: part.model_copy(update={"material": material(k, part.material)}) for k, part in tissue.layers.items()}
    tissue = tissue.model_copy(update={"layers": layers, "material": material("tissue", tissue.material)})
    if system.energy is not None:
        tissue = tissue.model_copy(update=system.energy.tables(tissue, system.materials))
    effects = scene.effects.model_copy(update={"finite_strain": None})
    scene = scene.model_copy(update={"tissue": tissue, "effects": effects})
    other = build(scene, comm=system.layout.comm, mesh=mesh)
    if damping.matrix is not None:
        betas = {name: m.beta for name, m in own.items()}
        pairs = zip(other.system.layers, other.system.materials, strict=True)
        viscous = tuple(replace(m, beta=betas.get(blocks.name, m.beta)) for blocks, m in pairs)
        damping = replace(damping, matrix=layered_viscosity(other.system.layers, viscous))
    return replace(other, system=replace(other.system, damping=damping))


def next_unknowns(model: Model) -> int:
    """About how many unknowns the next order has."""
    order, layout = model.scene.tissue.order, model.system.layout
    return int(layout.n_e * ((order + 1) / order) ** layout.dimension)


def comparison(scene: Scene, tolerance: float) -> Scene:
    """The scene on a graded mesh of quadratic elements or better, on that of a mesh file of the next order."""
    tissue = scene.tissue
    refine = Refine(tolerance=tolerance, most=MOST_COMPARED)
    order = tissue.order + 1 if tissue.size is None else max(2, tissue.order)
    tissue = tissue.model_copy(update={"order": order, "refine": refine})
    return scene.model_copy(update={"tissue": tissue})


def zone_shift(model: Model) -> float:
    """Largest distance of the contact zone's ends from the faces of ``contact.box`` inside the body [m]. Collective.

    Facets count by their midpoints, so that a zone may end half a cell beyond or short of the box.
    """
    mesh, box, comm = model.space.mesh, model.scene.contact.box, model.system.layout.comm
    if box is None:
        return 0.0
    facets = contact_facets(mesh, model.scene.contact)
    mesh.mesh.topology.create_connectivity(mesh.dimension - 1, mesh.dimension)
    nodes = dolfinx.mesh.entities_to_geometry(mesh.mesh, mesh.dimension - 1, facets).ravel()
    x = mesh.mesh.geometry.x[:, : mesh.dimension]
    held, body = bounding_box(comm, x[nodes]), bounding_box(comm, x)
    slack = 1e-9 * (body[1] - body[0])
    low, high = (np.asarray(corner) for corner in box)
    below = np.where(low > body[0] + slack, np.abs(held[0] - low), 0.0)
    above = np.where(high < body[1] - slack, np.abs(held[1] - high), 0.0)
    ends = np.maximum(below, above)
    return float(ends[ends > slack].max(initial=0.0))


INSTANTS = 100
DIGITS = 7  # of the largest eta_T that count: solves carry more, and cells that mirror each other stay together
GAIN = 1.2  # eta_T of the marked cells over what bisection removes of it: it splits their neighbours too
LEAST, LARGEST = 0.15, 0.8  # share of the marked cells in the sum of eta_T [D96]


def marked_cells(small: KrylovModel, finer: KrylovModel, factor: float) -> npt.NDArray[np.int32] | None:
    """Cells to split, in the order of the mesh on rank 0; None on other ranks. Collective.

    Args:
        finer: that of elements of the next order on the same cells.
        factor: by which the error should fall, below 1.
    """
    share = float(np.clip((1 - factor) / GAIN, LEAST, LARGEST))
    eta = indicators(small, finer)
    topology = small.model.space.mesh.mesh.topology
    original = np.asarray(topology.original_cell_index)[: len(eta)]
    cells, values = (rows_on_root(small.model.system.layout.comm, part) for part in (original, eta))
    if cells is None or values is None:
        return None
    values = np.round(values / (values.max() or 1.0), DIGITS)  # rounding must not choose, nor the number of ranks
    largest = np.sort(values)[::-1]
    total = np.cumsum(largest)
    least = largest[min(int(np.searchsorted(total, share * total[-1])), len(total) - 1)]
    return np.asarray(np.sort(cells[values >= least]), dtype=np.int32)


def indicators(small: KrylovModel, finer: KrylovModel) -> Array:
    """eta_T of the owned cells. Collective."""
    model, n_s, p, run = small.model, small.model.system.layout.n_s, len(small.C), small.run
    omega, Q = small.modes
    m = min(MODES, len(omega))
    Phi = small.V @ Q[:, :m]
    coarse = prolong(model, finer.model, np.hstack([small.X, Phi]))
    with static_solves(finer.model) as solve:
        modal = solve(times_columns(finer.model.system.M_ee, coarse[:, n_s + p :]))
    e = np.hstack([finer.X, modal]) - coarse / np.concatenate([np.ones(n_s + p), omega[:m] ** 2])
    at = np.unique(np.linspace(0, len(run.loads) - 1, INSTANTS).round().astype(int))
    accelerations = run.accelerations[at] @ (small.M @ Q[:, :m])  # xi'' = Phi' M z''
    s = np.hstack([run.loads[at], np.zeros((len(at), p)), -accelerations])
    E = cell_products(finer.model, e)
    statics = np.linalg.norm(np.einsum("ckj,tj->ckt", E[:, n_s : n_s + p], s, optimize=True), axis=1).max(axis=1)
    amplitude = np.abs(accelerations).max(axis=0) / omega[:m] ** 2
    reach = np.linalg.norm(small.C @ Q[:, :m], axis=0) * amplitude * omega[:m] ** 3 * model.scene.time_end / 2
    phases = np.einsum("ckk->ck", E[:, n_s + p :, n_s + p :]) @ np.minimum(reach, np.sqrt(reach.max() * reach))
    return np.asarray(statics + phases)


def cell_products(model: Model, X: Array) -> Array:
    """Elastic energy products k_T(x_i, x_j) of columns on the owned cells, (cells, k, k). Collective."""
    V, d, tissue = model.space.V, model.space.mesh.dimension, model.space.mesh
    lam, mu = np.array([(m.lam, m.mu) for m in model.system.materials])[model.space.layer].T
    cells, own = tissue.owned, model.system.energy
    element = V.element.basix_element
    points, weights = basix.make_quadrature(element.cell_type, max(2 * (element.degree - 1), 1))
    scale = np.abs(np.linalg.det(tissue.edges))[:, None] * weights * model.scene.tissue.thickness
    dofs = V.dofmap.list[:cells]
    u = np.zeros((*dofs.shape, d, X.shape[1]))
    for j in range(X.shape[1]):
        u[..., j] = model.space.nodal(X[:, j]).x.array.reshape(-1, d)[dofs]
    E = np.zeros((cells, X.shape[1], X.shape[1]))
    for q in range(len(weights)):  # one point at a time: gradients of all at once would be large
        gradient = np.einsum("cnb,cnik->cibk", model.space.gradients(points[q : q + 1])[:, 0], u, optimize=True)
        if own is not None:
            X = tissue.vertices[:, 0] + points[q] @ tissue.edges
            moduli = own.at_rest(model.system.materials, model.space.layer, X) * scale[:, q]
            E += np.einsum("cibk,ibjac,cjal->ckl", gradient, moduli, gradient, optimize=True)
            continue
        strain = (gradient + np.swapaxes(gradient, 1, 2)) / 2
        flat = strain.reshape(cells, d * d, -1)
        trace = np.einsum("ciik->ck", strain)
        E += (scale[:, q] * 2 * mu)[:, None, None] * (np.swapaxes(flat, 1, 2) @ flat)
        E += (scale[:, q] * lam)[:, None, None] * trace[:, :, None] * trace[:, None, :]
    return E
