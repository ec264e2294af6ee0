"""The displacement of a run as a sum of two words, z + low, whose second is what rounding of the first has lost.

    y = 2 w + low_n,   z_{n+1} = z_n + y as rounded,   low_{n+1} = y - (z_{n+1} - z_n),

the last without an error [Knuth97]. In a step small against z the rounding of z + 2 w has one direction for many steps,
and the energy would go with it. Elastic forces and energies are those of both words, outputs and contact use the first.
"""

from __future__ import annotations

import ctypes

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.compiled import address, packed
from softgrasp.fem.petsc import Array
from softgrasp.fem.solve.differences import product_code


def exact_sum(a: Array, b: Array) -> tuple[Array, Array]:
    """The sum a + b as rounded, and what rounding loses of it [Knuth97]."""
    rounded = a + b
    share = rounded - a
    return rounded, (a - (rounded - share)) + (b - share)


class Displacement:
    """Moves the states of a run.

    Args:
        w: half the change of z in a step, on the rows here, (n,) [m].
        low: what z lacks, on the rows here, (n,) [m].
        s: 2 / dt.
        z: z where all rows are here, (n,); None: that of the state has the same rows.
        nodes: places of the owned nodes among all, beside z.
        d: rows of a node.
    """

    def __init__(self, w: Array, low: Array, s: float, z: Array | None, nodes: NDArray[np.int64], d: int) -> None:
        self.w, self.low, self.s, self.z, self.nodes, self.d = w, low, s, z, nodes, d
        self.code = product_code()
        self._fixed = packed(d, len(w), len(nodes), None if z is None else nodes, z, w, low)
        self._speed = ctypes.c_double(s)
        # addresses are looked up once, as in `Differences`
        self._old = self._new = np.zeros(0)
        self._from = self._to = address(self._old)

    def move(self, old: Array, new: Array) -> None:
        """Write [z_{n+1}; v_{n+1}] of the owned rows, v_{n+1} = 2 s w - v_n, into ``new``, which may be ``old``."""
        if self.code is None:
            self._move(old, new)
            return
        if old is not self._old:
            self._old, self._from = old, address(old)
        if new is not self._new:
            self._new, self._to = new, address(new)
        self.code.softgrasp_move(self._fixed, self._speed, self._from, self._to)

    def _move(self, old: Array, new: Array) -> None:
        """The same without compiled code."""
        n, z = len(old) // 2, old[: len(old) // 2] if self.z is None else self.z
        moved, self.low[:] = exact_sum(z, 2 * self.w + self.low)
        w = self.w
        if self.z is not None:
            self.z[:] = moved
            moved, w = (x.reshape(-1, self.d)[self.nodes].ravel() for x in (moved, w))
        new[n:] = 2 * self.s * w - old[n:]
        new[:n] = moved
