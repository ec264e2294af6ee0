"""A bound on the loop gain far from the origin: it excludes closed-loop eigenvalues that were not computed."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.petsc import Array, times_columns, total
from softgrasp.fem.solve.statics import mass_columns
from softgrasp.fem.solve.stiffness import static_columns
from softgrasp.lqr.dense.modal import modes_of_plant
from softgrasp.lqr.lowrank.modal_start import plant_modes
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.operators import least_beta, modes_couple
from softgrasp.lqr.plant.problem import RiccatiProblem

MODES = 60


def why_no_bound(problem: RiccatiProblem) -> str:
    """Why :class:`TailBound` does not apply; empty when it does."""
    system, damping = problem.system, problem.system.damping
    if not damping.active:
        return "no damping: modes beyond the radius stay on the axis"
    if damping.matrix is not None and not least_beta(system) > 0:
        return "a layer without damping of its own: only the eigenvalues inside the radius are known"
    if system.two_way and damping.drag > 0:
        return "two-way coupling with alpha > 0 in space: only the eigenvalues inside the radius are known"
    return ""


def tail_modes(problem: RiccatiProblem, k: int = MODES) -> tuple[Array, Array]:
    """The k lowest frequencies and modes, or all, two-way with the hand floating. Collective."""
    k = min(k, problem.layout.n_e)
    return plant_modes(Plant(problem), k) if problem.system.two_way else modes_of_plant(problem, k)[:2]


class TailBound:
    """Bound of |h(s)|, h(s) = K (sE - A)^{-1} B, for Re s >= -a, |s| >= r: an eigenvalue of A + B K needs |h(s)| >= 1.

    Where the bound is finite, A itself has no eigenvalue. One-way, with the modes phi_k of the clamped tissue,

        |h| <= |K_q M_s^{-1}| / r^2 + |K_v M_s^{-1}| / r + sum_k (|K_zk| / r + |K_vk|) |g_k M_s^{-1}| b_k,
        b_k = min((1 + a / (r - a)) / (2 delta_k - 2 a), r / (r - omega_k)^2) >= |s| / |s^2 + 2 delta_k s + omega_k^2|,

    2 delta_k = alpha + beta omega_k^2; the second only for r > omega_k and underdamped modes. The first is true at once
    for a = 0, |s + 2 delta + omega^2 / s| >= 2 delta; for a > 0 on the line Re s = -a and on the circle |s| = r, hence
    everywhere between them and infinity, where s / (s^2 + 2 delta s + omega^2) is analytic: r > a leaves out the slow
    pole of an overdamped mode right of the line. The sum runs over the lowest modes; Cauchy-Schwarz with
    2 delta_k - 2 a >= (beta - 2 a / omega^2) omega_k^2, omega the last of them, bounds the rest. The same is true,
    two-way, of the modes of the tissue with the hand floating; q_s = M_s^{-1}(u / s^2 - G'z) adds to the gain on z.

    Where damping couples the modes (layers; two-way with alpha > 0), D >= W = alpha M + beta_min K still gives
    Re x*(s M + D + K / s) x >= x*Wx for Re s >= 0, hence |k'S^{-1}g| <= |k|_{W^{-1}} |g|_{W^{-1}} / |s|; a = 0 only.

    Assumptions: M_ee and, two-way, M_ee - G M_s^{-1} G' positive definite, the stiffness of every layer semidefinite,
    that of the whole definite, D symmetric, and the modes are the lowest. Rounding and the residual of the modes (1e-8)
    are not bounded.

    Args:
        problem: the plant; :func:`why_no_bound` must be empty.
        K: gain, transposed, hand-relative.
        modes: :func:`tail_modes`, when they are there already.
    """

    def __init__(self, problem: RiccatiProblem, K: Block, modes: tuple[Array, Array] | None = None) -> None:
        system, n_s, comm = problem.system, problem.layout.n_s, problem.layout.comm
        inverse = np.linalg.inv(problem.M_s)
        hand_q, hand_v, gain_z, gain_v = K.parts
        self.K_q, self.K_v = (float(np.linalg.norm(k.T @ inverse, 2)) for k in (hand_q, hand_v))
        self.alpha, self.beta = system.damping.alpha, least_beta(system)
        self.coupled = modes_couple(system)
        self.drag = system.damping.drag
        force = system.G @ inverse
        if system.two_way:  # the hand is free: q_s = M_s^{-1} (u / s^2 - G'z)
            gain_z, gain_v = gain_z - force @ hand_q, gain_v - force @ hand_v
        self.omega, Phi = tail_modes(problem) if modes is None else modes
        columns = np.hstack([gain_z, gain_v, force])
        size = total(comm, Phi.T @ columns)
        self.parts = np.hsplit(size, 3)  # gain on z and v, and force, of each mode
        self.modes = np.linalg.norm(np.stack(self.parts), axis=2)
        # the rest itself: as a difference of norms it would lose half the digits
        rest = columns - schur_mass(problem, Phi) @ size
        self.rest_z, self.rest_v, self.rest_force = _norms(problem, rest, _inverse_schur_mass(problem, rest), 3)
        static = static_columns(system, rest[:, 2 * n_s :])
        (self.rest_static,) = _norms(problem, static, schur_mass(problem, static), 1)

    def bound(self, r: float, a: float = 0.0) -> float:
        """The bound at radius r for Re s >= -a, 0 <= a < r; infinite where no bound is known."""
        if not 0 <= a < r or (a > 0 and (self.coupled or self.drag > 0)):
            return np.inf
        hand = self.K_q / r**2 + self.K_v / r
        tissue = self._coupled(r) if self.coupled else self._decoupled(r, a)
        return float(hand + tissue * (1 + self.drag / r))

    def _decoupled(self, r: float, a: float) -> float:
        last, far = float(self.omega[-1]), 1 + a / (r - a)
        twice = self.alpha + self.beta * self.omega**2
        # |s - p| |s - p'| >= (|s| - omega)^2 for a pair of complex poles
        inside = (twice < 2 * self.omega) & (self.omega < (1 - 1e-9) * r)
        near = np.where(inside, r / np.where(inside, r - self.omega, 1.0) ** 2, np.inf)
        margin = twice - 2 * a
        decay = np.where(margin > 0, far / np.where(margin > 0, margin, 1.0), np.inf)
        each = np.minimum(near, decay)
        # 1 / (2 delta_k - 2 a) <= 1 / ((beta - 2 a / omega^2) omega_k^2) or <= 1 / (alpha - 2 a)
        beta, alpha = self.beta - 2 * a / last**2, self.alpha - 2 * a
        by_beta = self.rest_static / beta if beta > 0 else np.inf
        by_alpha = self.rest_force / alpha if alpha > 0 else np.inf
        rest_of = min(by_beta, by_alpha)
        if not np.isfinite([*each, rest_of]).all():
            return np.inf
        K_z, K_v, force = self.modes
        rest = (self.rest_z / r + self.rest_v) * far * rest_of
        return float(np.sum((K_z / r + K_v) * force * each)) + rest

    def _coupled(self, r: float) -> float:
        weight = self.alpha + self.beta * self.omega**2
        last = self.alpha + self.beta * float(self.omega[-1]) ** 2
        K_z, K_v, force = (
            float(np.sqrt(np.sum(part**2 / weight) + rest**2 / last))
            for part, rest in zip(self.modes, (self.rest_z, self.rest_v, self.rest_force), strict=True)
        )
        return (K_z / r + K_v) * force

    def radius(self, limit: float) -> float:
        """Radius, to a tenth, from where the bound for Re s >= 0 is below ``limit``; inf if none."""
        grid = float(self.omega[0]) * 1e-3 * 1.1 ** np.arange(145)  # to 1000 omega_1
        good = [r for r in grid if self.bound(r) < limit]
        return float(min(good, default=np.inf))


def _norms(problem: RiccatiProblem, X: Array, W_X: Array, parts: int) -> list[float]:
    """Norms |X_i|_W of equally wide parts of X. Collective."""
    squares = total(problem.layout.comm, np.einsum("ij,ij->j", X, W_X))
    return [float(np.sqrt(max(part.sum(), 0.0))) for part in np.split(squares, parts)]


def schur_mass(problem: RiccatiProblem, X: Array) -> Array:
    """M_ee X, two-way (M_ee - G M_s^{-1} G') X: the mass with the free hand eliminated; local rows. Collective."""
    system = problem.system
    result = times_columns(system.M_ee, X)
    if system.two_way:
        result -= system.G @ np.linalg.solve(problem.M_s, total(problem.layout.comm, system.G.T @ X))
    return result


def _inverse_schur_mass(problem: RiccatiProblem, X: Array) -> Array:
    """M_ee^{-1} X, two-way (M_ee - G M_s^{-1} G')^{-1} X, local rows. Collective."""
    system, comm = problem.system, problem.layout.comm
    if not system.two_way:
        return mass_columns(system, X)
    both = mass_columns(system, np.hstack([X, system.G]))
    result, light = both[:, : X.shape[1]], both[:, X.shape[1] :]
    small = problem.M_s - total(comm, system.G.T @ light)
    return np.asarray(result + light @ np.linalg.solve(small, total(comm, system.G.T @ result)))
