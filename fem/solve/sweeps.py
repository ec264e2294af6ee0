"""The two sweeps of a factor in blocks of d x d by themselves.

With S = U'D U, U with ones on its diagonal [GL81],

    y = F r = D^-1 U^-T r,   w = B y = U^-1 y,   so that   n'w = (F n)'D y   for any row n.

F n of a row n on one node is zero but on the ancestors of the node in the elimination tree: on 435 of 13 534 unknowns
for a node of the lower edge of `set_down`, on 773 of 4563 for one of the lower face of `set_down_3d`. So values of a
few rows n'w are known after the first sweep, and forces n x may enter y.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array, PETSc
from softgrasp.fem.solve.entries import stored
from softgrasp.fem.solve.solvers import TissueSolver

SAME = 1e-8  # relative difference of r'S^-1 r and y'D y that is no rounding [1]


@dataclass(frozen=True)
class Sweeps:
    """The sweeps of a factor that one rank stores whole."""

    factor: PETSc.Mat  # stays with its solver
    D: Array  # blocks on the diagonal of D, (nodes, d, d)

    def forward(self, r: PETSc.Vec, y: PETSc.Vec) -> None:
        """The first, y = F r."""
        self.factor.solveForward(r, y)

    def backward(self, y: PETSc.Vec, w: PETSc.Vec) -> None:
        """The second, w = B y."""
        self.factor.solveBackward(y, w)


def sweeps_of(solver: TissueSolver, d: int) -> Sweeps | None:
    """The sweeps of a solver for d rows a node; None where it stores no factor in blocks on this rank alone."""
    factor = solver.factor
    if not isinstance(factor, PETSc.Mat) or factor.getType() != "seqsbaij" or factor.getBlockSize() != d:
        return None
    inverse = stored(factor, factor.getSize()[0] // d)
    if inverse is None:
        return None
    sweeps = Sweeps(factor, np.linalg.inv(inverse))
    return sweeps if _true(sweeps) else None


def _true(sweeps: Sweeps) -> bool:
    """Whether r'S^-1 r = y'D y for a generic r, which shows that D is that of the factor."""
    r, y = sweeps.factor.createVecs()
    w = r.duplicate()
    r.array_w[:] = np.cos(1.3 * np.arange(len(r.array_r))) + 0.5
    sweeps.forward(r, y)
    sweeps.backward(y, w)
    direct = float(np.dot(r.array_r, w.array_r))
    blocks = y.array_r.reshape(len(sweeps.D), -1)
    through = float(np.einsum("ka,kab,kb", blocks, sweeps.D, blocks))
    for x in (r, y, w):
        x.destroy()
    return abs(direct - through) <= SAME * abs(direct)  # not so where one is no number
