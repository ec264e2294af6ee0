"""Norms of a reduced run's residual, |r| = |T(theta) c|: triangles of orthonormalised columns instead of Gram matrices.

A run z = Phi a, v_z = Phi b with a' = b leaves in the momentum balance of the full model, at the middle of a step,

    r = sum over the layers of rho (M_1 Phi (b' + alpha b) + G_1 c) + (mu K_mu + lambda K_lambda) Phi (a + beta b),
    c = a_s - g [+ alpha v_s],

a combination of few columns C = Q T. With Q orthonormal in M_r^-1 (or K_r^-1) its norm is that of T times the
coefficients. A Gram matrix of C would lose half of the digits [BEOR14].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.linalg
from mpi4py import MPI
from slepc4py import SLEPc

from softgrasp.fem.errors import SolverError
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array, PETSc, from_options, times_columns, total
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.fem.solve.solvers import choose_solver, make_solver
from softgrasp.fem.system import BlockSystem
from softgrasp.reduction.galerkin import unit_coupling

DEPENDENT = 1e-8  # of the longest mode: shorter rests are not sure to be orthogonal to a residual
DROPPED = 1e-14  # of a column's own length: what is left of it is rounding
PREFIX = "softgrasp_certified_"
MARGIN = 1.01  # of the largest frequency, which the iteration meets from below


@dataclass(frozen=True)
class ResidualNorms:
    """Triangles of the columns [G_1 of every layer; M_1 phi, K_mu phi, K_lambda phi of every layer, mode by mode]."""

    static: Array  # triangle T of the columns in K_r^-1, (rows, L n_s + 3 L k)
    mass: Array  # triangle T of the columns in M_r^-1, (rows, L n_s + 3 L k)
    reference: tuple[LayerMaterial, ...]  # material of each of the L layers in K_r and M_r
    n_s: int  # number of degrees of freedom of the hand [1]
    dimension: int  # space dimension d
    omega: tuple[float, float]  # lowest and (a bound on the) highest frequency at the reference [1/s]

    @property
    def k(self) -> int:
        """Number of modes."""
        layers = len(self.reference)
        return int(self.static.shape[1] // layers - self.n_s) // 3

    def leading(self, k: int) -> ResidualNorms:
        """Norms of the residual of the model of the first k modes: the leading blocks of both triangles."""
        width = len(self.reference) * (self.n_s + 3 * k)
        return replace(self, static=_leading(self.static, width), mass=_leading(self.mass, width))

    @cached_property
    def galerkin(self) -> ResidualNorms:
        """Norms for residuals with Phi' r = 0, which have no part in the rows of K_r Phi, nor of M_r Phi."""
        static = orthogonal_complement(self.static, self.columns("static", self.reference)[2])
        mass = orthogonal_complement(self.mass, self.columns("mass", self.reference)[1])
        return replace(self, static=static, mass=mass)

    @cached_property
    def _parts(self) -> dict[str, tuple[Array, Array]]:
        """Columns of each triangle for G_1, (layers, rows n_s), and for M_1, K_mu and K_lambda, (3 layers, rows k)."""
        layers, width = len(self.reference), len(self.reference) * self.n_s
        triangles = {"static": self.static, "mass": self.mass, "both": np.vstack([self.static, self.mass])}
        return {
            which: (
                T[:, :width].reshape(len(T), layers, -1).transpose(1, 0, 2).reshape(layers, -1),
                T[:, width:].reshape(len(T), -1, 3 * layers).transpose(2, 0, 1).reshape(3 * layers, -1),
            )
            for which, T in triangles.items()
        }

    def columns(
        self, which: Literal["static", "mass", "both"], materials: tuple[LayerMaterial, ...], count: int = 4
    ) -> tuple[Array, ...]:
        """Blocks of a triangle at a parameter, the first ``count`` of these four.

        They multiply the hand's load c, (rows, n_s), then b' + alpha b, a and viscous b of the modes, (rows, k) each.
        """
        hand, tissue = self._parts[which]
        rows = hand.shape[1] // self.n_s
        weights = np.array(  # of M_1, K_mu, K_lambda in every layer
            [
                [(m.rho, 0.0, 0.0) for m in materials],
                [(0.0, m.mu, m.lam) for m in materials],
                [(0.0, m.beta * m.mu, m.beta * m.lam) for m in materials],
            ][: count - 1]
        )
        own = weights.reshape(count - 1, -1) @ tissue
        return (weights[0, :, 0] @ hand).reshape(rows, -1), *own.reshape(count - 1, rows, -1)

    def static_factor(self, materials: tuple[LayerMaterial, ...]) -> float:
        """Factor c with |r|_{K^-1} <= c |r|_{K_r^-1}: 0 <= K_lambda <= (d / 2) K_mu, since (tr e)^2 <= d e:e."""
        return float(min(min(pair) for pair in self._ratios(materials)) ** -0.5)

    def stiffness_factor(self, materials: tuple[LayerMaterial, ...]) -> float:
        """Factor c with |z|_K <= c |z|_{K_r}."""
        return float(max(max(pair) for pair in self._ratios(materials)) ** 0.5)

    def _ratios(self, materials: tuple[LayerMaterial, ...]) -> list[tuple[float, float]]:
        """Ratios of mu and of mu + d lambda / 2 of each layer to those of the reference [1]."""
        half = self.dimension / 2
        pairs = zip(materials, self.reference, strict=True)
        return [(m.mu / r.mu, (m.mu + half * m.lam) / (r.mu + half * r.lam)) for m, r in pairs]

    def mass_factor(self, materials: tuple[LayerMaterial, ...]) -> float:
        """Factor c with |r|_{M^-1} <= c |r|_{M_r^-1}; exact for a common factor of all densities."""
        return float(max(r.rho / m.rho for m, r in zip(materials, self.reference, strict=True)) ** 0.5)

    def inertia_factor(self, materials: tuple[LayerMaterial, ...]) -> float:
        """Factor c with |v|_M <= c |v|_{M_r}."""
        return float(max(m.rho / r.rho for m, r in zip(materials, self.reference, strict=True)) ** 0.5)

    def frequencies(self, materials: tuple[LayerMaterial, ...]) -> tuple[float, float]:
        """Bounds below and above on all natural frequencies at a parameter [1/s]."""
        low = self.omega[0] / (self.static_factor(materials) * self.inertia_factor(materials))
        return low, self.omega[1] * self.stiffness_factor(materials) * self.mass_factor(materials)


def _leading(T: Array, width: int) -> Array:
    columns = T[:, :width]
    used = np.flatnonzero(columns.any(axis=1))
    return np.ascontiguousarray(columns[: int(used[-1]) + 1 if len(used) else 1])


def orthogonal_complement(T: Array, B: Array) -> Array:
    """Orthogonal complement: rows of T after removing the range of B; T itself where B has full rank."""
    Q, R, _ = scipy.linalg.qr(B, pivoting=True)
    rank = int(np.count_nonzero(abs(np.diag(R)) > DEPENDENT * abs(R[0, 0])))
    return T if rank == len(T) else np.asarray(Q[:, rank:].T @ T)


class Orthonormal:
    """Columns Q with Q' W^-1 Q = I, grown by and by, and the triangle T of C = Q T. Collective.

    Gram-Schmidt with re-orthogonalisation, one solve a column; Y = W^-1 Q is kept beside Q.

    Args:
        system: system of the tissue, for the distribution of the rows and the choice of the solver.
        W: matrix of the norm, symmetric positive definite; None: W^-1 = ``product``.
        product: matrix W^-1 itself, which needs no solver; None where W is given.
    """

    def __init__(self, system: BlockSystem, W: PETSc.Mat | None, product: PETSc.Mat | None = None) -> None:
        self.comm, self.product = system.layout.comm, product
        self.n = system.layout.n_local
        if W is not None:
            name, _ = choose_solver(system.layout, few=True)
            self.solver = make_solver(W.copy(), name, system.layout, PREFIX, 1e-12, reproducible=False)
        self.Q, self.Y = np.empty((self.n, 0), order="F"), np.empty((self.n, 0), order="F")
        self.T: list[Array] = []
        self.rank = 0

    def riesz(self, X: Array) -> Array:
        """W^-1 X, local rows. Collective."""
        if self.product is not None:
            return times_columns(self.product, X)
        return self.solver.columns(X)

    def add(self, C: Array) -> None:
        """Append columns, local rows (n_local, p). Collective."""
        X = np.array(C, order="F")
        room = self.rank + X.shape[1]
        if room > self.Q.shape[1]:
            self.Q, self.Y = (
                np.asfortranarray(np.hstack([A[:, : self.rank], np.empty((self.n, 2 * X.shape[1] + self.rank))]))
                for A in (self.Q, self.Y)
            )
        known = total(self.comm, self.Y[:, : self.rank].T @ X)
        X -= self.Q[:, : self.rank] @ known
        for j in range(X.shape[1]):
            x, t = X[:, j], np.zeros(self.rank)
            t[: len(known)] = known[:, j]
            for _ in range(2):
                h = total(self.comm, self.Y[:, : self.rank].T @ x)
                x -= self.Q[:, : self.rank] @ h
                t += h
            y = self.riesz(x[:, None])[:, 0]
            length = float(np.sqrt(max(total(self.comm, np.array([x @ y]))[0], 0.0)))
            if length > DROPPED * np.hypot(np.linalg.norm(t), length):
                self.Q[:, self.rank], self.Y[:, self.rank] = x / length, y / length
                self.rank += 1
                t = np.append(t, length)
            self.T.append(t)

    def triangle(self) -> Array:
        """T of all columns so far, (rank, columns), the same bits on every rank. Collective."""
        T = np.zeros((max(self.rank, 1), len(self.T)))
        for j, t in enumerate(self.T):
            T[: len(t), j] = t
        return np.asarray(self.comm.bcast(T))

    def destroy(self) -> None:
        """Free the PETSc objects. Collective."""
        if self.product is None:
            self.solver.destroy()


class ResidualSpace:
    """The columns of the residual of a growing basis, orthonormalised in M_r^-1 and in K_r^-1. Collective.

    Memory: 4 arrays of n_e x (3 L k + L n_s), in the offline stage only.

    Args:
        system: gives layers and layout; its materials do not matter.
        reference: materials of the norms.

    Raises:
        SolverError: a factorisation failed.
    """

    def __init__(self, system: BlockSystem, reference: tuple[LayerMaterial, ...]) -> None:
        self.system, self.reference = system.with_materials(reference), reference
        self.static = Orthonormal(system, self.system.K_ee)
        self.mass = Orthonormal(system, self.system.M_ee)
        self._omega: tuple[float, float] | None = None
        self._add(np.hstack(unit_coupling(system)[0]))

    def _add(self, C: Array) -> None:
        self.static.add(C)
        self.mass.add(C)

    def extend(self, Phi: Array) -> None:
        """Append the columns of new modes, local rows (n_local, p). Collective."""
        products = [
            times_columns(A.ee, Phi) for layer in self.system.layers for A in (layer.M_1, layer.K_mu, layer.K_lambda)
        ]
        if Phi.shape[1]:
            # mode by mode, so that leading modes have leading blocks
            self._add(np.stack(products, axis=2).reshape(len(Phi), -1))

    def norms(self) -> ResidualNorms:
        """Triangles of all modes so far. Collective."""
        layout = self.system.layout
        if self._omega is None:
            low = float(lowest_modes(self.system, 1)[0][0])
            self._omega = low, MARGIN * highest_frequency(self.system) if self.system.damping.active else np.inf
        return ResidualNorms(
            self.static.triangle(), self.mass.triangle(), self.reference, layout.n_s, layout.dimension, self._omega
        )

    def compliance(self, C: Array) -> Array:
        """sqrt(c' K_r^-1 c) of every output column c of the tissue, local rows (n_local, p); (p,). Collective."""
        squares = total(self.system.layout.comm, (C * self.static.riesz(C)).sum(axis=0))
        return np.asarray(self.system.layout.comm.bcast(np.sqrt(np.maximum(squares, 0.0))))

    def destroy(self) -> None:
        """Free the factors. Collective."""
        self.static.destroy()
        self.mass.destroy()


def highest_frequency(system: BlockSystem) -> float:
    """Largest omega of K_ee phi = omega^2 M_ee phi [1/s], met from below to 1e-3. Collective.

    Raises:
        SolverError: the iteration did not converge.
    """
    eps = SLEPc.EPS().create(system.layout.comm)
    eps.setOptionsPrefix(PREFIX)
    eps.setOperators(system.K_ee, system.M_ee)
    eps.setProblemType(SLEPc.EPS.ProblemType.GHEP)
    eps.setWhichEigenpairs(SLEPc.EPS.Which.LARGEST_REAL)
    eps.setDimensions(nev=1, ncv=min(40, system.layout.n_e))
    eps.setTolerances(1e-3, 500)
    st = eps.getST()
    ksp = st.getKSP()
    ksp.setType("cg")
    ksp.getPC().setType("jacobi")
    ksp.setTolerances(rtol=1e-10, max_it=500)
    from_options(eps)
    try:
        eps.solve()
        if eps.getConverged() < 1:
            raise SolverError("the largest frequency of the tissue did not converge; check material and mesh")
        value = float(eps.getEigenvalue(0).real) ** 0.5
    except PETSc.Error as error:
        raise SolverError(f"the largest frequency of the tissue failed ({error}); check material and mesh") from error
    finally:
        eps.destroy()
    return float(system.layout.comm.allreduce(value, MPI.MAX))
