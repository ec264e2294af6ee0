"""Snapshots in few columns, from one QR that all bases and errors share.

With the hand's rows [q_s; v_s], the tissue's [z; v_z], each of the four over its own norm,

    [z; v_z; q_s; v_s] = U S W',   [z; v_z; q_s; v_s] W = the few columns

for the singular values above rounding. Every row block that a basis is made of is linear in these four, so that it has
the same left singular vectors, symplectic pairs and singular values from the few columns as from all: W is orthonormal.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.fem.run.states.snapshots import Snapshots
from softgrasp.reduction.bases.engines import SNAPSHOT_ROUNDING, small_svd, triangle
from softgrasp.reduction.bases.states import States

ROUNDING = 0.01 * SNAPSHOT_ROUNDING  # of the largest singular value: what is left out is below the rounding of a run
GAIN = 0.9  # share of the columns above which all of them stay


@dataclass(frozen=True)
class Condensed:
    """Few columns and W: all snapshots are ``few`` W' to rounding."""

    few: Snapshots  # with the first of the steps and times, which columns do not have any more
    W: Array  # orthonormal columns (m, r), the same bits on every rank


def condensed(states: States) -> States:
    """The same states with few columns for each run, which its snapshots keep for other users. Collective.

    Raises BasisError: there are no snapshots, or they are not finite.
    """
    states.check()
    begin = time.thread_time()
    pairs = [(system, snapshots, condense(snapshots)) for system, snapshots in states.runs]
    runs = tuple((system, made.few if made else snapshots) for system, snapshots, made in pairs)
    return States(states.system, runs, time.thread_time() - begin)


def condense(snapshots: Snapshots) -> Condensed | None:
    """Few columns of finite snapshots, which keep them; None where they would not pay. Collective."""
    made: Condensed | None = None
    if Condensed in snapshots.kept:
        made = snapshots.kept[Condensed]
        return made
    comm, n, m = snapshots.layout.comm, snapshots.layout.n_local, snapshots.Z.shape[1]
    q_s, v_s = snapshots.q_s, snapshots.v_s
    blocks = [triangle(comm, snapshots.Z[:n]), triangle(comm, snapshots.Z[n:]), q_s, v_s]
    blocks = [block / np.abs(block).max() for block in blocks if np.any(block)]
    if blocks:
        R = np.vstack([block / np.linalg.norm(block) for block in blocks])
        _, s, W_h = small_svd(comm, np.linalg.qr(R, mode="r"))
        r = int(np.count_nonzero(s > ROUNDING * s[0]))
        if r <= GAIN * m:
            W, Z = np.ascontiguousarray(W_h[:r].T), (W_h[:r] @ snapshots.Z.T).T
            few = Snapshots(snapshots.layout, snapshots.steps[:r], snapshots.times[:r], q_s @ W, v_s @ W, Z)
            made = Condensed(few, W)
    snapshots.kept[Condensed] = made
    return made
