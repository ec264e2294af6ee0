"""Scenes from a few keys, blocks gathered in one order of nodes, and the same model by scikit-fem and SciPy."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
import skfem
from mpi4py import MPI
from numpy.typing import NDArray
from skfem.helpers import ddot, div, dot, sym_grad

from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.mesh.make import make_mesh
from softgrasp.fem.mesh.tissue_mesh import cell_nodes
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import PETSc, to_scipy
from softgrasp.fem.run.simulate import Run, RunOptions
from softgrasp.fem.run.stepping import make_ts
from softgrasp.fem.scene.file import resolved_toml
from softgrasp.fem.scene.scene import Scene

Array = NDArray[np.float64]

BLOCK: dict[str, Any] = {
    "name": "block",
    "tissue": {"size": [1.0, 2.0], "cells": [4, 8], "material": {"lambda": 50.0, "mu": 50.0, "rho": 1.0}},
    "contact": {"sides": ["left", "right"], "box": [[0.0, 1.5], [1.0, 2.0]]},
    "hand": {"mass": 20.0, "inertia": 3.0},
    "motion": {"target": [5.0, 3.0], "duration": 3.0},
    "time": {"steps": 60},
}
CUBE: dict[str, Any] = {
    "tissue": {"size": [1.0, 0.8, 0.6], "cells": [2, 2, 3]},
    "contact": {"sides": ["z+"], "box": [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]},
    "motion": {"target": [0.3, 0.2, 0.1]},
}
LAYERS: dict[str, Any] = {
    "low": {
        "box": [[0.0, 0.0], [1.0, 0.5]],
        "material": {"lambda": 90.0, "mu": 20.0, "rho": 2.5},
        "beta": 0.03,
    },
    "core": {"box": [[0.25, 0.25], [0.75, 1.0]], "material": {"lambda": 10.0, "mu": 70.0, "rho": 0.5}},
}


def merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Nested tables are merged, everything else replaced; E and nu replace the Lame constants."""
    result = dict(base)
    for key, value in changes.items():
        old = result.get(key)
        both = isinstance(old, dict) and isinstance(value, dict) and "young" not in value
        result[key] = merged(old, value) if both else value
    return result


def make_scene(*changes: dict[str, Any], **tables: Any) -> Scene:
    """The paper's block on 4 x 8 cells, with changes; a hand that turns is told to end at zero angles."""
    data = BLOCK
    for change in (*changes, tables):
        data = merged(data, change)
    target, d = data["motion"].get("target"), len(data["tissue"]["size"])
    if target and data.get("effects", {}).get("rotation") and len(target) == d:
        data = merged(data, {"motion": {"target": [*target, *[0.0] * (d * (d - 1) // 2)]}})
    return Scene.model_validate(data)


def write_scene(comm: MPI.Intracomm, folder: Path, scene: Scene) -> Path:
    """The scene as a file of its name. Collective."""
    file = folder / f"{scene.name}.toml"
    if comm.rank == 0:
        folder.mkdir(parents=True, exist_ok=True)
        file.write_text(resolved_toml(scene))
    comm.Barrier()
    return file


# --- one order of nodes for every rank count


def node_order(points: Array) -> NDArray[np.int64]:
    """Permutation that sorts nodes by x, then y, then z."""
    return np.lexsort(np.round(points, 9).T[::-1])


def dof_order(points: Array) -> NDArray[np.int64]:
    """The same for blocked dofs."""
    d = points.shape[1]
    return (node_order(points)[:, None] * d + np.arange(d)).ravel()


def all_nodes(layout: BlockLayout) -> Array:
    """Coordinates of all free nodes in global numbering. Collective."""
    return np.concatenate(layout.comm.allgather(layout.nodes))


def gather_rows(layout: BlockLayout, local: Array) -> Array:
    """Rows of a distributed array in node order, on every rank. Collective."""
    return np.concatenate(layout.comm.allgather(np.array(local)))[dof_order(all_nodes(layout))]


def gather_states(layout: BlockLayout, Z: Array) -> Array:
    """[z; v] columns in node order, on every rank. Collective."""
    n = layout.n_local
    return np.concatenate([gather_rows(layout, Z[:n]), gather_rows(layout, Z[n:])])


def local_rows(layout: BlockLayout, full: Array) -> Array:
    """This rank's rows of an array in node order: the inverse of `gather_rows`. Collective."""
    order = dof_order(all_nodes(layout))
    result = np.empty_like(full)
    result[order] = full
    return result[layout.start : layout.start + layout.n_local]


def gather_matrix(layout: BlockLayout, A: PETSc.Mat) -> scipy.sparse.csr_matrix:
    """A distributed tissue matrix in node order, on every rank. Collective."""
    order = dof_order(all_nodes(layout))
    return scipy.sparse.vstack(layout.comm.allgather(to_scipy(A))).tocsr()[order][:, order]


def gather_mesh(mesh: Any) -> tuple[Array, NDArray[np.int64]]:
    """All points (n, d) and owned cells (n_cells, d + 1) of a distributed mesh, on every rank. Collective."""
    comm, d = mesh.comm, mesh.geometry.dim
    to_global = mesh.geometry.index_map().local_to_global(np.arange(len(mesh.geometry.x), dtype=np.int32))
    owned = mesh.topology.index_map(mesh.topology.dim).size_local
    cells = np.concatenate(comm.allgather(to_global[cell_nodes(mesh)[:owned]]))
    points = np.empty((mesh.geometry.index_map().size_global, d))
    for index, x in comm.allgather((to_global, mesh.geometry.x[:, :d])):
        points[index] = x
    return points, cells


# --- the same model by scikit-fem

Held = Callable[[Array], Any]


def held_by_paper(x: Array) -> Any:
    """Facet midpoints on the sides of the block from y = 1.5 up."""
    return (x[1] > 1.5 - 1e-9) & (np.minimum(abs(x[0]), abs(x[0] - 1)) < 1e-9)


def held_on_top(x: Array) -> Any:
    """Facet midpoints on top of the cube."""
    return abs(x[2] - 0.6) < 1e-9


@skfem.BilinearForm
def _k_mu(u: Any, v: Any, w: Any) -> Any:
    return 2 * ddot(sym_grad(u), sym_grad(v))


@skfem.BilinearForm
def _k_lambda(u: Any, v: Any, w: Any) -> Any:
    return div(u) * div(v)


@skfem.BilinearForm
def _mass(u: Any, v: Any, w: Any) -> Any:
    return dot(u, v)


@dataclass(frozen=True)
class Reference:
    """Matrices on all nodes in node order, layer by layer, and which nodes the hand holds."""

    scene: Scene
    nodes: Array
    contact: NDArray[np.bool_]
    M_layers: list[Array]
    K_layers: list[Array]
    betas: list[float]
    centre: Array  # of the zone

    @property
    def d(self) -> int:
        return self.nodes.shape[1]

    @property
    def held(self) -> NDArray[np.bool_]:
        return np.repeat(self.contact, self.d)

    @property
    def M(self) -> Array:
        return sum(self.M_layers)

    @property
    def K(self) -> Array:
        return sum(self.K_layers)

    @property
    def R(self) -> Array:
        """Rigid motions of all nodes: translations, then rotations e_k x r."""
        r = self.nodes - self.centre
        modes = [np.tile(e, (len(r), 1)) for e in np.eye(self.d)]
        if self.scene.effects.rotation:
            r3 = np.pad(r, ((0, 0), (0, 3 - self.d)))
            axes = np.eye(3) if self.d == 3 else np.eye(3)[2:]
            modes += [np.cross(axis, r3)[:, : self.d] for axis in axes]
        return np.stack([m.ravel() for m in modes], axis=1)

    @property
    def T(self) -> Array:
        return self.R[~self.held]

    @property
    def P(self) -> Array:
        """All nodes from [q_s; q_e]."""
        free = np.flatnonzero(~self.held)
        P = np.zeros((len(self.held), self.R.shape[1] + len(free)))
        P[:, : self.R.shape[1]] = self.R * self.held[:, None]
        P[free, self.R.shape[1] + np.arange(len(free))] = 1
        return P

    @property
    def M_hand(self) -> Array:
        hand, d = self.scene.hand, self.d
        M = np.eye(self.R.shape[1]) * hand.mass
        if self.scene.effects.rotation:
            M[d:, d:] = np.diag(np.broadcast_to(hand.inertia, M.shape[0] - d))
        return M


def reference(model: Model, held: Held = held_by_paper) -> Reference:
    """Assemble the model's mesh with scikit-fem. Collective."""
    scene, tissue = model.scene, model.scene.tissue
    points, cells = gather_mesh(model.space.mesh.mesh)
    d = points.shape[1]
    mesh = (skfem.MeshTri if d == 2 else skfem.MeshTet)(points.T.copy(), cells.T.astype(np.int64).copy())
    scalar = {
        (2, 1): skfem.ElementTriP1, (2, 2): skfem.ElementTriP2,
        (3, 1): skfem.ElementTetP1, (3, 2): skfem.ElementTetP2,
    }[d, tissue.order]()  # fmt: skip
    middle = mesh.p[:, mesh.t].mean(axis=1)
    label = np.zeros(mesh.t.shape[1], dtype=int)
    for i, layer in enumerate(tissue.layers.values()):
        low, high = np.array(layer.box)[:, :, None]
        label[((middle > low) & (middle < high)).all(axis=0)] = i + 1
    materials = [tissue.material, *(layer.material for layer in tissue.layers.values())]
    damping = scene.effects.damping
    beta = 0.0 if damping is None else damping.beta
    betas = [beta, *(beta if k.beta is None else k.beta for k in tissue.layers.values())]
    M_layers, K_layers = [], []
    for i, m in enumerate(materials):
        basis = skfem.Basis(mesh, skfem.ElementVector(scalar), elements=np.flatnonzero(label == i))
        K = m.mu * _k_mu.assemble(basis) + m.lam * _k_lambda.assemble(basis)
        component = np.zeros(basis.N, dtype=int)
        for block in (basis.nodal_dofs, basis.facet_dofs, basis.edge_dofs):
            for c, dofs in enumerate(block):
                component[dofs] = c
        where = basis.doflocs
        order = np.lexsort((component, *np.round(where, 9)[::-1]))
        K_layers.append(tissue.thickness * K.toarray()[np.ix_(order, order)])
        M_layers.append(tissue.thickness * m.rho * _mass.assemble(basis).toarray()[np.ix_(order, order)])
    on = np.zeros(basis.N, dtype=bool)
    zone = mesh.facets_satisfying(held, boundaries_only=True)
    on[basis.get_dofs(zone).flatten()] = True
    surface = skfem.FacetBasis(mesh, scalar, facets=zone)
    centre = (np.asarray(surface.default_parameters()["x"]) * surface.dx).sum(axis=(1, 2)) / surface.dx.sum()
    return Reference(scene, where.T[order][::d].copy(), on[order][::d].copy(), M_layers, K_layers, betas, centre)


# --- the paper's first-order system E x' = A x + b(u), x = [q_s, q_e, v_s, v_e], in absolute displacements


@dataclass(frozen=True)
class FirstOrder:
    """E x' = A x + B u + f."""

    E: Array
    A: Array
    B: Array
    f: Array
    n_s: int

    def run(self, x: Array, dt: float, loads: Array) -> Array:
        """Implicit midpoint with the load u of each step; all states, one a column."""
        lu = scipy.linalg.lu_factor(self.E - dt / 2 * self.A)
        X = [x]
        for u in loads:
            right = self.E @ x + dt / 2 * (self.A @ x) + dt * (self.B @ u + self.f)
            x = scipy.linalg.lu_solve(lu, right)
            X.append(x)
        return np.array(X).T


def first_order(ref: Reference) -> FirstOrder:
    """Virtual work on all nodes, restricted to [q_s; q_e]; one-way hand rows replaced by M_hand a = u."""
    scene, P, M_hand = ref.scene, ref.P, ref.M_hand
    effects, n_s, n = scene.effects, M_hand.shape[0], P.shape[1]
    M, K = P.T @ ref.M @ P, P.T @ ref.K @ P
    D = P.T @ sum(b * k for b, k in zip(ref.betas, ref.K_layers, strict=True)) @ P
    if effects.damping is not None and effects.damping.alpha:
        # seen from the hand the nodes move with z' = v - R v_s
        S = P if effects.damping.drag == "space" else P - np.pad(ref.R, ((0, 0), (0, n - n_s)))
        D = D + effects.damping.alpha * S.T @ ref.M @ S
    f = np.zeros(n)
    if effects.gravity is not None:
        g = np.array(effects.gravity.g)
        f = P.T @ (ref.M @ np.tile(g, len(ref.nodes)))
    if effects.reaction:
        M[:n_s, :n_s] += M_hand
    else:
        for A in (M, K, D):
            A[:n_s] = 0
        M[:n_s, :n_s] = M_hand
        f[:n_s] = 0
    if effects.gravity is not None and effects.gravity.hand_weight:
        f[: ref.d] += scene.hand.mass * g
    zero, one = np.zeros((n, n)), np.eye(n)
    return FirstOrder(
        E=scipy.linalg.block_diag(one, M),
        A=np.block([[zero, one], [-K, -D]]),
        B=np.eye(2 * n)[:, n : n + n_s],
        f=np.concatenate([np.zeros(n), f]),
        n_s=n_s,
    )


def absolute(model: Model, q_s: Array, v_s: Array, Z: Array) -> Array:
    """States [q_s, q_e, v_s, v_e] in node order from the relative [z; v] of a run. Collective."""
    layout = model.system.layout
    T = gather_rows(layout, model.system.T)
    z, v = np.split(gather_states(layout, Z), 2)
    return np.concatenate([q_s, z + T @ q_s, v_s, v + T @ v_s])


def at_rest(model: Model) -> Array:
    """x(0): no motion, or the static deformation under gravity by a dense solve. Collective."""
    scene, ref_n = model.scene, 2 * (model.system.layout.n_s + model.system.layout.n_e)
    x = np.zeros(ref_n)
    if scene.time.start == "equilibrium":
        layout, n_s = model.system.layout, model.system.layout.n_s
        g = np.zeros(n_s)
        g[: layout.dimension] = scene.effects.gravity.g
        K = gather_matrix(layout, model.system.K_ee).toarray()
        x[n_s : n_s + layout.n_e] = np.linalg.solve(K, gather_rows(layout, model.system.G) @ g)
    return x


def wave(n: int, t: float, q: Array, v: Array) -> Array:
    """A smooth force on the hand [N, N m] that no symmetry of the block hides."""
    k = np.arange(len(q))
    return 40 * np.cos((1.5 + 0.7 * k) * t + 0.4 * k) / (1 + k)


def run_from(model: Model, z: Array, v: Array, v_s: Array | None = None, force: Any = None) -> Run:
    """Run the whole scene from a given tissue state (node order) and hand velocity. Collective."""
    run = Run(model, RunOptions(), force)
    ts = make_ts(run)
    if v_s is not None:
        run.drive.v[0] = v_s
    run.start()
    run.state.z.array_w[:] = local_rows(model.system.layout, z)
    run.state.v.array_w[:] = local_rows(model.system.layout, v)
    run.midpoint.start(run.state)
    run.advance_to(ts, run.steps)
    ts.destroy()
    return run


def rough_save(figure: Any, out_png: Path) -> tuple[Path, ...]:
    """In place of `study.pictures.style.save`, for tests that look at no more than the existence of a picture."""
    import matplotlib.pyplot as plt

    figure.set_layout_engine("none")  # seconds a figure
    figure.savefig(out_png, dpi=30)
    plt.close(figure)
    return out_png, out_png


def close(a: Any, b: Any) -> float:
    """Largest difference over the largest entry."""
    a, b = (x.toarray() if scipy.sparse.issparse(x) else np.asarray(x) for x in (a, b))
    if a.shape != b.shape:
        return float("inf")
    scale = np.abs(b).max(initial=0)
    return float(np.abs(a - b).max(initial=0) / (scale if scale > 0 else 1))


def same_everywhere(comm: MPI.Intracomm, value: Array) -> bool:
    """Whether all ranks hold the same bits. Collective."""
    return len(set(comm.allgather(np.ascontiguousarray(value).tobytes()))) == 1


# --- a mesh graded towards the ends of the contact zone


def graded_model(scene: Scene, comm: MPI.Intracomm) -> Model:
    """The model of a box whose mesh lines crowd, by a cubic map, where the contact zone ends. Collective.

    Uniform meshes of any elements converge with order 1 there; these do not.
    """
    tissue, d = make_mesh(comm, scene), scene.dimension or 0
    size, x = np.array(scene.tissue.size), tissue.mesh.geometry.x
    held = {axis for axis, _ in scene.contact.axes(d)}
    box = np.array(scene.contact.box) / size
    for axis in range(d):
        ends = [0.0, 1.0] if axis in held else [float(b) for b in box[:, axis]]
        x[:, axis] = size[axis] * _crowded(x[:, axis] / size[axis], ends)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("softgrasp.fem.model.build.make_mesh", lambda *_: tissue)
        return build(scene, comm=comm)


def _crowded(s: Array, ends: list[float]) -> Array:
    """A monotone map of [0, 1] onto itself that keeps the ends and takes the steps near them to the third power."""
    cuts, moved = sorted({0.0, 1.0, *ends}), s.copy()
    for a, b in itertools.pairwise(cuts):
        inside = (s >= a - 1e-12) & (s <= b + 1e-12)
        t = np.clip((s[inside] - a) / (b - a), 0.0, 1.0)
        if a in ends and b in ends:
            t = np.where(t <= 0.5, (2 * t) ** 3 / 2, 1 - (2 - 2 * t) ** 3 / 2)
        elif a in ends or b in ends:
            t = t**3 if a in ends else 1 - (1 - t) ** 3
        moved[inside] = a + (b - a) * t
    return moved
