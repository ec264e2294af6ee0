"""One tissue solve a shift: S(p) = p^2 M_ee - p D_ee + K_ee, complex symmetric, of the order n_e."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import psutil

from softgrasp.fem.errors import ResourceError, SolverError
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, Complex
from softgrasp.fem.system import BlockSystem
from softgrasp.lqr.lowrank.shifted_distributed import DistributedTissue
from softgrasp.lqr.lowrank.shifted_gathered import GatheredTissue
from softgrasp.lqr.plant.checks import MODAL_KEY

# Every rank factors whole matrices up to here, each rank another shift: no messages in the factorisation, and SuperLU
# in complex numbers is about as fast as MUMPS on the real form of twice the order in 2D, faster in 3D
# (softgrasp.study.bench.switches). Beyond, a whole factor on each rank costs too much memory.
GATHER_LIMIT = {1: 150_000, 2: 150_000, 3: 40_000}  # 1: systems without a mesh


class ShiftedTissue(Protocol):
    """Solves S(p) B = F for distributed F."""

    name: str  # gathered or distributed
    seconds: dict[str, float]  # time by stage, factor and solve [s]
    factors: int  # factorisations made by this rank's communicator

    def solve(self, p: complex, F: Array | Complex, ahead: Sequence[complex] = ()) -> Complex:
        """Local rows of S(p)^{-1} F, (n_local, k). Collective.

        Args:
            p: shift; 0 gives K_ee^{-1}.
            ahead: shifts that will probably come next.
        """

    def destroy(self) -> None:
        """Free the factors. Collective."""


def make_shifted(system: BlockSystem, name: str = "auto") -> ShiftedTissue:
    """The solver for a size: ``gathered`` or ``distributed``. Collective.

    Raises:
        SolverError: the name is unknown.
        ResourceError: the factor would not fit in the memory that is free now.
    """
    if name == "auto":
        small = system.layout.n_e <= GATHER_LIMIT[system.layout.dimension]
        name = "gathered" if small else "distributed"
    if name == "gathered":
        return GatheredTissue(system)
    if name == "distributed":
        check_memory(system.layout)
        return DistributedTissue(system)
    raise SolverError(f"the shifted solver {name!r} is unknown; choose auto, gathered or distributed")


def factor_bytes(n: int, dimension: int) -> float:
    """What MUMPS asks for to factor S(p) of order n, all ranks together: 240 n log2 n in 2D, 800 n^(4/3) in 3D.

    Fitted to n = 6 558 to 103 038 in 2D and n = 7 227 to 52 857 in 3D.
    """
    return 240 * n * float(np.log2(max(n, 2))) if dimension < 3 else 800 * n ** (4 / 3)


def check_memory(layout: BlockLayout) -> None:
    """The factor of S(p) fits in the memory that is free now. Collective. Raises ResourceError: it does not."""
    needed = factor_bytes(layout.n_e, layout.dimension) / 2**30
    free = float(layout.comm.bcast(psutil.virtual_memory().available)) / 2**30
    if needed > free:
        raise ResourceError(
            f"the factor of the shifted tissue matrix (n_e = {layout.n_e} in {layout.dimension}D) needs about "
            f"{needed:.1f} GiB and {free:.1f} GiB are free; take fewer cells, or set {MODAL_KEY}"
        )
