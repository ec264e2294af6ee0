"""Snapshots as the row blocks that a basis is built from: hand and tissue, displacement and velocity or momentum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from softgrasp.fem.errors import raise_on_all_ranks
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, times_columns, total
from softgrasp.fem.run.states.snapshots import Snapshots
from softgrasp.fem.system import BlockSystem
from softgrasp.reduction.bases.basis import Coordinates, Frame, ReductionError


class BasisError(ReductionError):
    """A basis cannot be built from what is given.

    Attributes:
        most: largest N there is, where more was requested.
    """

    def __init__(self, reason: str, basis: str = "", most: int | None = None) -> None:
        super().__init__(reason, basis)
        self.most = most


@dataclass(frozen=True)
class Columns:
    """Snapshots or basis vectors in the row blocks of :class:`softgrasp.reduction.bases.basis.Basis`."""

    s_q: Array  # hand displacement, (n_s, m), on every rank [m, rad]
    s_p: Array  # hand velocity, or momentum in canonical coordinates, (n_s, m), on every rank
    e_q: Array  # tissue displacement, local rows (n_local, m) [m]
    e_p: Array  # tissue velocity [m/s] or momentum [kg m/s], local rows (n_local, m)
    # factors of these rows by name, which several bases use (softgrasp.reduction.bases.stack)
    kept: dict[object, Any] = field(default_factory=dict, repr=False, compare=False)

    def first(self, k: int) -> Columns:
        """The leading k columns."""
        return Columns(self.s_q[:, :k], self.s_p[:, :k], self.e_q[:, :k], self.e_p[:, :k])

    @staticmethod
    def beside(parts: Sequence[Columns]) -> Columns:
        """All columns side by side, in Fortran order, which stays contiguous for PETSc."""
        joined = []
        for key in ("s_q", "s_p", "e_q", "e_p"):
            blocks = [getattr(part, key) for part in parts]
            whole = np.empty((len(blocks[0]), sum(block.shape[1] for block in blocks)), order="F")
            joined.append(np.concatenate(blocks, axis=1, out=whole))
        s_q, s_p, e_q, e_p = joined
        return Columns(s_q, s_p, e_q, e_p)


@dataclass(frozen=True)
class States:
    """Everything a basis may be built from: the system, and the snapshots of one or more runs.

    Each run comes with the system that it was made with, because momenta need its mass. Craig-Bampton bases use the
    system alone, so ``runs`` may be empty.
    """

    system: BlockSystem  # operators that the inner products use
    runs: tuple[tuple[BlockSystem, Snapshots], ...] = ()  # pairs of system and snapshots, all on one layout
    condensing: float = 0.0  # processor time in which the columns of the runs became few [s]
    # the last row blocks with their coordinates and frame, for the next basis
    kept: dict[tuple[Coordinates, Frame], Columns] = field(default_factory=dict, repr=False, compare=False)

    @property
    def layout(self) -> BlockLayout:
        """Sizes and ownership."""
        return self.system.layout

    def check(self) -> None:
        """Check the runs. Collective.

        Raises BasisError: there are no snapshots, they do not fit, or one of them is not finite.
        """
        if not any(snapshots.Z.shape[1] for _, snapshots in self.runs):
            raise BasisError("there are no snapshots; run with output.snapshots = 'memory', or use craig_bampton")
        with raise_on_all_ranks(self.layout.comm):
            for system, snapshots in self.runs:
                _check(self.layout, system, snapshots)

    def columns(self, coordinates: Coordinates, frame: Frame) -> Columns:
        """Copy the snapshots into row blocks; the last ones stay for bases of the same coordinates. Collective.

        With z = q_e - T q_s:

            absolute:  q_e = z + T q_s;  v_e = v_z + T v_s;  p_e = M_es v_s + M_ee v_e = M_ee v_z + G v_s
            relative:  z;  v_z;  p_z = M_ee v_z
            hand:      q_s;  v_s;  p_s = M_hand v_s, two-way absolute also + M_ss v_s + M_se v_e of the tissue

        p_z drops G v_s, which the hand's motion prescribes: it is canonical for the tissue with the hand as its input.

        Raises:
            BasisError: there are no snapshots, or one of them is not finite.
        """
        if known := self.kept.get((coordinates, frame)):
            return known
        self.check()
        parts = [_columns(system, snapshots, coordinates, frame) for system, snapshots in self.runs]
        self.kept.clear()
        self.kept[coordinates, frame] = made = parts[0] if len(parts) == 1 else Columns.beside(parts)
        return made


def states_of(system: BlockSystem, snapshots: Snapshots | None = None) -> States:
    """States of one run, or of none."""
    return States(system, () if snapshots is None else ((system, snapshots),))


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
                f"snapshot {j} (step {int(snapshots.steps[j])}) contains NaN or infinity; "
                "a basis needs finite snapshots: check the run that made them"
            )


def _columns(system: BlockSystem, snapshots: Snapshots, coordinates: Coordinates, frame: Frame) -> Columns:
    n = system.layout.n_local
    q_s, v_s, z, v_z = snapshots.q_s, snapshots.v_s, snapshots.Z[:n], snapshots.Z[n:]
    absolute = frame == "absolute"
    e_q = np.asfortranarray(z + system.T @ q_s if absolute else z)
    if coordinates == "qv":
        return Columns(q_s, v_s, e_q, np.asfortranarray(v_z + system.T @ v_s if absolute else v_z))
    e_p = times_columns(system.M_ee, v_z)
    if absolute:
        e_p += system.G @ v_s
    s_p = system.M_hand @ v_s
    if system.two_way and absolute:
        # dT/dv_s at fixed v_e = dT/dv_s at fixed v_z - T' dT/dv_z
        s_p = s_p + system.M_rigid @ v_s + total(system.layout.comm, system.G.T @ v_z - system.T.T @ e_p)
    return Columns(q_s, s_p, e_q, e_p)
