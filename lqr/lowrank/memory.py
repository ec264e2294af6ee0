"""Memory of solves with S(p), estimated before its matrices are copied or factored."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from softgrasp.fem.errors import ResourceError
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.resources import free_memory
from softgrasp.fem.solve.costs import ENTRIES
from softgrasp.lqr.plant.checks import MODAL_KEY

# Of whole K, M and S(p) in a rank's memory, an entry of K: 50 to 55 in 2D, 47 to 51 in 3D on two ranks.
COPY_BYTES = 52.0
LU_BYTES = 20.0  # of an entry of a complex factor: 16 and an index
# Whole factors at a time in a rank's memory over one: measured 2.1, 2.4 and 2.0 on two ranks with 1e5 and 1.5e4
# unknowns in 2D and 1e4 in 3D; on one rank whose threads make the next factors 5.1 with 1e5 in 2D, and in 3D 4.7 with
# 2.1e4, and 7.7 with 1e4, where it is small.
HELD = 2.4
HELD_AHEAD = {2: 5.1, 3: 5.0}


def gathered_bytes(n: int, dimension: int, order: int, ahead: bool) -> float:
    """Memory of whole K, M, S(p) and its factors on each rank [byte], of order n.

    A factor has 2 (7.75 log2 n - 44) n entries in 2D and 2 (19.5 n^(1/3) - 85) n in 3D, which is 1.06 to 1.2 times what
    was counted.

    Args:
        ahead: threads make the next factors.
    """
    d = 2 if dimension < 3 else 3
    row = 7.75 * np.log2(max(n, 2)) - 44 if d == 2 else 19.5 * n ** (1 / 3) - 85
    factor = LU_BYTES * 2 * n * float(np.clip(row, 1, (n + 1) / 2))
    copies = COPY_BYTES * ENTRIES[d, min(order, 4)] * n
    return copies + (HELD_AHEAD[d] if ahead else HELD) * factor


def shifted_factor_bytes(n: int, dimension: int) -> float:
    """Memory of MUMPS to factor S(p) of order n, all ranks together: 240 n log2 n in 2D, 800 n^(4/3) in 3D.

    Fitted to n = 6 558 to 103 038 in 2D and n = 7 227 to 52 857 in 3D.
    """
    return 240 * n * float(np.log2(max(n, 2))) if dimension < 3 else 800 * n ** (4 / 3)


def check_gathered_memory(layout: BlockLayout, ahead: bool) -> None:
    """Whole matrices and factors of all ranks of a node fit in what is free there now. Collective.

    Raises ResourceError: they do not, on some node.
    """
    node = layout.comm.Split_type(MPI.COMM_TYPE_SHARED)
    ranks, free = node.size, float(node.bcast(free_memory()))
    node.Free()
    needed = ranks * gathered_bytes(layout.n_e, layout.dimension, layout.order, ahead)
    _, needed, free, ranks = max(layout.comm.allgather((needed / max(free, 1.0), needed, free, ranks)))
    _require(layout, needed, free, f", with all rows on each of {ranks} ranks of a node," if ranks > 1 else "")


def check_shifted_memory(layout: BlockLayout) -> None:
    """The factor of S(p) fits in the memory that is free now. Collective. Raises ResourceError: it does not."""
    _require(layout, shifted_factor_bytes(layout.n_e, layout.dimension), layout.comm.bcast(free_memory()), "")


def _require(layout: BlockLayout, needed: float, free: float, where: str) -> None:
    if needed > free:
        raise ResourceError(
            f"the factor of the shifted tissue matrix (n_e = {layout.n_e} in {layout.dimension}D){where} needs about "
            f"{needed / 2**30:.1f} GiB and {free / 2**30:.1f} GiB are free; use fewer cells, or set {MODAL_KEY}"
        )
