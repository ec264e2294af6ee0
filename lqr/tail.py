"""A bound on the loop gain far from the origin: it excludes closed-loop eigenvalues that no iteration was asked for."""

from __future__ import annotations

import numpy as np

from fem.petsc import Array, times_columns, total
from lqr.checks import EPS
from lqr.dense import some_modes
from lqr.modal_start import plant_modes
from lqr.plant import Block, Plant
from lqr.problem import RiccatiProblem
from reduction.inner import solve_columns

MODES = 60


def why_no_bound(problem: RiccatiProblem) -> str:
    """Why :class:`Tail` does not apply; empty when it does. Not collective."""
    system, damping = problem.system, problem.system.damping
    if not damping.active:
        return "no damping: modes beyond the radius stay on the axis"
    if damping.matrix is not None and not least_beta(problem) > 0:
        return "a layer without damping of its own: only the eigenvalues inside the radius are known"
    if system.two_way and damping.alpha > 0 and damping.in_space:
        return "two-way coupling with alpha > 0 in space: only the eigenvalues inside the radius are known"
    return ""


def least_beta(problem: RiccatiProblem) -> float:
    """Kelvin-Voigt time of the least damped layer [s]: D_ee >= alpha M_ee + beta K_ee. Not collective."""
    system = problem.system
    if system.damping.matrix is None:
        return system.damping.beta
    return min((m.beta for m in system.materials), default=0.0)


class Tail:
    """Bound of |h(s)|, h(s) = K (sE - A)^{-1} B, for Re s >= -a, |s| >= r: an eigenvalue of A + B K needs |h(s)| >= 1.

    h is analytic there, so that its bound on the boundary of the region holds inside too. One-way, with the modes
    phi_k of the clamped tissue,

        |h| <= |K_q M_s^{-1}| / r^2 + |K_v M_s^{-1}| / r + sum_k (|K_zk| / r + |K_vk|) |g_k M_s^{-1}| b_k,
        b_k = min((1 + a / (r - a)) / (2 delta_k - 2 a), r / (r - omega_k)^2),

    2 delta_k = alpha + beta omega_k^2; the second only for r > omega_k and underdamped modes. The sum runs over the
    lowest modes; Cauchy-Schwarz with 2 delta_k >= (beta - 2 a / omega^2) omega_k^2 bounds the rest. Two-way the same
    holds in the modes of the tissue with the hand floating, where q_s = M_s^{-1}(u / s^2 - G'z) adds to the gain on z.

    Where damping couples the modes (layers; two-way with alpha > 0), D >= W = alpha M + beta_min K still gives
    |x*(s^2 M + s D + K) x| >= |s| x*Wx for Re s >= 0, hence |k'S^{-1}g| <= |k|_{W^{-1}} |g|_{W^{-1}} / |s|; a = 0 only.

    Args:
        problem: the plant; :func:`why_no_bound` must be empty.
        K: gain, transposed, hand-relative.
    """

    def __init__(self, problem: RiccatiProblem, K: Block) -> None:
        system, n, n_s = problem.system, problem.layout.n_local, problem.layout.n_s
        comm = problem.layout.comm
        inverse = np.linalg.inv(problem.M_s)
        hand_q, hand_v = K.hand[:n_s], K.hand[n_s:]
        self.K_q, self.K_v = (float(np.linalg.norm(k.T @ inverse, 2)) for k in (hand_q, hand_v))
        self.alpha, self.beta = system.damping.alpha, least_beta(problem)
        self.coupled = system.damping.matrix is not None or (system.two_way and system.damping.alpha > 0)
        self.drag = self.alpha if system.damping.in_space else 0.0
        force = system.G @ inverse
        gain_z, gain_v = K.tall[:n], K.tall[n:]
        if system.two_way:  # the hand gives way: q_s = M_s^{-1} (u / s^2 - G'z)
            gain_z, gain_v = gain_z - force @ hand_q, gain_v - force @ hand_v
        k = min(MODES, problem.layout.n_e)
        omega, Phi = plant_modes(Plant(problem), k) if system.two_way else some_modes(problem, k)[:2]
        size = total(comm, np.stack([Phi.T @ gain_z, Phi.T @ gain_v, Phi.T @ force]))
        self.omega, self.modes = omega, np.linalg.norm(size, axis=2)
        static = solve_columns(system.K_ee, problem.layout, force)
        products = _inverse_mass(problem, np.hstack([gain_z, gain_v, force]))
        self.rest_z, self.rest_v, self.rest_force = (
            self._rest(total(comm, X.T @ products[:, i * n_s : (i + 1) * n_s]), self.modes[i])
            for i, X in enumerate((gain_z, gain_v, force))
        )
        moved = times_columns(system.M_ee, static)
        if system.two_way:
            moved -= force @ total(comm, system.G.T @ static)
        self.rest_static = self._rest(total(comm, static.T @ moved), self.modes[2] / omega**2)

    @staticmethod
    def _rest(gram: Array, part: Array) -> float:
        """Frobenius norm of what the modes leave over; rounding counts as left over."""
        whole = float(np.trace(gram))
        return float(np.sqrt(max(whole - float(np.sum(part**2)), 100 * EPS * whole)))

    def bound(self, r: float, a: float = 0.0) -> float:
        """The bound at radius r for Re s >= -a, 0 <= a < r; infinite where it says nothing. Not collective."""
        if not 0 <= a < r or (a > 0 and (self.coupled or self.drag > 0)):
            return np.inf
        hand = self.K_q / r**2 + self.K_v / r
        tissue = self._coupled(r) if self.coupled else self._decoupled(r, a)
        return float(hand + tissue * (1 + self.drag / r))

    def _decoupled(self, r: float, a: float) -> float:
        last, far = float(self.omega[-1]), 1 + a / (r - a)
        twice = self.alpha + self.beta * self.omega**2
        gap = np.maximum(r - self.omega, 1e-9 * r)  # modes beyond r: the other bound is the smaller one
        # |s - p| |s - p'| >= (|s| - omega)^2 for a pair of complex poles
        near = np.where((twice < 2 * self.omega) & (self.omega < r), r / gap**2, np.inf)
        margin = twice - 2 * a
        decay = np.where(margin > 0, far / np.where(margin > 0, margin, 1.0), np.inf)
        each = np.minimum(near, decay)
        K_z, K_v, force = self.modes
        # 1 / (2 delta_k - 2 a) <= 1 / ((beta - 2 a / omega^2) omega_k^2) or <= 1 / (alpha - 2 a)
        beta, alpha = self.beta - 2 * a / last**2, self.alpha - 2 * a
        by_beta = self.rest_static / beta if beta > 0 else np.inf
        by_alpha = self.rest_force / alpha if alpha > 0 else np.inf
        rest = (self.rest_z / r + self.rest_v) * far * min(by_beta, by_alpha)
        return float(np.sum((K_z / r + K_v) * force * each)) + rest

    def _coupled(self, r: float) -> float:
        weight = self.alpha + self.beta * self.omega**2
        last = self.alpha + self.beta * float(self.omega[-1]) ** 2
        K_z, K_v, force = (
            float(np.sqrt(np.sum(part**2 / weight) + rest**2 / last))
            for part, rest in zip(self.modes, (self.rest_z, self.rest_v, self.rest_force), strict=True)
        )
        return (K_z / r + K_v) * force

    def radius(self, wanted: float) -> float:
        """Radius, to a tenth, from where the bound for Re s >= 0 is below ``wanted``; inf if none. Not collective."""
        grid = float(self.omega[0]) * 1e-3 * 1.1 ** np.arange(145)  # to 1000 omega_1
        good = [r for r in grid if self.bound(r) < wanted]
        return float(min(good, default=np.inf))


def _inverse_mass(problem: RiccatiProblem, X: Array) -> Array:
    """M_ee^{-1} X, two-way (M_ee - G M_s^{-1} G')^{-1} X, local rows. Collective."""
    system, comm = problem.system, problem.layout.comm
    if not system.two_way:
        return solve_columns(system.M_ee, problem.layout, X)
    both = solve_columns(system.M_ee, problem.layout, np.hstack([X, system.G]))
    result, light = both[:, : X.shape[1]], both[:, X.shape[1] :]
    small = problem.M_s - total(comm, system.G.T @ light)
    return np.asarray(result + light @ np.linalg.solve(small, total(comm, system.G.T @ result)))
