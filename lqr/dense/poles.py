"""Closed-loop poles of the tissue's modes before any Riccati equation is solved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array
from softgrasp.lqr.plant.checks import EPS, MODAL_KEY, square_root
from softgrasp.lqr.plant.problem import RiccatiProblem

# A rate below this share of the largest frequency is rounding: an error eps |H| of the Hamiltonian matrix moves a pole
# by as much, and a dense eigenvalue solver makes some ten times that.
LOST = 30 * EPS
# Damping ratio of the first mode from which the low-rank solvers converge in a few hundred solves (measured: 4e-4 does,
# 4e-5 does not).
ENOUGH = 4e-4


@dataclass(frozen=True)
class ModeRates:
    """Decay of each mode in the closed loop.

    Re p_k = -sqrt(delta_k^2 + f_k^2), |p_k| = omega_k, delta_k = phi_k' D phi_k / 2,
    f_k = |R^{-1/2} M_s^{-1} g_k| |Q^{1/2} c_k| / (2 omega_k)
    """

    omega: Array  # natural frequencies [1/s], (k,)
    own: Array  # delta_k, decay by the tissue's damping [1/s]
    feedback: Array  # f_k, what optimal feedback would add alone [1/s]
    size: float  # frequency scale of the whole plant, for rounding [1/s]

    @property
    def rate(self) -> Array:
        """-Re p_k [1/s]."""
        return np.asarray(np.hypot(self.own, self.feedback))

    @property
    def lost(self) -> Array:
        """Which modes double precision cannot tell from undamped ones."""
        return np.asarray(self.rate <= LOST * self.size)

    @property
    def poles(self) -> np.ndarray:
        """One pole p_k of each pair, Im >= 0; overdamped modes give the slower real pole."""
        imag = np.sqrt(np.maximum(self.omega**2 - self.rate**2, 0.0))
        slow = np.where(self.rate > self.omega, self.omega**2 / (2 * self.rate), self.rate)
        return np.asarray(-np.where(imag > 0, self.rate, slow) + 1j * imag)


def closed_loop_rates(
    problem: RiccatiProblem, omega: Array, damping: Array, g: Array, c: Array, largest: float = 0.0
) -> ModeRates:
    """Estimate the closed-loop pole of every mode; good to 3 or 4 digits when modes do not overlap.

    Args:
        omega: natural frequencies [1/s], (k,).
        damping: phi_k' D_ee phi_k [1/s], (k,).
        g: Phi' G, (k, n_s); without a hand Phi' B_z, (k, m).
        c: C_z' Phi, (p, k).
        largest: largest frequency of the whole plant [1/s]; the largest of ``omega`` when 0.
    """
    # (m, k); two-way: the rigid inertia moves too
    force = np.linalg.solve(problem.M_s, g.T) if problem.B_z is None else g.T
    weighted = scipy.linalg.solve_triangular(np.linalg.cholesky(problem.R), force, lower=True)
    seen = square_root(problem.Q) @ c
    product = np.linalg.norm(weighted, axis=0) * np.linalg.norm(seen, axis=0)
    # what symmetry makes zero is rounding in the arrays
    noise = (
        1e3 * EPS * np.linalg.norm(weighted, axis=0).max(initial=0.0) * np.linalg.norm(seen, axis=0).max(initial=0.0)
    )
    product = np.where(product > noise, product, 0.0)
    size = max(largest, float(omega.max(initial=0.0)))
    return ModeRates(omega, damping / 2, product / (2 * omega), size)


def lost_sentence(rates: ModeRates) -> str:
    """The modes that feedback cannot stabilise, the damping that would be enough, and the way out."""
    lost = np.flatnonzero(rates.lost)
    shown = ", ".join(f"{i + 1} (omega = {rates.omega[i]:.4g}/s)" for i in lost[:3])
    more = f" and {len(lost) - 3} more" if len(lost) > 3 else ""
    return (
        f"{len(lost)} of {len(rates.omega)} modes cannot be stabilised in double precision, mode {shown}{more}: they "
        "are neither damped nor both reached by the hand and seen by the outputs; set effects.damping.beta >= "
        f"{enough_damping(rates):.2g} s, or control only the lowest modes with {MODAL_KEY}"
    )


def enough_damping(rates: ModeRates) -> float:
    """Kelvin-Voigt time beta [s] that gives the first mode the damping ratio :data:`ENOUGH`."""
    return float(2 * ENOUGH / rates.omega.min())
