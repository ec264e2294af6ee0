"""A reduced basis as blocks: the rows of the hand on every rank, the rows of the tissue distributed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array

Coordinates = Literal["qv", "qp"]
Frame = Literal["absolute", "relative"]
Structure = Literal["none", "symplectic", "second_order"]


class ReductionError(SoftgraspError):
    """A basis or a reduced model cannot be made.

    Attributes:
        reason: the message without the name of the basis.
    """

    def __init__(self, reason: str, basis: str = "") -> None:
        super().__init__(f"{basis}: {reason}" if basis else reason)
        self.reason = reason


@dataclass(frozen=True)
class Basis:
    """V of shape (2n, N) in the row blocks [hand q; hand v or p; tissue q; tissue v or p].

    ``coordinates`` states whether the second half of each pair is a velocity (the paper's Galerkin models) or a
    momentum (canonical, symplectic models): p_e = M_es v_s + M_ee v_e, or p_z = M_ee v_z in the relative frame, and
    p_s = M_hand v_s of the hand when its rows are included. ``frame`` states whether the tissue rows are absolute or
    relative to the rigid motion of the hand, q_e = z + T q_s. With ``structure = "symplectic"`` the whole V is
    symplectic, V' J V = J; with ``fixed_solid`` its tissue columns are, by themselves.
    """

    name: str  # key in the registry
    layout: BlockLayout  # sizes and ownership
    V_sq: Array  # displacement of the hand, (n_s, N), the same on every rank
    V_sv: Array  # velocity or momentum of the hand, (n_s, N), the same on every rank
    V_q: Array  # displacement of the tissue, local rows (n_local, N)
    V_p: Array  # velocity or momentum of the tissue, local rows (n_local, N)
    coordinates: Coordinates = "qv"  # "qv" with velocities, "qp" with momenta
    frame: Frame = "absolute"  # frame of the tissue rows: absolute, or relative to the rigid motion of the hand
    structure: Structure = "none"  # structure that V or its tissue columns keep
    fixed_solid: bool = False  # the first 2 n_s columns are the hand's own unit vectors
    # inner product it was built in, see `reduction/bases/inner.py`
    inner: Literal["euclidean", "mass", "energy"] = "euclidean"
    # weight c between displacement and momentum there; 1 unless the coordinates are canonical and weighted
    rate: float = 1.0
    pairs: bool = False  # columns come as (first half; second half) with one complex structure on (q, p) or (q, v)
    # singular values the truncation was chosen from, descending (empty when no snapshots were used)
    sigma: tuple[Array, ...] = ()
    # columns of every part of the decomposition; two for componentwise POD, displacement and velocity
    split: tuple[int, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)  # time to build it, by stage

    @property
    def N(self) -> int:
        """Number of basis vectors, the hand's own included: the dimension of the first-order reduced model."""
        return int(self.V_q.shape[1])
