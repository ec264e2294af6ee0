"""Projection of a scene in the frame of the hand onto modes, replays and errors."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from softgrasp.fem.petsc import Array, normalising, times_columns, total
from softgrasp.reduction.bases.engines import EngineName
from softgrasp.reduction.bases.inner import InnerName
from softgrasp.reduction.bases.registry import find_method, make_basis
from softgrasp.reduction.bases.states import BasisError, States
from softgrasp.reduction.bases.truncation import Truncation
from softgrasp.reduction.galerkin import unit_coupling
from softgrasp.reduction.operators import Parts, Reconstruction, layer_products, symmetric
from softgrasp.reduction.origin import origin_of
from softgrasp.reduction.projection import project_outputs
from softgrasp.reduction.replay import FullRun, check_scenes
from softgrasp.reduction.strain.training import StrainErrors, reference_of
from softgrasp.reduction.system import ModelError
from softgrasp.reduction.turning.model import TurningModel, TurningRun

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model
    from softgrasp.fem.system import BlockSystem

TURNING_METHODS = ("craig_bampton", "psd_cotangent_lift_fixed_relative")
"""Bases with the same modes for displacements and velocities, apart from the hand, as a moving frame needs them."""
DEPENDENT = 1e-13  # least share of a direction of the basis in its Gram matrix [1]


def reduce_turning(
    model: Model,
    runs: Sequence[FullRun],
    method: str = "craig_bampton",
    N: int | Truncation | None = None,
    inner: InnerName | None = None,
    engine: EngineName = "tsqr",
) -> TurningModel:
    """A linear model of a scene in the frame of the hand, see :func:`softgrasp.reduction.reduce.reduce`. Collective.

    Raises:
        BasisError: the basis has other modes for velocities, or there is none of N columns.
    """
    find_method(method)
    if method not in TURNING_METHODS:
        raise BasisError(
            f"basis '{method}' has modes of its own for velocities or for the hand, which turn with effects.frame; "
            f"choose one of {', '.join(TURNING_METHODS)}"
        )
    system = model.system
    states = States(system, tuple((run.model.system, run.snapshots) for run in runs))
    begin = time.perf_counter()
    basis = make_basis(method, states, N, inner, engine)
    first = 2 * system.layout.n_s
    columns = [
        j
        for j in range(first, basis.N)
        if np.any(total(system.layout.comm, np.abs(basis.V_q[:, j]).sum(keepdims=True)))
    ]
    Phi = orthonormal(system, np.asfortranarray(basis.V_q[:, columns]))
    middle = time.perf_counter()
    parts = system.layout.comm.bcast(turning_parts(system, Phi))
    spent = [system.layout.comm.allreduce(x, MPI.MAX) for x in (middle - begin, time.perf_counter() - middle)]
    outputs = project_outputs(model.outputs, Reconstruction(system.layout, Phi, Phi))
    return TurningModel(
        method, parts, system.M_hand, system.materials, outputs, tuple(o.size for o in model.outputs),
        system.damping.alpha, system.damping.active, system.hand_weight, system.two_way, system.gravity, system.layout,
        Phi, model.scene_hash, origin_of(model.scene_keys), {"basis": spent[0], "projection": spent[1]},
    )  # fmt: skip


def orthonormal(system: BlockSystem, X: Array) -> Array:
    """Phi of the span of X with Phi' M Phi = I and Phi' K Phi diagonal and ascending. Collective."""
    comm = system.layout.comm
    for share in (DEPENDENT, 0.0):  # twice, for orthonormality to rounding
        X = np.asfortranarray(X @ normalising(total(comm, X.T @ times_columns(system.M_ee, X)), share))
    K = total(comm, X.T @ times_columns(system.K_ee, X))
    return np.asfortranarray(X @ comm.bcast(np.linalg.eigh((K + K.T) / 2)[1]))


def turning_parts(system: BlockSystem, Phi: Array) -> Parts:
    """All integrals of modes (n_local, k), at unit materials by layer. Collective."""
    comm, d, k = system.layout.comm, system.layout.dimension, Phi.shape[1]
    assert system.frame is not None
    G, rigid = unit_coupling(system)
    moments = system.frame.parts
    E = np.zeros((len(system.layers), d, d, k, k))
    nodes = Phi.reshape(-1, d, k)
    for i in range(d):
        for j in range(i, d):
            moved = np.zeros_like(nodes)
            moved[:, i] = nodes[:, j]  # the mass matrix of the nodes does not mix directions
            E[:, i, j] = layer_products(system, "M_1", np.asfortranarray(moved.reshape(-1, k)), Phi)[0]
            E[:, j, i] = np.swapaxes(E[:, i, j], 1, 2)
    K = {f"K_{key}": symmetric(layer_products(system, f"K_{key}", Phi, Phi)[0]) for key in ("mu", "lambda")}
    return K | {
        "G": np.stack([total(comm, Phi.T @ g) for g in G]), "rigid": np.stack(rigid),
        "S": np.stack([total(comm, Phi.T @ part) for part in moments]), "E": E,
    }  # fmt: skip


def replay_turning(rom: TurningModel, full: FullRun, model: Model | None = None) -> TurningRun:
    """Under the hand of a full run, at its step, see :func:`softgrasp.reduction.reduce.replay`. Collective."""
    check_scenes(rom.origin, rom.name, model or full.model, full)
    materials = (model or full.model).system.materials
    return rom.at(full.dt, materials).run(full.hand, start=full.model.scene.time.start)


def errors_turning(rom: TurningModel, run: TurningRun, full: FullRun) -> StrainErrors:
    """Errors of deformation, velocity and energy norm in the axes of the hand. Collective.

    Raises ModelError: the model has no basis on the mesh, or the run is too short.
    """
    if rom.Phi is None:
        raise ModelError("the model has no basis on the mesh; load it with the layout of its mesh")
    return reference_of(full, rom.Phi).errors(run.a, run.v)
