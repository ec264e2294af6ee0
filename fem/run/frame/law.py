"""The linear law as a body of the finite-strain step, and the fixed point that solves its step in a turning frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from softgrasp.fem.petsc import Array, PETSc
from softgrasp.fem.strain.newton import Pairs, Root

MOST = 40  # largest number of corrections [1]
SLOW = 0.7  # reduction of |R| by two corrections above which the iteration has stalled [1]


class LinearBody:
    """Force K z, energy z'K z / 2; calls are those of :class:`softgrasp.fem.strain.body.HyperelasticBody`.

    Args:
        stiffness: -2 K on the rows here.
        dot: scalar product over all rows.

    Attributes:
        rounding: norm of the force that rounding in K z leaves, about eps |diag(K) z| [N].
    """

    law = SimpleNamespace(name="linear", barrier=True)
    points = SimpleNamespace(B=PETSc.Mat())
    kernel = None

    def __init__(self, stiffness: PETSc.Mat, dot: Callable[[Array, Array], float]) -> None:
        self.K2, self.dot, self.rounding = stiffness, dot, 0.0
        self.k, diagonal = stiffness.createVecLeft(), stiffness.getDiagonal()
        self.size: Array = diagonal.array_r / 2
        self.at: Array = np.zeros_like(self.size)
        self.J = np.ones(0)

    def start(self, z: PETSc.Vec) -> Any:
        """Keep K z of the start of a step. Collective."""
        self.K2.mult(z, self.k)
        self.at = self.k.array_r / -2
        large = self.size * z.array_r
        self.rounding = float(np.finfo(float).eps) * math.sqrt(self.dot(large, large))
        return SimpleNamespace(j=np.zeros(0))

    def step(self, start: Any, w: PETSc.Vec, f: PETSc.Vec) -> bool:
        """Force K (z + w) of a step of 2 w from the last start. Collective."""
        self.K2.mult(w, self.k)
        f.array_w[:] = self.at - self.k.array_r / 2
        return True

    def refuse(self, start: Any, comm: Any) -> None:
        """The law describes every state."""

    def force(self, z: PETSc.Vec, f: PETSc.Vec) -> None:
        """Force K z [N]. Collective."""
        self.K2.mult(z, f)
        f.scale(-0.5)

    def energy(self, z: PETSc.Vec) -> float:
        """This rank's share of z'K z / 2 [J]. Collective."""
        self.K2.mult(z, self.k)
        return float(np.dot(z.array_r, self.k.array_r)) / -4

    def destroy(self) -> None:
        """Free PETSc's objects. Collective."""
        self.k.destroy()


@dataclass(frozen=True)
class FixedPoint:
    """x <- x - S^-1 R(x) with the constant factor S of the step that does not turn.

    It contracts by about the turn of a step, h |Omega|, since S is at least s^2 M and what S lacks is 2 s M Omega x w.
    """

    residual: Callable[[Array], tuple[Array, float]]  # x -> R(x) and |R|
    solve: Callable[[Array], Array]  # q -> S^-1 q
    pairs: Pairs  # none are kept

    def find(self, x: Array, target: float) -> Root:
        """Iterate from x until |R| <= target; stop where it stalls. Collective."""
        R, norm = self.residual(x)
        past = [math.inf, math.inf]
        for count in range(MOST + 1):
            if norm <= target:
                return Root(x, R, norm, count)
            if not norm < SLOW * past[-2]:
                break
            past.append(norm)
            x = x - self.solve(R)
            R, norm = self.residual(x)
        return Root(x, R, norm, -1)
