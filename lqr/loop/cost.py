"""Quadratic cost of a run, and that predicted by the Riccati equation."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.lqr.lowrank.compress import gram
from softgrasp.lqr.plant.gain import PlantState
from softgrasp.lqr.plant.operators import descriptor
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution


def accumulated_cost(outputs: Array, inputs: Array, Q: Array, R: Array, dt: float) -> Array:
    """J(t_n) = sum_k dt (y_mid' Q y_mid + u_k' R u_k), the midpoint quadrature of the run's own step.

        With u = K x_mid and X from the Riccati equation every step satisfies, exactly and for every dt,

            V(x_{n+1}) - V(x_n) = -(J(t_{n+1}) - J(t_n)),    V(x) = x'E'XE x,

        because the midpoint rule keeps quadratic balances [HLW06]; so J(T) + V(x(T)) = V(x(0)) up to the residual of X.
        An input that is sampled and held costs more, by the integral of |u - K x|^2 weighted with R, second order in
        the length of the tick.

    Args:
            outputs: y - y_bar at the grid points [m], (steps + 1, p).
            inputs: u - u_bar of each step [N, N m], (steps, n_s).
            R: (n_s, n_s).
            dt: step [s].

        Returns J at the grid points, (steps + 1,), J[0] = 0.
    """
    y = (outputs[1:] + outputs[:-1]) / 2
    rate = np.einsum("ki,ij,kj->k", y, Q, y, optimize=True) + np.einsum("ki,ij,kj->k", inputs, R, inputs, optimize=True)
    return np.concatenate([[0.0], dt * np.cumsum(rate)])


def overshoot(outputs: Array, target: Array) -> float:
    """Farthest that an output runs past its target, over the way that it had to go; 0 where none does [1].

    ``outputs``: y at the grid points [m], (steps + 1, p); ``target``: y_bar [m], (p,).
    """
    way = target - outputs[0]
    going = np.abs(way) > 1e-9 * np.abs(way).max(initial=0.0)
    past = (outputs - target)[:, going] / way[going]
    return max(float(past.max(initial=0.0)), 0.0)


def predicted_cost(problem: RiccatiProblem, solution: RiccatiSolution, error: PlantState) -> float:
    """V = e'E'XE e = |Z'E e|^2 for e = x - x_bar: the cost from here to infinity. Collective."""
    moved = descriptor(problem, error.block)
    return float(np.sum(gram(problem.layout.comm, solution.factor, moved) ** 2))
