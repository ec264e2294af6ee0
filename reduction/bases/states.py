"""Snapshots as the row blocks that a basis is built from: hand and tissue, displacement and velocity or momentum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.errors import agree
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, times_columns, total
from softgrasp.fem.run.snapshots import Snapshots
from softgrasp.fem.system import BlockSystem
from softgrasp.reduction.bases.basis import Coordinates, Frame, ReductionError


class BasisError(ReductionError):
    """A basis cannot be built from what is given.

    Attributes:
        most: largest N there is, where more was asked for.
    """

    def __init__(self, reason: str, basis: str = "", most: int | None = None) -> None:
        super().__init__(reason, basis)
        self.most = most


@dataclass(frozen=True)
class Blocks:
    """Snapshot columns in the rows of :class:`softgrasp.reduction.bases.basis.Basis`."""

    s_q: Array  # hand displacement, (n_s, m), on every rank [m, rad]
    s_p: Array  # hand velocity, or momentum in canonical coordinates, (n_s, m), on every rank
    e_q: Array  # tissue displacement, local rows (n_local, m) [m]
    e_p: Array  # tissue velocity [m/s] or momentum [kg m/s], local rows (n_local, m)


@dataclass(frozen=True)
class States:
    """Everything a basis may be built from: the system, and the snapshots of one or more runs.

    Each run comes with the system that it was made with, because momenta need its mass. Craig-Bampton bases use the
    system alone, so ``runs`` may be empty.
    """

    system: BlockSystem  # operators that the inner products use
    runs: tuple[tuple[BlockSystem, Snapshots], ...] = ()  # pairs of system and snapshots, all on one layout

    @property
    def layout(self) -> BlockLayout:
        """Sizes and ownership."""
        return self.system.layout

    @property
    def columns(self) -> int:
        """Number of snapshots over all runs."""
        return sum(snapshots.Z.shape[1] for _, snapshots in self.runs)

    def blocks(self, coordinates: Coordinates, frame: Frame) -> Blocks:
        """Copy the snapshots into row blocks. Collective.

        With z = q_e - T q_s:

            absolute:  q_e = z + T q_s;  v_e = v_z + T v_s;  p_e = M_es v_s + M_ee v_e = M_ee v_z + G v_s
            relative:  z;  v_z;  p_z = M_ee v_z
            hand:      q_s;  v_s;  p_s = M_hand v_s, two-way absolute also + M_ss v_s + M_se v_e of the tissue

        p_z drops G v_s, which the hand's motion prescribes: it is canonical for the tissue with the hand as its input.

        Args:
            coordinates: "qv" gives velocities, "qp" momenta.
            frame: "absolute" or "relative" to the rigid motion of the hand.

        Raises:
            BasisError: there are no snapshots, or one of them is not finite.
        """
        if self.columns == 0:
            raise BasisError("there are no snapshots; run with output.snapshots = 'memory', or use craig_bampton")
        with agree(self.layout.comm):
            for system, snapshots in self.runs:
                _check(self.layout, system, snapshots)
        parts = [_blocks(system, snapshots, coordinates, frame) for system, snapshots in self.runs]
        if len(parts) == 1:
            return parts[0]
        return Blocks(
            np.hstack([b.s_q for b in parts]),
            np.hstack([b.s_p for b in parts]),
            _beside([b.e_q for b in parts]),
            _beside([b.e_p for b in parts]),
        )


def states_of(system: BlockSystem, snapshots: Snapshots | None = None) -> States:
    """States of one run, or of none."""
    return States(system, () if snapshots is None else ((system, snapshots),))


def _beside(parts: list[Array]) -> Array:
    """Columns side by side in Fortran order, which stays contiguous for PETSc."""
    result = np.empty((parts[0].shape[0], sum(p.shape[1] for p in parts)), order="F")
    np.concatenate(parts, axis=1, out=result)
    return result


def _check(layout: BlockLayout, system: BlockSystem, snapshots: Snapshots) -> None:
    if system.layout is not layout and (system.layout.n_e, system.layout.n_local) != (layout.n_e, layout.n_local):
        raise BasisError(
            f"a run has n_e = {system.layout.n_e} and the system has {layout.n_e}; "
            "all snapshots must come from one mesh and one contact zone"
        )
    rows, m = snapshots.Z.shape
    if rows != 2 * layout.n_local or snapshots.q_s.shape != (layout.n_s, m) or snapshots.v_s.shape != (layout.n_s, m):
        raise BasisError(
            f"snapshots have the shapes {snapshots.Z.shape}, {snapshots.q_s.shape}, {snapshots.v_s.shape}; "
            f"they must be (2 n_local, m), (n_s, m), (n_s, m) with n_local = {layout.n_local} and n_s = {layout.n_s}"
        )
    for X in (snapshots.Z, snapshots.q_s, snapshots.v_s):
        # a sum is infinite or NaN if an entry is; it also overflows early, hence the second look
        if not np.isfinite(X.sum()) and not np.isfinite(X).all():
            j = int(np.flatnonzero(~np.isfinite(X).all(axis=0))[0])
            raise BasisError(
                f"snapshot {j} (step {int(snapshots.steps[j])}) holds NaN or infinity; "
                "a basis needs finite snapshots: check the run that made them"
            )


def _blocks(system: BlockSystem, snapshots: Snapshots, coordinates: Coordinates, frame: Frame) -> Blocks:
    n = system.layout.n_local
    q_s, v_s, z, v_z = snapshots.q_s, snapshots.v_s, snapshots.Z[:n], snapshots.Z[n:]
    absolute = frame == "absolute"
    e_q = np.asfortranarray(z + system.T @ q_s if absolute else z)
    if coordinates == "qv":
        return Blocks(q_s, v_s, e_q, np.asfortranarray(v_z + system.T @ v_s if absolute else v_z))
    e_p = times_columns(system.M_ee, v_z)
    if absolute:
        e_p += system.G @ v_s
    s_p = system.M_hand @ v_s
    if system.two_way and absolute:
        # dT/dv_s at fixed v_e = dT/dv_s at fixed v_z - T' dT/dv_z
        s_p = s_p + system.M_rigid @ v_s + total(system.layout.comm, system.G.T @ v_z - system.T.T @ e_p)
    return Blocks(q_s, s_p, e_q, e_p)
