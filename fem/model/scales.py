"""Scales of a model and of its displacements, from which the gates of the effects are computed."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.effects.damping import ratios
from softgrasp.fem.effects.gate import SMALL_SHARE, Gradient, Problem, Sag
from softgrasp.fem.effects.gravity import EARTH, acceleration
from softgrasp.fem.layout import bounding_box
from softgrasp.fem.material import of_layers
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array, normalising, times_columns, total
from softgrasp.fem.solve.stiffness import factored_stiffness, static_solver
from softgrasp.fem.system import BlockSystem

SMALL_STRAIN = 0.1  # linear elasticity neglects terms of this relative size
EPS = float(np.finfo(float).eps)
SEEN = 1e-8  # share of the largest squared amplitude that a motion needs to count: far above rounding


def gradient(model: Model, z: Array) -> Gradient:
    """Gradient of a displacement z against the hand, local rows (n_local,) [m]. Collective."""
    space, d = model.space, model.space.mesh.dimension
    comm, edges = space.layout.comm, space.mesh.edges
    nodal = space.nodal(z).x.array.reshape(-1, d)
    u = nodal[space.V.dofmap.list[: len(edges), : d + 1]]  # the first d + 1 dofs of a cell sit on its vertices
    size = np.linalg.norm(np.linalg.solve(edges, u[:, 1:] - u[:, :1]), axis=(1, 2))
    volume = np.abs(np.linalg.det(edges))
    parts = np.array([volume[size > SMALL_STRAIN].sum(), volume.sum(), volume @ size**2])
    large, whole, square = total(comm, parts)
    # cells of equal volume may make the share exactly; rounding must not decide
    limit = SMALL_SHARE * whole * (1 + 1e-9)
    steepest = _top(np.column_stack([size, volume]), limit)
    merged = _top(np.concatenate(comm.allgather(steepest)), limit)
    return Gradient(float(merged[0, 0]), float(merged[-1, 0]), float(large / whole), float(np.sqrt(square / whole)))


def _top(rows: Array, limit: float) -> Array:
    """The steepest rows [size, volume], down to the one with which their volume exceeds the limit."""
    ordered = rows[np.argsort(-rows[:, 0], kind="stable")]
    return ordered[: int(np.searchsorted(np.cumsum(ordered[:, 1]), limit, side="right")) + 1]


def magnified(system: BlockSystem, z: Array) -> float:
    """Share by which one rounding of K_ee may change the deformation z: eps sum K_ii z_i^2 / z'Kz [1].

    Neither residual nor drift contains it, since both are computed with the rounded matrix; close to nu = 1/2 they
    are ten to a hundred times smaller than the error. Collective; z are local rows (n_local,).
    """
    diagonal = system.K_ee.getDiagonal()
    parts = np.array([np.dot(diagonal.array_r, z * z), np.dot(z, times_columns(system.K_ee, z[:, None])[:, 0])])
    diagonal.destroy()
    largest, energy = total(system.layout.comm, parts)
    if largest == 0:
        return 0.0
    return float(EPS * largest / energy) if energy > 0 else np.inf


def slowest(system: BlockSystem, Z: Array) -> float:
    """Lowest frequency [1/s] of the clamped tissue in the span of Z - mean(Z), 0 when nothing moves. Collective.

    A Ritz value, omega^2 = min_z z'K z / z'M z: at least the lowest frequency, near it if the run excites its mode.
    Z are displacements against the hand, local rows (n_local, k) [m].
    """
    comm, centre = system.layout.comm, np.eye(Z.shape[1]) - 1 / Z.shape[1]
    M, K = (total(comm, Z.T @ times_columns(A, Z)) for A in (system.M_ee, system.K_ee))
    Q = centre @ normalising(centre @ (M + M.T) @ centre / 2, 0.0, SEEN * np.trace(M))
    if not Q.size:
        return 0.0
    return float(np.sqrt(max(np.linalg.eigvalsh(Q.T @ (K + K.T) @ Q / 2)[0], 0.0)))


def measure_sag(model: Model, a: Array) -> tuple[Sag, Gradient]:
    """K_ee z = G g under the weight, and the gradient of z under G (g - a), with one factor. Collective.

    ``a``: largest acceleration of the hand, (n_s,). Raises SolverError: the solve failed or missed its tolerance.
    """
    scene, system = model.scene, model.system
    layout, d = system.layout, system.layout.dimension
    weight = acceleration(scene, layout.n_s)
    g = np.zeros(layout.n_s) if weight is None else weight
    load = g - a
    if weight is None:
        g = np.eye(layout.n_s)[d - 1] * -EARTH
    columns, solver = system.G @ np.column_stack([g, load]), static_solver(system, scene.time.solver)
    with factored_stiffness(system, solver, reproducible=scene.time.reproducible) as factor:
        Z = factor.columns(columns, "the static equilibrium")
    largest = float(np.linalg.norm(Z[:, 0].reshape(-1, d), axis=1).max(initial=0.0))
    sag = Sag(tuple(g[:d].tolist()), max(layout.comm.allgather(largest)), gradient(model, Z[:, 0]))
    return sag, gradient(model, Z[:, 1])


def measure(model: Model, omega: Array, Phi: Array, a: Array) -> Problem:
    """Length, masses, damping ratios, sag and static response of a model. Collective.

    Args:
        omega: lowest angular frequencies [1/s], (k,), may be empty.
        Phi: their M-orthonormal modes, local rows (n_local, k).
        a: largest acceleration of the hand, (n_s,).

    Raises SolverError: the static problem cannot be solved.
    """
    mesh, system = model.space.mesh, model.system
    low, high = bounding_box(mesh.mesh.comm, mesh.mesh.geometry.x[:, : mesh.dimension])
    mass, inertia = rigid_inertia(model)
    sag, response = measure_sag(model, a)
    return Problem(
        scene=model.scene,
        dimension=mesh.dimension,
        length=float(np.max(high - low)),
        materials=of_layers(system.materials),
        tissue_mass=mass,
        tissue_inertia=inertia,
        omega=tuple(omega.tolist()),
        zeta=tuple(damping_ratios(system, omega, Phi).tolist()),
        sag=sag,
        response=response,
    )


def rigid_inertia(model: Model) -> tuple[float, tuple[float, ...]]:
    """Mass [kg] and moments of inertia about the reference [kg m2] of the rigid tissue, also without rotation.

    Exact on simplices: the integral of x x' over one is V / ((d+1)(d+2)) (sum_i x_i x_i' + s s'), s = sum_i x_i.
    Collective.
    """
    mesh, scene, layout = model.space.mesh, model.scene, model.system.layout
    d = mesh.dimension
    density = np.array([m.rho for m in model.system.materials])[model.space.layer]
    x = mesh.vertices - layout.reference
    edges = x[:, 1:] - x[:, :1]
    weight = density * np.abs(np.linalg.det(edges)) / (2 if d == 2 else 6) * scene.tissue.thickness
    sums = x.sum(axis=1)
    second = np.einsum("c,cia,cib->ab", weight, x, x) + np.einsum("c,ca,cb->ab", weight, sums, sums)
    parts = total(layout.comm, np.append(second.ravel() / ((d + 1) * (d + 2)), weight.sum()))
    squares = np.diag(parts[:-1].reshape(d, d))
    moments = (squares.sum(),) if d == 2 else tuple(squares.sum() - squares)
    return float(parts[-1]), tuple(float(m) for m in moments)


def damping_ratios(system: BlockSystem, omega: Array, Phi: Array) -> Array:
    """zeta_k = phi_k' D phi_k / (2 omega_k) of M-orthonormal modes, (k,). Collective."""
    damping = system.damping
    if omega.size == 0:
        return np.zeros(0)
    zeta = ratios(damping.alpha, damping.beta, omega)
    if damping.matrix is not None:
        D_Phi = times_columns(damping.matrix, Phi)
        zeta = zeta + total(system.layout.comm, np.einsum("ik,ik->k", Phi, D_Phi)) / (2 * omega)
    return np.asarray(zeta)
