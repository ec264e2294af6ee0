"""The tissue as a hyperelastic body: energy W(z), force f = dW/dz, tangent K = d2W/dz2 and the force of a step."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.petsc import Array, PETSc
from softgrasp.fem.strain.laws import Start
from softgrasp.fem.strain.points import Points
from softgrasp.fem.system import LayerMaterial


class Body:
    """Points with materials; vectors have the distribution of the columns of B.

    Args:
        points: of this rank, or all of them.
        materials: one per layer.

    Attributes:
        rounding: what rounding in the stress mu F leaves of a force [N], in the norm of all rows.
    """

    def __init__(self, points: Points, materials: tuple[LayerMaterial, ...]) -> None:
        self.points, self.law = points, points.laws
        self.lam, self.mu = points.lame(materials)
        d, Q = points.d, len(points.vol)
        self.shape = (d, d, Q)
        self.h = points.B.createVecLeft()
        self.H: Array = self.h.array_w.reshape(self.shape)  # overwritten by every product
        self.K: PETSc.Mat | None = None
        self.A: PETSc.Mat | None = None
        self.rounding = self._rounding()

    def _rounding(self) -> float:
        size, force = abs_copy(self.points.B), self.points.B.createVecRight()
        self.H[:] = self.points.vol * self.mu
        self.h.stateIncrease()
        size.multTranspose(self.h, force)
        value = float(np.finfo(float).eps) * float(force.norm())
        size.destroy()
        force.destroy()
        return value

    def gradient(self, z: PETSc.Vec) -> Array:
        """H = grad z in the points of this rank, (d, d, Q); valid until the next call of any method. Collective."""
        self.points.B.mult(z, self.h)
        return self.H

    def energy(self, z: PETSc.Vec) -> float:
        """This rank's share of W(z) [J]. Collective."""
        return float(self.points.vol @ self.law.energy(self.gradient(z), self.lam, self.mu))

    def force(self, z: PETSc.Vec, f: PETSc.Vec) -> None:
        """F = B' (vol P(B z)) [N]. Collective."""
        self._collect(self.law.stress(self.gradient(z), self.lam, self.mu), f)

    def start(self, z: PETSc.Vec) -> Start:
        """The law at the start of a step. Collective."""
        return self.law.start(self.gradient(z))

    def step(self, start: Start, w: PETSc.Vec, f: PETSc.Vec) -> Array:
        """Force f [N] of the discrete gradient from z to z + 2 w, NaN where J_1 forbids it; J_1, (Q,). Collective."""
        P, J = self.law.step(start, self.gradient(w), self.lam, self.mu)
        self._collect(P if P is not None else self.H, f)  # all ranks take part in the product
        return J

    def _collect(self, P: Array, f: PETSc.Vec) -> None:
        np.multiply(P, self.points.vol, out=self.H)
        self.h.stateIncrease()
        self.points.B.multTranspose(self.h, f)

    def tangent(self, z: PETSc.Vec) -> PETSc.Mat:
        """K(z) = B' (vol A) B with the pattern of K_ee; the next call overwrites it. Collective."""
        d, Q = self.points.d, self.shape[2]
        moduli = self.law.tangent(self.gradient(z), self.lam, self.mu)
        moduli *= self.points.vol
        values = np.ascontiguousarray(moduli.reshape(d * d, d * d, Q).transpose(0, 2, 1)).ravel()
        if self.A is None:
            first = self.h.owner_range[0]
            self.indptr = np.arange(0, d**4 * Q + 1, d * d, dtype=PETSc.IntType)
            block = (np.arange(d * d) * Q + np.arange(Q)[:, None]).ravel() + first
            self.columns = np.tile(block, d * d).astype(PETSc.IntType)
            sizes = self.h.getSizes()
            csr = (self.indptr, self.columns, values)
            self.A = PETSc.Mat().createAIJ((sizes, sizes), csr=csr, comm=self.h.comm)
            self.K = self.A.ptap(self.points.B)
        else:
            self.A.setValuesCSR(self.indptr, self.columns, values)
            self.A.assemble()
            self.A.ptap(self.points.B, self.K)
        return self.K

    def destroy(self) -> None:
        """Free PETSc's objects; the points are not the body's own. Collective."""
        for item in (self.h, self.A, self.K):
            if item is not None:
                item.destroy()


def abs_copy(B: PETSc.Mat) -> PETSc.Mat:
    """|B| entry by entry. Collective."""
    indptr, columns, values = B.getValuesCSR()
    return PETSc.Mat().createAIJ(B.getSizes(), csr=(indptr, columns, np.abs(values)), comm=B.comm)
