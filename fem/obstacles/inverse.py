"""W^-1 of a contact problem with friction, for those problems that share W."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpocon, dpotrf, dpotri

Array = NDArray[Any]
WORTH = 1.0  # unknowns of factors cubed, over those of W, from which on its inverse is worth its time
EPS = float(np.finfo(float).eps)
NONE = np.zeros((0, 0))


class Inverse:
    """W and W^-1, made when factors without it have cost as much; both in single precision too, when asked for.

    Args:
        axes: rows of a node; those of different axes are inverted one after the other where W has zeros between them.

    Attributes:
        W: rows of it, perhaps with room for more.
        k: number of rows in use.
        spent: unknowns of the factors so far, cubed; -1 where W has no inverse.
        made: W^-1, (k, k); empty before.
        error: of W W^-1 b over the largest number of b, by the condition of W: some twenty times what it is.
    """

    def __init__(self, axes: int = 1) -> None:
        self.W, self.k, self.axes = NONE, 0, axes
        self.forget()

    def forget(self) -> None:
        """Drop all, as W is another one now."""
        self.spent, self.made, self.low, self.made_low, self.error = 0.0, NONE, NONE, NONE, np.inf

    def of(self, W: Array, k: int) -> None:
        """Be that of the first k rows of W."""
        if W is not self.W or k != self.k:
            self.W, self.k = W, k
            self.forget()
        if self.spent > WORTH * k**3:
            self.make()

    def make(self) -> None:
        """Make W^-1; not where W is singular."""
        if len(self.made):
            return
        W, s = self.W[: self.k, : self.k], self.axes
        alone = s > 1 and not any(W[a::s, b::s].any() for b in range(s) for a in range(b))
        most, well, made = np.abs(W).sum(axis=0).max(), 1.0, np.zeros_like(W)
        for rows in [slice(a, None, s) for a in range(s)] if alone else [slice(None)]:
            factor, info = dpotrf(W[rows, rows], lower=1, clean=0)
            well = min(well, dpocon(factor, most, uplo="L")[0]) if info == 0 else 0.0
            inverse, more = dpotri(factor, lower=1, overwrite_c=1) if info == 0 else (factor, info)
            if more:
                self.refuse()
                return
            made[rows, rows] = np.tril(inverse) + np.tril(inverse, -1).T
        self.made, self.error = made, EPS / well if well > 0 else np.inf

    def refuse(self) -> None:
        """Do without W^-1 from now on."""
        self.forget()
        self.spent = -1.0

    def add(self, size: int) -> None:
        """Count a factor of as many unknowns."""
        if self.spent >= 0 and not len(self.made):
            self.spent += float(size) ** 3

    def single(self, inverse: bool) -> Array:
        """W or its inverse in single precision, (k, k)."""
        if inverse:
            if len(self.made) and not len(self.made_low):
                self.made_low = self.made.astype(np.float32)
            return self.made_low
        if not len(self.low):
            self.low = np.ascontiguousarray(self.W[: self.k, : self.k], np.float32)
        return self.low
