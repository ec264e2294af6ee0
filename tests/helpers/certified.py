"""True errors of certified runs, and what their bounds are made of, from full runs and dense matrices."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import scipy.linalg

from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import times_columns, total
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.run.states.trajectory import Trajectory
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.fem.system import BlockSystem
from softgrasp.reduction.certified.certificate import CertifiedRun
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.certified.training import certified_model
from tests.helpers.models import Array

KELVIN_VOIGT: dict[str, Any] = {"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.002}}}
TURNING: dict[str, Any] = {"effects": {"rotation": True, "reaction": True}}
EQUILIBRIUM: dict[str, Any] = {
    "effects": {"gravity": {"g": [1.0, -9.0]}},
    "time": {"start": "equilibrium"},
}


def ritz(model: Model, k: int, k2: int, **about: Any) -> CertifiedModel:
    """Certified model of clamped modes, the same for every rank count."""
    return certified_model(model, lowest_modes(model.system, k2)[1], k=k, **about)


def full_at(model: Model, materials: Any) -> tuple[BlockSystem, Trajectory]:
    """The full run at other materials."""
    system = model.system.with_materials(materials)
    return system, simulate(replace(model, system=system))


def energy_norm(system: BlockSystem, z: Array, v: Array, v_s: Array | None = None) -> Array:
    """sqrt(z'Kz + v'Mv) of columns, with v_s that of the coupled mass."""
    comm = system.layout.comm
    square = (z * times_columns(system.K_ee, z) + v * times_columns(system.M_ee, v)).sum(axis=0)
    square = total(comm, square)
    if v_s is not None:
        square += 2 * ((total(comm, system.G.T @ v)) * v_s).sum(axis=0)
        square += (v_s * ((system.M_hand + system.M_rigid) @ v_s)).sum(axis=0)
    return np.sqrt(np.maximum(square, 0.0))


def error_to(
    system: BlockSystem, full: Trajectory, certified: CertifiedModel, run: CertifiedRun, coupled: bool = False
) -> tuple[Array, float]:
    """Energy norm of the error of a run at every step, and the largest of the solution."""
    n, x, reconstruction = system.layout.n_local, run.trajectory.x.T, certified.fine.reconstruction
    hand, k, k2 = 2 * system.layout.n_s, certified.k, certified.k2
    if certified.fine.structure == "second_order":
        Phi = reconstruction.L_q[:, hand : hand + k2][:, :k]
        z, v = Phi @ x[hand : hand + k], Phi @ x[hand + k :]
    else:
        z, v = reconstruction.L_q @ x, reconstruction.L_v @ x / certified.fine.at(system.materials).scale
    Z, V = full.snapshots.Z[:n], full.snapshots.Z[n:]
    pair = (full.v_s.T - run.trajectory.v_s.T, full.v_s.T) if coupled else (None, None)
    return energy_norm(system, Z - z, V - v, pair[0]), float(energy_norm(system, Z, V, pair[1]).max())


def dense(system: BlockSystem) -> tuple[Array, Array, Array]:
    """K_ee, M_ee and G of a serial system as arrays."""
    from softgrasp.fem.petsc import to_scipy

    return to_scipy(system.K_ee).toarray(), to_scipy(system.M_ee).toarray(), system.G


def mass_bound(system: BlockSystem, Phi: Array, a: Array, b: Array, c: Array, dt: float) -> Array:
    """The textbook bound dt sum |r|_{M^-1} of a run, by dense matrices; undamped or uniform Kelvin-Voigt."""
    K, M, G = dense(system)
    y = a + system.damping.beta * b
    r = M @ Phi @ np.diff(b) / dt + K @ Phi @ (y[:, 1:] + y[:, :-1]) / 2 + G @ c
    L = scipy.linalg.cholesky(M, lower=True)
    lengths = np.linalg.norm(scipy.linalg.solve_triangular(L, r, lower=True), axis=0)
    return np.concatenate([[0.0], dt * np.cumsum(lengths)])
