"""How far a reduced model is from the full one: states, deformation, energy, and the floor that its basis sets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from fem.petsc import Array, total
from fem.snapshots import Snapshots
from fem.system import BlockSystem
from reduction.model import ModelError, ReducedModel, SmallModel
from reduction.online import ReducedTrajectory

BLOCK = 64  # columns at a time: 64 columns of both states are a small part of the snapshots themselves
RANK_TOLERANCE = 1e-13  # of the largest singular value: directions below are rounding of the basis


@dataclass(frozen=True)
class ModelErrors:
    """Relative errors of a reduced run against snapshots of the full one, dimensionless.

    Attributes:
        error: |X - X_r|_F / |X|_F of X = [q_s, v_s, q_e, v_e] in absolute coordinates: the paper's error [SBRH21].
        error_deformation: the same of [z, v_z], after removing the rigid motion of the hand.
        error_energy: max_t |H_r - H| / max_t H of the tissue's energy relative to the hand.
        error_displacement: |Q - Q_r|_F / |Q|_F of Q = [q_s, q_e]. In X velocities weigh omega times more; the
            canonical state [q_s, q_e, p_s, p_e] is all but dominated by its displacements, since a nodal mass is small.
    """

    error: float
    error_deformation: float
    error_energy: float
    error_displacement: float


def full_energy(system: BlockSystem, snapshots: Snapshots) -> Array:
    """(z' K_ee z + v_z' M_ee v_z) / 2 of every snapshot [J], (m,), on every rank. Collective."""
    n, m = system.layout.n_local, snapshots.Z.shape[1]
    x, y = system.K_ee.createVecs()
    local = np.zeros(m)
    for rows, A in ((slice(0, n), system.K_ee), (slice(n, 2 * n), system.M_ee)):
        for j in range(m):
            x.array_w[:] = snapshots.Z[rows, j]
            A.mult(x, y)
            local[j] += np.dot(snapshots.Z[rows, j], y.array_r) / 2
    x.destroy()
    y.destroy()
    return total(system.layout.comm, local)


def trajectory_errors(
    model: ReducedModel,
    small: SmallModel,
    run: ReducedTrajectory,
    system: BlockSystem,
    snapshots: Snapshots,
    energy: Array | None = None,
) -> ModelErrors:
    """Compare a reduced run with snapshots of the full one, some columns at a time. Collective.

    Args:
        model: gives the lift.
        small: the parameter that ran.
        run: its trajectory, on the full model's time grid.
        system: gives T.
        snapshots: of the full model, at the same parameter.
        energy: :func:`full_energy` of the snapshots, when it is known.

    Raises:
        ModelError: the run is shorter than the snapshots, or the model holds no lift.
    """
    steps = snapshots.steps
    if len(run.x) <= int(steps.max(initial=0)):
        raise ModelError(f"the reduced run has {len(run.x) - 1} steps, the snapshots reach step {int(steps.max())}")
    energy = full_energy(system, snapshots) if energy is None else energy
    x, q_s, v_s = run.x[steps].T, run.q_s[steps].T, run.v_s[steps].T
    # rows: displacement, velocity; columns: relative error, relative norm, absolute error, absolute norm
    sums = np.zeros((2, 4))
    for b in column_blocks(len(steps)):
        states = model.reconstruct(small, x[:, b], v_s[:, b])
        hands = ((q_s[:, b], snapshots.q_s[:, b]), (v_s[:, b], snapshots.v_s[:, b]))
        for i, (own, (hand, exact)) in enumerate(zip(states, hands, strict=True)):
            relative = snapshots.Z[i * len(own) : (i + 1) * len(own), b]
            own -= relative
            sums[i, :2] += squares(own), squares(relative)
            own += system.T @ (hand - exact)
            sums[i, 2:] += squares(own), squares(relative + system.T @ exact)
    sums = total(system.layout.comm, sums)
    for i, (hand, exact) in enumerate(((q_s, snapshots.q_s), (v_s, snapshots.v_s))):
        sums[i, 2:] += squares(hand - exact), squares(exact)
    peak = float(energy.max(initial=0.0))
    both = sums.sum(axis=0)
    return ModelErrors(
        error=ratio(both[2], both[3]),
        error_deformation=ratio(both[0], both[1]),
        error_energy=float(np.abs(small.energy(x.T) - energy).max(initial=0.0)) / (peak if peak > 0 else 1.0),
        error_displacement=ratio(sums[0, 2], sums[0, 3]),
    )


def lifted_columns(model: ReducedModel, small: SmallModel, system: BlockSystem) -> tuple[Array, Array]:
    """Span of everything the model can show: rows of [q_s, v_s] on every rank, local rows of [q_e, v_e].

    Not collective.

    Raises:
        ModelError: the model holds no lift.
    """
    S_q, S_v = small.operators.S_q, small.operators.S_v
    z, v_z = model.reconstruct(small, np.eye(model.N))
    return np.vstack([S_q, S_v]), np.vstack([z + system.T @ S_q, v_z + system.T @ S_v])


def projection_error(model: ReducedModel, small: SmallModel, system: BlockSystem, snapshots: Snapshots) -> float:
    """min_Y |X - V Y|_F / |X|_F over all states V y that the model can show: the floor of its error. Collective.

    X = [q_s, v_s, q_e, v_e]. Momenta of a canonical basis count as the velocities they stand for.

    Raises:
        ModelError: the model holds no lift.
    """
    comm, T = system.layout.comm, system.T
    root = 1.0 if comm.rank == 0 else 0.0  # the hand's rows count once
    V = orthonormal(comm, lifted_columns(model, small, system))
    sums = np.zeros(2)
    for b in column_blocks(snapshots.Z.shape[1]):
        n = system.layout.n_local
        q_s, v_s = snapshots.q_s[:, b], snapshots.v_s[:, b]
        X = np.vstack([root * q_s, root * v_s, snapshots.Z[:n, b] + T @ q_s, snapshots.Z[n:, b] + T @ v_s])
        norm = squares(X)
        for _ in range(2):  # the second pass removes what rounding left of the first
            X -= V @ total(comm, V.T @ X)
        sums += squares(X), norm
    sums = total(comm, sums)
    return ratio(sums[0], sums[1])


def orthonormal(comm: MPI.Intracomm, columns: tuple[Array, Array]) -> Array:
    """Orthonormal basis of distributed columns; the hand's rows are kept on rank 0 only. Collective.

    Triangular factors travel, not Gram matrices: nearly dependent columns keep all their digits.
    """
    hand, tissue = columns
    V = np.vstack([hand if comm.rank == 0 else np.zeros_like(hand), tissue])
    norms = np.sqrt(total(comm, (V**2).sum(axis=0)))
    V /= np.where(norms > 0, norms, 1.0)
    for _ in range(2):
        factors = comm.gather(np.linalg.qr(V, mode="r"))
        change = None
        if factors is not None:
            _, s, V_t = np.linalg.svd(np.linalg.qr(np.vstack(factors), mode="r"))
            keep = s > RANK_TOLERANCE * s.max(initial=0.0)
            change = V_t[keep].T / s[keep]
        V = V @ comm.bcast(change)
    return np.asarray(V)


def column_blocks(m: int) -> Iterator[slice]:
    """Slices of at most :data:`BLOCK` columns."""
    for first in range(0, m, BLOCK):
        yield slice(first, min(first + BLOCK, m))


def squares(X: Array) -> float:
    """Sum of all entries squared."""
    return float(np.vdot(X, X))


def ratio(part: float, whole: float) -> float:
    """sqrt(part / whole); of the part alone when the whole is zero."""
    return float(np.sqrt(part / whole if whole > 0 else part))
