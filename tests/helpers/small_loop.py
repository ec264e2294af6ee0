"""The closed loop of a reduced system by plain midpoint steps, and the full states and gains of reduced ones."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.fem.reduced import ReducedSystem
from softgrasp.lqr.loop.actuation import Actuation, ImplicitInput
from softgrasp.lqr.loop.cost import accumulated_cost
from softgrasp.lqr.loop.small import Shapes
from softgrasp.lqr.plant.gain import Gain, PlantState
from softgrasp.lqr.plant.problem import RiccatiProblem


def expand(shapes: Shapes, problem: RiccatiProblem, x: Array) -> PlantState:
    """The full state V x of a reduced one."""
    n_s, k = problem.layout.n_s, shapes.V.shape[1]
    q, v, eta, rate = np.split(np.asarray(x), [n_s, 2 * n_s, 2 * n_s + k])
    return PlantState(q, v, shapes.V @ eta, shapes.V @ rate)


def expand_gain(shapes: Shapes, problem: RiccatiProblem, K: Array) -> Gain:
    """The gain on the full state that is u = K [q_s, v_s, W'z, W'v_z]."""
    n_s, k = problem.layout.n_s, shapes.V.shape[1]
    return Gain(K[:, : 2 * n_s], shapes.W @ K[:, 2 * n_s : 2 * n_s + k].T, shapes.W @ K[:, 2 * n_s + k :].T)


class SmallRun(NamedTuple):
    """States and outputs at the grid points, inputs of the steps, cost up to each grid point."""

    states: Array
    inputs: Array
    outputs: Array
    cost: Array
    saturated: float


def run_small(
    plant: ReducedSystem,
    dt: float,
    K: Array,
    rest: tuple[Array, Array],
    steps: int,
    weights: tuple[Array, Array],
    actuation: Actuation | None = None,
) -> SmallRun:
    """u = u_bar + K (x - x_bar) from rest with the hand at 0: in the middle of each step, or sampled, held and late."""
    law, n_s = actuation or Actuation(), plant.n_s
    P, Y, b = np.split(plant.midpoint(dt).matrix, [plant.N, plant.N + n_s], axis=1)
    x_bar, u_bar = rest
    offset, every = u_bar - K @ x_bar, law.ticks(dt)
    bound = law.bound(n_s)
    limit = np.full(n_s, np.inf) if bound is None else bound
    inside = ImplicitInput(K @ Y / 2, bound)
    waiting = deque([np.clip(u_bar, -limit, limit)] * (law.delay + 1), law.delay + 1)
    states, inputs = [plant.rest_at(np.zeros(n_s))[0]], []
    for n in range(steps):
        x = states[-1]
        free = P @ x + b[:, 0]
        if not every:
            waiting.append(inside.solve(offset + K @ (x + free) / 2))
        elif n % every == 0:
            waiting.append(np.clip(offset + K @ x, -limit, limit))
        inputs.append(waiting[0])
        states.append(free + Y @ waiting[0])
    X, U = np.array(states), np.array(inputs)
    outputs = X @ plant.C.T
    cost = accumulated_cost(outputs - plant.C @ x_bar, U - u_bar, *weights, dt)
    return SmallRun(X, U, outputs, cost, law.saturated(U))
