"""The tissue as a hyperelastic body: energy W(z), force f = dW/dz, tangent K = d2W/dz2 and the force of a step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.compiled import LANES, library
from softgrasp.fem.errors import SolverError
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array, PETSc
from softgrasp.fem.strain.laws import LAWS, Start, double_dot, green, stretches
from softgrasp.fem.strain.points import QuadraturePoints, node_arrays

DECLARATION = """
void softgrasp_start(int d, int k, int p, const int *node, const double *G, const double *z, double *H0, double *j0,
                     double *l0);
int softgrasp_force(int law, int d, int k, int p, const int *node, const double *G, const double *vol,
                    const double *lam, const double *mu, const double *H0, const double *j0, const double *l0,
                    const double *w, int n, double *f, double *J);"""


def compiled() -> Any:
    """(ffi, library) of `force.c`, or None with a warning where it cannot be compiled."""
    return library(Path(__file__).with_name("force.c"), DECLARATION, "finite strain steps in NumPy, twice as slow")


class Kernel:
    """Points of one rank, on a communicator of this rank alone, with their nodes.

    Args:
        points: quadrature points, B on one rank.
        lam: first Lame parameter of every point [Pa], (Q,).
        mu: shear modulus of every point [Pa], (Q,).
        code: interface and library of :func:`compiled`.

    Attributes:
        J: det F at the end of the last trial step, (Q,) [1].
    """

    def __init__(self, points: QuadraturePoints, lam: Array, mu: Array, code: Any) -> None:
        (ffi, self.c), d, Q = code, points.d, len(points.vol)
        node, G, k, p = node_arrays(points, LANES)
        H, change, log, J = np.zeros((d, d, p)), np.zeros(p), np.zeros(p), np.zeros(p)
        self.begin, self.J = Start(H[:, :, :Q], change[:Q], log[:Q]), J[:Q]

        def at(x: Any) -> Any:
            return ffi.from_buffer("int[]" if x.dtype == np.intc else "double[]", x)

        self.at = at
        self.law = list(LAWS.values()).index(points.laws)
        self.size = (d, k, p, at(node), at(G))
        self.points = tuple(at(np.pad(x, (0, p - Q))) for x in (points.vol, lam, mu))
        self.state, self.end = (at(H), at(change), at(log)), at(J)

    def start(self, z: Array) -> Start:
        """The law at the start of a step; valid until the next call."""
        self.c.softgrasp_start(*self.size, self.at(z), *self.state)
        return self.begin

    def force(self, w: Array, f: Array) -> bool:
        """Force f [N] of the discrete gradient over a step of 2 w from the last start; whether there is a stress."""
        return bool(
            self.c.softgrasp_force(
                self.law, *self.size, *self.points, *self.state, self.at(w), len(f), self.at(f), self.end
            )
        )


class HyperelasticBody:
    """Quadrature points with materials; vectors have the distribution of the columns of B.

    Args:
        points: quadrature points of the tissue.
        materials: material of each layer.
        pattern: matrix with the pattern of the tangents; None: that of B'AB, which on some ranks has fewer columns of
            other ranks than K_ee.
        springs: further stiffness of own terms, whose force is linear; None for none.

    Attributes:
        rounding: norm over all rows of the force that rounding in the stress mu F leaves [N].
    """

    def __init__(
        self,
        points: QuadraturePoints,
        materials: tuple[LayerMaterial, ...],
        pattern: PETSc.Mat | None = None,
        springs: PETSc.Mat | None = None,
    ) -> None:
        self.points, self.law = points, points.laws
        self.moduli = points.moduli(materials)
        d, Q = points.d, len(points.vol)
        self.shape = (d, d, Q)
        self.h = points.B.createVecLeft()
        self.H: Array = self.h.array_w.reshape(self.shape)  # overwritten by every product
        self.pattern = pattern if points.B.comm.size > 1 else None
        self.springs = springs
        if springs is not None:
            self.pull, self.held = springs.createVecLeft(), springs.createVecLeft()
        self.A: PETSc.Mat | None = None
        self.product: PETSc.Mat | None = None
        self.K: PETSc.Mat | None = None
        self.rounding = self._rounding()
        self.kernel: Any = None
        if points.B.comm.size == 1 and points.own is not None:
            self.kernel = self.law.kernel(points, self.moduli)
        elif points.B.comm.size == 1 and (code := compiled()) is not None:
            lam, mu = self.moduli
            self.kernel = Kernel(points, lam, mu, code)

    def _rounding(self) -> float:
        B, force = self.points.B, self.points.B.createVecRight()
        indptr, columns, values = B.getValuesCSR()
        size = PETSc.Mat().createAIJ(B.getSizes(), csr=(indptr, columns, np.abs(values)), comm=B.comm)
        self.H[:] = self.points.vol * self.law.stiffness(*self.moduli)
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
        energy = float(self.points.vol @ self.law.energy(self.gradient(z), *self.moduli))
        return energy + float(np.dot(z.array_r, self._sprung(z))) / 2 if self.springs is not None else energy

    def _sprung(self, z: PETSc.Vec) -> Array:
        """Force of the springs on the rows here [N]; valid until the next call. Collective."""
        assert self.springs is not None
        self.springs.mult(z, self.pull)
        return np.asarray(self.pull.array_r)

    def force(self, z: PETSc.Vec, f: PETSc.Vec) -> None:
        """Force f = B' (vol P(B z)) [N]. Collective."""
        self._collect(self.law.stress(self.gradient(z), *self.moduli), f)
        if self.springs is not None:
            f.array_w[:] += self._sprung(z)

    def sound(self, z: PETSc.Vec) -> bool:
        """Whether the law has a tangent at z in the points of this rank. Collective."""
        return self.law.defined(self.gradient(z), *self.moduli)

    def start(self, z: PETSc.Vec) -> Start:
        """The law at the start of a step; valid until the next call. Collective."""
        if self.springs is not None:
            self.springs.mult(z, self.held)
        return self.law.start(self.gradient(z)) if self.kernel is None else self.kernel.start(z.array_r)

    def step(self, start: Start, w: PETSc.Vec, f: PETSc.Vec) -> bool:
        """Force f [N] of the discrete gradient from z to z + 2 w, ``start`` the last; whether the rank has a stress.

        Collective.
        """
        if self.kernel is not None:
            self.J = self.kernel.J
            fine = bool(self.kernel.force(w.array_r, f.array_w))
        else:
            P, self.J = self.law.step(start, self.gradient(w), *self.moduli)
            self._collect(P if P is not None else self.H, f)  # all ranks take part in the product
            fine = P is not None
        if self.springs is not None:  # of z + w, the mean of both ends
            f.array_w[:] += self.held.array_r + self._sprung(w)
        return fine

    def refuse(self, start: Start, comm: MPI.Intracomm | None) -> None:
        """Refuse a state that the law does not describe: an inverted cell, or one pressed too far. Collective.

        ``comm``: ranks that share the points; None where each has them all. Raises SolverError: the message names law,
        cell, J and stretch.
        """
        J, place = self.lowest(1 + start.j, comm)
        least, where = self._least_stretch(start, comm) if self.law.least_stretch else (1.0, place)
        if J > 0 and least >= self.law.least_stretch:
            return
        text = (
            f"det F = {J:.3g} in the cell at {place}" if J <= 0 else f"a stretch of {least:.3g} in the cell at {where}"
        )
        raise SolverError(
            f"finite strain ({self.law.name}): {text}, where the law describes no solid; use "
            "effects.finite_strain.law = 'neo-hooke', a gentler motion or a stiffer material"
        )

    def lowest(self, values: Array, comm: MPI.Intracomm | None) -> tuple[float, str]:
        """Smallest of values in the points, and where it is. Collective if ``comm`` is given."""
        best: tuple[float, tuple[float, ...]] = (np.inf, ())
        if len(values):
            i = int(np.argmin(values))
            best = float(values[i]), tuple(self.points.X[i].tolist())
        value, place = best if comm is None else min(comm.allgather(best))
        return value, "(" + ", ".join(f"{x:.3g}" for x in place) + ")"

    def _least_stretch(self, start: Start, comm: MPI.Intracomm | None) -> tuple[float, str]:
        """Smallest principal stretch; it is above the limit where E is small."""
        E, limit = green(start.H), self.law.least_stretch
        values = np.ones(self.shape[2])
        doubtful = double_dot(E, E) > (1 - limit**2) ** 2 / 4
        if doubtful.any():
            values[doubtful] = stretches(start.H[:, :, doubtful])
        return self.lowest(values, comm)

    def _collect(self, P: Array, f: PETSc.Vec) -> None:
        np.multiply(P, self.points.vol, out=self.H)
        self.h.stateIncrease()
        self.points.B.multTranspose(self.h, f)

    def tangent(self, z: PETSc.Vec) -> PETSc.Mat:
        """K(z) = B' (vol A) B with ``pattern``; the next call overwrites it. Collective."""
        d, Q = self.points.d, self.shape[2]
        moduli = self.law.tangent(self.gradient(z), *self.moduli)
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
            self.product = self.A.ptap(self.points.B)
            self.K = None if self.pattern is None else self.pattern.duplicate(copy=False)
        else:
            self.A.setValuesCSR(self.indptr, self.columns, values)
            self.A.assemble()
            self.A.ptap(self.points.B, self.product)
        result: PETSc.Mat = self.product
        if self.K is not None:
            self.K.zeroEntries()
            self.K.axpy(1.0, self.product, PETSc.Mat.Structure.SUBSET)
            result = self.K
        if self.springs is not None:
            result.axpy(1.0, self.springs, PETSc.Mat.Structure.SUBSET)
        return result

    def destroy(self) -> None:
        """Free PETSc's objects; the points are not the body's own. Collective."""
        for item in (self.h, self.A, self.product, self.K):
            if item is not None:
                item.destroy()
