"""Errors of canonical models in their own state: X = [q_s, p_s, q_e, p_e], p_e = M_ee v_z + G v_s, p_s = M_hand v_s."""

from __future__ import annotations

import numpy as np

from fem.petsc import times_columns, total
from fem.snapshots import Snapshots
from fem.system import BlockSystem
from reduction.errors import column_blocks, orthonormal, ratio, squares
from reduction.model import ReducedModel, SmallModel
from reduction.online import ReducedTrajectory


def canonical_error(
    model: ReducedModel, small: SmallModel, found: ReducedTrajectory, system: BlockSystem, snapshots: Snapshots
) -> float:
    """|X - X_r|_F / |X|_F of X = [q_s, p_s, q_e, p_e], p_e = M_ee v_z + G v_s, p_s = M_hand v_s. Collective."""
    n, steps = system.layout.n_local, snapshots.steps
    sums = np.zeros((2, 2))
    for b in column_blocks(len(steps)):
        q_s, v_s = found.q_s[steps[b]].T, found.v_s[steps[b]].T
        z, v_z = model.reconstruct(small, found.x[steps[b]].T, v_s)
        dq, dv = q_s - snapshots.q_s[:, b], v_s - snapshots.v_s[:, b]
        Z, V = snapshots.Z[:n, b], snapshots.Z[n:, b]
        exact = times_columns(system.M_ee, V) + system.G @ snapshots.v_s[:, b]
        off = times_columns(system.M_ee, v_z - V) + system.G @ dv
        sums[0] += (
            squares(z - Z + system.T @ dq) + squares(off),
            squares(Z + system.T @ snapshots.q_s[:, b]) + squares(exact),
        )
        hand = squares(snapshots.q_s[:, b]) + squares(system.M_hand @ snapshots.v_s[:, b])
        sums[1] += squares(dq) + squares(system.M_hand @ dv), hand
    whole = total(system.layout.comm, sums[0]) + sums[1]
    return ratio(whole[0], whole[1])


def canonical_floor(model: ReducedModel, small: SmallModel, system: BlockSystem, snapshots: Snapshots) -> float:
    """min_Y |X - V Y|_F / |X|_F over all states V y that the model can show: the floor of its error. Collective."""
    comm, n, T = system.layout.comm, system.layout.n_local, system.T
    S_q, S_v = small.operators.S_q, small.operators.S_v
    z, v_z = model.reconstruct(small, np.eye(model.N))
    momenta = times_columns(system.M_ee, v_z) + system.G @ S_v
    V = orthonormal(comm, (np.vstack([S_q, system.M_hand @ S_v]), np.vstack([z + T @ S_q, momenta])))
    root = 1.0 if comm.rank == 0 else 0.0  # the hand's rows count once
    sums = np.zeros(2)
    for b in column_blocks(snapshots.Z.shape[1]):
        q_s, v_s = snapshots.q_s[:, b], snapshots.v_s[:, b]
        p_e = times_columns(system.M_ee, snapshots.Z[n:, b]) + system.G @ v_s
        X = np.vstack([root * q_s, root * (system.M_hand @ v_s), snapshots.Z[:n, b] + T @ q_s, p_e])
        norm = squares(X)
        for _ in range(2):  # the second pass removes what rounding left of the first
            X -= V @ total(comm, V.T @ X)
        sums += squares(X), norm
    sums = total(comm, sums)
    return ratio(sums[0], sums[1])
