"""The system of a reduced model at one parameter, with its energies."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.petsc import Array
from softgrasp.fem.reduced import ReducedSystem
from softgrasp.fem.shown import Card, amount, listed
from softgrasp.reduction.bases.basis import ReductionError
from softgrasp.reduction.spectrum import Spectrum, spectrum


class ModelError(ReductionError):
    """A reduced model cannot be made, or lacks what a call needs."""


class UnstableModelError(SoftgraspError):
    """A reduced model with growing modes was about to be run."""


def singular(X: Array) -> bool:
    """Whether a square matrix is singular to rounding once its rows and columns are balanced."""
    sizes = np.abs(X)
    rows, columns = (np.sqrt(np.where(m > 0, m, 1.0)) for m in (sizes.max(axis=1), sizes.max(axis=0)))
    values = np.linalg.svd(X / np.outer(rows, columns), compute_uv=False)
    return bool(values[-1] <= 4 * len(X) * np.finfo(float).eps * values[0])


@dataclass(frozen=True)
class Outputs:
    """y = C_z x + C_s q_s, the scene's outputs [m]."""

    C_z: Array  # part of the tissue relative to the hand, (p, N)
    C_s: Array  # rigid part, (p, n_s)
    names: tuple[str, ...] = ()  # names of the outputs, (p,)


@dataclass(frozen=True, repr=False, kw_only=True)
class EnergySystem(ReducedSystem):
    """E x' = A x + B u + f, y = C x of a reduced model at one parameter, with its energies x' H x / 2.

    Everything that a run needs, nothing of full order. The state x has no unit of its own, but with fixed solid modes
    its first 2 n_s entries are q_s [m, rad] and v_s [m/s, rad/s].
    """

    name: str
    """Name of the basis."""
    C_s: Array
    """Outputs of the rigid motion, the part C_s q_s of y, (p, n_s)."""
    H_tissue: Array
    """Matrix of the tissue's energy (z' K z + v_z' M v_z) / 2 [J], (N, N)."""
    H: Array
    """H_tissue with the hand's kinetic energy; two-way of the rigid motion too: the Hamiltonian [J], (N, N)."""
    two_way: bool
    """Whether the hand feels the tissue."""
    structured: bool
    """Whether the model conserves its energy by construction where nothing damps."""
    scale: float = 1.0
    """Density over that of the projection (canonical models, else 1)."""

    def card(self) -> Card:
        """Dimension, stability and outputs."""
        rows = (
            ("dimension", f"N = {self.N}, hand {self.n_s}"),
            ("stable", self.verdict()),
            ("outputs", listed(self.names)),
        )
        return Card(f"EnergySystem {self.name}", rows)

    def verdict(self) -> str:
        """Whether the system is stable, with the largest real part of an eigenvalue, or why there is none."""
        try:
            return f"{'yes' if self.stable else 'no'}, spectral abscissa {amount(self.spectral_abscissa, '1/s')}"
        except ModelError as error:
            return f"unknown: {error}"

    @property
    def inner(self) -> slice:
        """Coordinates whose equations decide on stability: the tissue's own where the hand does not feel it."""
        return slice(2 * self.n_s if self.hand_first and not self.two_way else 0, self.N)

    @cached_property
    def spectrum(self) -> Spectrum:
        """Eigenvalues without the exact zeros of the free hand.

        Raises:
            ModelError: E is singular, as with linearly dependent columns.
        """
        self.check_independent()
        inner = self.inner
        H = self.H_tissue if inner.start else self.H
        result = spectrum(self.E[inner, inner], self.A[inner, inner], H[inner, inner], self.structured)
        return replace(result, zeros=self.N - len(result.eigenvalues))

    def check_independent(self) -> None:
        """Refuse a singular E, which LAPACK need not notice.

        Raises:
            ModelError: E is singular to rounding, as with linearly dependent columns.
        """
        if not np.isfinite(self.E).all():
            raise ModelError("the reduced matrices are not finite; check basis and materials", self.name)
        if singular(self.E):
            raise ModelError(
                "the reduced E is singular; its basis vectors are linearly dependent, use fewer", self.name
            )

    @property
    def spectral_abscissa(self) -> float:
        """Largest real part of an eigenvalue, apart from the exact zeros of the free hand [1/s]."""
        return self.spectrum.abscissa

    @property
    def stable(self) -> bool:
        """No eigenvalue right of the axis beyond the tolerance, :data:`softgrasp.reduction.spectrum.GROWTH_TOLERANCE`.

        The double zero of the free hand (it drifts at constant velocity) does not count.
        """
        return self.spectrum.stable

    def energy(self, x: Array) -> Array:
        """Tissue energy (z' K z + v_z' M v_z) / 2 of states (..., N) [J]."""
        return np.asarray(np.einsum("...i,...i->...", x @ self.H_tissue, x) / 2)

    def total_energy(self, x: Array) -> Array:
        """Energy with that of the hand's motion, of states (..., N) [J]; two-way it is the Hamiltonian."""
        return np.asarray(np.einsum("...i,...i->...", x @ self.H, x) / 2)

    def equilibrium(self) -> Array:
        """State at rest under gravity with the hand at the origin, (N,).

        Raises:
            ModelError: the hand is not fixed, so that the model has no such coordinates, or there is no such state, or
                more than one.
        """
        if not self.hand_first:
            raise ModelError("an equilibrium needs a basis with fixed solid modes", self.name)
        k = 2 * self.n_s
        x = np.zeros(self.N)
        if self.f.any():
            A = self.A[k:, k:]
            if singular(A):  # as with more displacements than velocities in the basis
                raise ModelError("the basis has no single equilibrium under gravity; use another N", self.name)
            x[k:] = -np.linalg.solve(A, self.f[k:])
        return x
