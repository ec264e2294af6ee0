"""The Kalman filter of the full tissue by the dual Riccati equation, with the low-rank solver of the control problem.

For a hand whose motion is known, M z'' + D z' + K z = F w and y = C z + noise. The transpose of this system is the same
second-order system: with zeta = (D w + M w', w) it is M w'' + D w' + K w = C' nu with the outputs F'w. So the control
problem (B, C, Q, R) = (C', F, W, V) gives X = Z Z' and K, and the filter is

    L_1 = -M^{-1} K_v  (rows of z'),   L_2 = -K_z + D M^{-1} K_v  (rows of M z''),   sd(c'z) = |Z_v'c|.

It is the yardstick of the filters that run: no estimate from these samples is better.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array, combine, total
from softgrasp.fem.solve.statics import solve_columns
from softgrasp.lqr.observer.sensors import Disturbance, Sensors
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.operators import damp
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.plant.second_order import second_order
from softgrasp.lqr.riccati import solve


@dataclass(frozen=True)
class FullFilter:
    """Kalman filter of the tissue beside a hand that is known."""

    L_1: Array  # correction of z' by markers, local rows (n_local, p)
    L_2: Array  # correction of M z'' by markers, local rows (n_local, p)
    sd: Array  # standard deviation of z at every unknown [m], local rows (n_local,)
    Z_v: Array  # factor of the covariance of z, local rows (n_local, rank)
    solution: RiccatiSolution  # of the dual equation

    def sd_of(self, problem: RiccatiProblem, C_z: Array) -> Array:
        """Standard deviation of C_z'z for local rows (n_local, p), (p,). Collective."""
        return np.asarray(np.linalg.norm(total(problem.layout.comm, C_z.T @ self.Z_v), axis=1))


def full_filter(
    problem: RiccatiProblem, sensors: Sensors, disturbance: Disturbance, period: float, tol: float = 1e-10
) -> FullFilter:
    """The stationary Kalman filter of z from markers sampled every ``period`` [s]. Collective.

    Unknown accelerations of the hand and the load disturb the tissue. RADI, whose start needs nothing: that of Newton's
    method takes 260 solves here.

    Args:
        tol: true relative residual of the dual equation.

    Raises:
        ControlError: there are no markers.
        SolverError: the dual equation did not converge, the tissue has no damping for example.
    """
    system, rows = problem.system, sensors.markers
    if rows.stop == rows.start:
        raise ControlError("a filter of the full tissue needs markers; give control.observer.markers")
    C = sensors.C.parts[2][:, rows]
    F = np.hstack([system.G, disturbance.p])
    R = np.diag(sensors.sd[rows] ** 2 * period)
    damping, viscous = system.damping, system.damping.matrix
    if viscous is None:
        dual = second_order((system.M_ee, system.M_ee, system.K_ee), C, F, disturbance.W, R, damping)
    else:
        D = combine([(damping.alpha, system.M_ee), (1.0, viscous)])
        dual = second_order((system.M_ee, D, system.K_ee), C, F, disturbance.W, R)
    solution = solve(dual, "radi", tol)
    L_1 = -solve_columns(system.M_ee, problem.layout, solution.gain.K_v)
    L_2 = -solution.gain.K_z - damp(system, L_1)
    Z_v = solution.factor.parts[3]
    return FullFilter(L_1, L_2, np.linalg.norm(Z_v, axis=1), Z_v, solution)
