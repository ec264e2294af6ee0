"""A bound on what modes that were left out do in a loop with an observer, from tick to tick.

One-way the hand and its feedback reach a mode k of the tissue through the held acceleration M_s^{-1} u alone, and it
reaches them through the samples alone. With F the loop of the modes kept, T(z) from samples to inputs in it, and D(z)
from inputs to samples by way of the rest, the whole loop is stable where F is and

    max over |z| = 1 of |T(z)| |D(z)| < 1      (small gain; D is analytic outside, its modes are damped),

    |D(z)| <= max over the rest of |(zI - A_k)^{-1} b_k| (sum |C_k|^2)^{1/2} (sum |g_k M_s^{-1}|^2)^{1/2},

A_k, b_k the exact step of mode k in energy coordinates, sums over the rest in closed form: |c|_{K^{-1}}, |g|_{M^{-1}}
without the modes kept. Samples count in their standard deviations. Frequencies between that of the last mode kept and
the highest of the mesh, and |z| = 1 around every eigenvalue of F, are grids; rounding and the residual of the modes are
not bounded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array, total
from softgrasp.fem.solve.statics import mass_columns
from softgrasp.fem.solve.stiffness import static_columns
from softgrasp.fem.system import BlockSystem
from softgrasp.lqr.constrained.tissue import poles
from softgrasp.lqr.lowrank.shifts import frequency_estimate
from softgrasp.lqr.observer.sensors import Sensors
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.spectrum.modal_loop import ModalLoop
from softgrasp.lqr.spectrum.sampled import AROUND, FREQUENCIES, GRID


@dataclass(frozen=True)
class Rest:
    """Bound of the modes left out."""

    size: float  # max over |z| = 1 of |D(z)|, samples in standard deviations [1/N]
    sd: Array  # standard deviations of the samples, (p,)

    def gain(self, F: Array, enter: Array, leave: Array, direct: Array) -> float:
        """Largest |T(z)| |D(z)|, T(z) = leave (zI - F)^{-1} enter + direct; infinite where F is not stable.

        Args:
            F: loop of the modes kept, (k, k).
            enter: its states a tick later by the samples, (k, p).
            leave: inputs by its states, (n_s, k).
            direct: inputs by the samples of the same tick, (n_s, p).
        """
        values, vectors = np.linalg.eig(F)
        if not np.abs(values).max() < 1:
            return np.inf
        away = 1 - np.abs(values)
        angles = np.angle(values)[:, None] + away[:, None] * np.concatenate([-AROUND, AROUND])
        grid = np.abs(np.concatenate([np.linspace(0.5 / GRID, 1.0, GRID) * np.pi, angles.ravel()]))
        circle = np.exp(1j * np.unique(grid[(grid > 1e-9) & (grid <= np.pi)]))
        if np.linalg.cond(vectors) < 1e10:  # rounding of the peak: six digits
            left, right = leave @ vectors, np.linalg.solve(vectors, enter * self.sd)
            T = np.tensordot(1 / (circle[:, None] - values), left.T[:, :, None] * right[:, None, :], axes=1)
            return float(np.linalg.norm(T + direct * self.sd, 2, axis=(1, 2)).max()) * self.size
        S, U = scipy.linalg.schur(F, output="complex")  # samples on their way share one eigenvector
        right, left, one = U.conj().T @ (enter * self.sd), leave @ U, np.eye(len(F))
        peak = 0.0
        for z in circle:
            inner = scipy.linalg.solve_triangular(z * one - S, right, check_finite=False)
            peak = max(peak, float(np.linalg.norm(left @ inner + direct * self.sd, 2)))
        return peak * self.size


def why_no_rest(system: BlockSystem) -> str:
    """What :func:`rest_of` needs and a plant has not; empty where it has all."""
    if system.two_way:
        return "a hand that does not feel the tissue"
    if system.damping.matrix is not None or system.damping.drag:
        return "damping that is the same in all layers and acts against the hand"
    return ""


def rest_of(problem: RiccatiProblem, loop: ModalLoop, sensors: Sensors, period: float) -> Rest:
    """The bound for the modes that ``loop`` does not keep, sampled every ``period`` [s]. Collective.

    Raises SolverError: a solve failed.
    """
    system, comm, plant = problem.system, problem.layout.comm, loop.plant
    z, v = (part / sensors.sd for part in sensors.C.parts[2:])
    columns = np.hstack([z, v, system.G @ np.linalg.inv(problem.M_s)])
    rest = columns - plant.massed @ total(comm, plant.Phi.T @ columns)
    p = len(sensors.sd)
    static = static_columns(system, np.asfortranarray(rest[:, :p]))
    light = mass_columns(system, np.asfortranarray(rest[:, p:]))
    squares = total(comm, np.einsum("ij,ij->j", rest, np.hstack([static, light])))
    seen, force = (float(np.sqrt(max(part.sum(), 0.0))) for part in (squares[: 2 * p], squares[2 * p :]))
    last, fastest = float(plant.omega[-1]), 4 * frequency_estimate(system)  # estimated within a factor of 4
    omega = np.geomspace(last, max(fastest, 2 * last), FREQUENCIES)
    damping = system.damping
    return Rest(seen * force * _response(omega, (damping.alpha + damping.beta * omega**2) / 2, period), sensors.sd)


def _response(omega: Array, delta: Array, period: float) -> float:
    """Max over the modes and |z| = 1 of |(zI - M)^{-1} b|, M and b the exact step of [omega eta, eta'] under a load.

    |b| (1 / min(1 - rho) + c / ((1 - rho_1)(1 - rho_2))) bounds it, c the departure of M from normality, and so does
    the sum over its two eigenvectors.
    """
    p, m, _ = poles(omega, delta)
    fast, slow = np.expm1(m * period), np.expm1(p * period)
    A = np.zeros((len(omega), 2, 2))
    A[:, 0, 1], A[:, 1, 0], A[:, 1, 1] = omega, -omega, -2 * delta
    share, rate = ((p * fast - m * slow) / (p - m)).real, ((slow - fast) / (p - m)).real  # e^{At} - I = share + rate A
    M = np.eye(2) + share[:, None, None] * np.eye(2) + rate[:, None, None] * A
    static = np.stack([-1 / omega, np.zeros(len(omega))], axis=1)  # A^{-1} [0, 1]
    b = share[:, None] * static + rate[:, None] * [0.0, 1.0]
    gap = np.stack([-np.expm1(p.real * period), -np.expm1(m.real * period)])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        departure = np.sqrt(np.maximum(np.sum(M**2, axis=(1, 2)) - np.sum((1 - gap) ** 2, axis=0), 0.0))
        whole = np.linalg.norm(b, axis=1) * (1 / gap.min(axis=0) + departure / gap.prod(axis=0))
        # b = beta_1 v_1 + beta_2 v_2, eigenvectors [omega, p] and [omega, m]
        first = (b[:, 1] - m * b[:, 0] / omega) / (p - m)
        second = (p * b[:, 0] / omega - b[:, 1]) / (p - m)
        split = (
            np.abs(first) * np.hypot(omega, np.abs(p)) / gap[0] + np.abs(second) * np.hypot(omega, np.abs(m)) / gap[1]
        )
    return float(np.max(np.fmin(whole, split)))
