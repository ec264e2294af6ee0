"""The scales of a model that the gates are computed from."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.effects.damping import ratios
from softgrasp.fem.effects.gate import Problem
from softgrasp.fem.fields.sag import measure_sag
from softgrasp.fem.layout import bounding_box
from softgrasp.fem.mesh.tissue_mesh import cell_nodes
from softgrasp.fem.model.assembly import layer_numbers
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array, times_columns, total
from softgrasp.fem.system import BlockSystem


def measure(model: Model, omega: Array, Phi: Array, a: Array) -> Problem:
    """Length, masses, damping ratios, sag and static response of a model. Collective.

    Args:
        omega: lowest angular frequencies [1/s], (k,), may be empty.
        Phi: their M-orthonormal modes, local rows (n_local, k).
        a: largest acceleration of the hand, (n_s,).

    Raises:
        SolverError: the static problem cannot be solved.
    """
    mesh, system = model.space.mesh, model.system
    low, high = bounding_box(mesh.mesh.comm, mesh.mesh.geometry.x[:, : mesh.dimension])
    mass, inertia = rigid_inertia(model)
    sag, response = measure_sag(model, a)
    return Problem(
        scene=model.scene,
        dimension=mesh.dimension,
        length=float(np.max(high - low)),
        materials=system.materials,
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
    d, geometry = mesh.dimension, mesh.mesh.geometry
    owned = mesh.mesh.topology.index_map(d).size_local
    density = np.array([m.rho for m in model.system.materials])[layer_numbers(mesh, scene)[1]]
    x = geometry.x[cell_nodes(mesh.mesh)[:owned], :d] - layout.reference
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
