"""The quadratic program of a plan from any state near its way, with the few rows that may hold it.

With x_{k+1} = F x_k + D c_k and u_k - u_bar = K x_k + L c_k, a row of interval k is a_r x_k + d_r c_k + free_r >= 0.
From the state x at interval j it is a row of least distance in c = (c_j, .., c_{j+H-1}),

    -sum_i C_r[k-i] c_i <= a_r F^{k-j} x + free_r,    C_r[0] = d_r,  C_r[m] = a_r F^{m-1} D,

so that C, made once, serves every state and every later interval. Rows that are left out hold wherever a plan stays in
a box about the way that was planned first, which :meth:`Program.judge` looks at.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.petsc import Array
from softgrasp.lqr.program.least_distance import nearest, nearest_soft

MOST_STEPS = 200  # changes of the active set of one program; a few are usual
SLIGHT = 1e-10  # [m]: a slack that is rounding of the price
HARD = -1  # obstacle of a row of a limit
KEEPS = 1e-9  # of the unit of a row: rounding of a plan that keeps it with equality


@dataclass(frozen=True)
class Program:
    """What a robot needs to plan again, in states x = T (x^ - x_bar) of the plan's plant."""

    F: Array  # x an interval later under the gain, (n, n)
    D: Array  # of the deviation c from it, (n, n_s)
    K: Array  # gain of the grid, (n_s, n)
    L: Array  # u = u_bar + K x + L c, (n_s, n_s)
    a: Array  # rows by the state, (m, n)
    coefficients: Array  # rows by c, the latest last: C_r[H-1], .., C_r[0], (m, n_s H)
    free: Array  # right-hand side with room for what is between two instants [m, N, m/s], (m,)
    exact: Array  # right-hand side without that room, (m,)
    obstacle: NDArray[np.int64]  # of a gap, else :data:`HARD`, (m,)
    part: NDArray[np.int64]  # parts of the interval before and behind the instant of a gap, (m, 2)
    leaves: Array  # way off the chord of a unit of each swing, (m, k)
    along: Array  # way off the chord of a unit of the input [m/N], (m, n_s)
    first: NDArray[np.int64]  # first row of intervals 0, .., H - 1, of all later ones, and the number of rows, (H + 2,)
    swing_x: Array  # swings of the modes in every part by x, pairs, (parts, k, 2, n)
    swing_c: Array  # swings by c, (parts, k, 2, n_s)
    most: Array  # largest swing where rows are left out, in intervals 0, .., H - 1 and later, (H + 1, parts, k)
    near_x: Array  # hand and modes at all instants by x, (parts + 1, n_s + k, n)
    near_c: Array  # hand and modes by c, (parts + 1, n_s + k, n_s)
    way: Array  # states that were planned first, 0 behind them, (H + 1, n)
    way_c: Array  # deviations that were planned first, (H, n_s)
    box: Array  # of hand and modes about that way where rows are left out, (H + 1, n_s + k)
    tail_real: Array  # sum |tail x| <= 1: all that follows under u = K x is safe, (n, n)
    tail_imag: Array  # imaginary part of this matrix, (n, n)
    seen: Array  # displacement of the nodes by x, (nodes d, n)
    tube: Array  # how far each may be from the plan, (nodes d,) [m]
    start: Array  # x of the plan that a robot begins with, (n,)
    c: Array  # deviations of it, (H, n_s)
    price: float  # of a metre inside clearance and margin, on |c|^2 / 2 [1/m]
    T: Array  # x of a state x^ - x_bar of the controller, (n, N)
    A: Array  # state of the controller a tick later, (N, N)
    B: Array  # of a held load, (N, n_s)
    f: Array  # of the constant load, (N,)
    rest: Array  # state of the controller at the start of the plan, (N,)
    every: int  # ticks of an interval
    spread: Array  # what a row keeps for others by a unit of the modes beyond ``reach``, (m, k)
    instant: NDArray[np.int64]  # of a gap, (m,)
    reach: Array  # modes off the way that was planned first, with their swings between two instants, for which every
    # row keeps what others need, (H + 1, parts + 1, k)
    between: Array  # what a unit of each swing counts in it, (k,)

    @property
    def H(self) -> int:
        """Intervals of the horizon."""
        return len(self.first) - 2

    @property
    def n_s(self) -> int:
        """Freedoms of the hand."""
        return int(self.D.shape[1])

    @property
    def variables(self) -> int:
        """Unknowns of a program."""
        return self.n_s * self.H

    def arrays(self) -> dict[str, Any]:
        """All fields by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def of(cls, arrays: dict[str, Array]) -> Program:
        """From :meth:`arrays`. Raises KeyError: one is missing."""
        if "spread" not in arrays:  # saved when every row stood for itself alone
            most, leaves = arrays["most"], arrays["leaves"]
            none: dict[str, Any] = {"spread": np.zeros_like(leaves), "instant": np.zeros(len(leaves), dtype=np.int64)}
            reach = np.zeros((len(most), most.shape[1] + 1, most.shape[2]))
            arrays = {**arrays, **none, "reach": reach, "between": np.zeros(most.shape[2])}
        values: dict[str, Any] = {field.name: arrays[field.name] for field in fields(cls)}
        return cls(**values | {"price": float(values["price"]), "every": int(values["every"])})

    def rows(self, interval: int) -> NDArray[np.int64]:
        """Rows of an interval."""
        k = min(interval, self.H)
        return np.arange(self.first[k], self.first[k + 1])

    def count(self, interval: int) -> int:
        """Number of rows of the program that begins there."""
        return sum(len(self.rows(interval + k)) for k in range(self.H))

    @cached_property
    def _later(self) -> NDArray[np.bool_]:
        """Blocks of c that a row of interval k hears, (H, n_s H)."""
        return np.repeat(np.tri(self.H, dtype=bool), self.n_s, axis=1)

    def system(self, interval: int, x: Array) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int64]]:
        """G c <= h of the horizon that begins at an interval in state x, the row and the interval of each."""
        H, n_s = self.H, self.n_s
        rows = [self.rows(interval + k) for k in range(H)]
        at = np.repeat(np.arange(H), [len(r) for r in rows])
        index = np.concatenate(rows)
        G, h, state = np.zeros((len(index), n_s * H)), np.empty(len(index)), x
        begin = 0
        for k, own in enumerate(rows):
            end = begin + len(own)
            G[begin:end, : n_s * (k + 1)] = -self.coefficients[own, n_s * (H - 1 - k) :]
            h[begin:end] = self.a[own] @ state + self.free[own]
            state, begin = self.F @ state, end
        return G, h, index, at

    def solve(self, interval: int, x: Array, start: tuple[int, ...] = ()) -> tuple[Array, tuple[int, ...], int]:
        """The plan from x: c (H, n_s), the rows that hold it, the changes of the active set.

        Raises:
            InfeasibleError: no plan keeps all rows.
            ControlError: more than :data:`MOST_STEPS` changes.
        """
        G, h, _, _ = self.system(interval, x)
        found = nearest(G, h, [i for i in start if i < len(h)], MOST_STEPS)
        return found.x.reshape(self.H, self.n_s), found.active, found.steps

    def solve_soft(self, interval: int, x: Array) -> tuple[Array, float, int]:
        """The plan from x with least depth where gaps cannot be kept, by exact l1 prices: c, depth [m], changes.

        Raises:
            InfeasibleError: no plan keeps the limits of the hand.
            ControlError: more than :data:`MOST_STEPS` changes.
        """
        G, h, index, at = self.system(interval, x)
        gap = self.obstacle[index] != HARD
        pairs = self.obstacle[index] * self.H + at
        group = np.unique(pairs[gap], return_inverse=True)[1]
        found = nearest_soft(G[gap], h[gap], group, (G[~gap], h[~gap]), self.price, MOST_STEPS, self.price**2)
        depth = float(found.slack.max(initial=0.0))
        return found.x.reshape(self.H, self.n_s), depth if depth > SLIGHT else 0.0, found.steps

    def judge(self, interval: int, x: Array, c: Array) -> str:
        """Why the plan c (H, n_s) from x is not certain to keep every gap and limit for ever; empty where it is."""
        for k in range(self.H):
            j, now = min(interval + k, self.H), c[k]
            off = self.near_x @ (x - self.way[j]) + self.near_c @ (now - self.way_c[j] if j < self.H else now)
            if not (np.abs(off) <= self.box[j]).all():
                return "it leaves the box about the first plan in which rows were left out"
            swings = octagon(self.swing_x @ x + self.swing_c @ now)
            if not (swings <= self.most[j]).all():
                return "the tissue swings more than where rows were left out"
            own = self.rows(interval + k)
            pairs = self.part[own]
            bend = np.maximum(
                (self.leaves[own] * swings[pairs[:, 0]]).sum(axis=1),
                (self.leaves[own] * swings[pairs[:, 1]]).sum(axis=1),
            )
            bend = np.maximum(bend + self.along[own] @ (self.K @ x + self.L @ now), 0.0)
            swung = np.maximum(swings[[0, *range(len(swings))]], swings[[*range(len(swings)), -1]])
            beyond = np.maximum(np.abs(off[:, self.n_s :]) + self.between * swung - self.reach[j], 0.0)
            bend += (self.spread[own] * beyond[self.instant[own]]).sum(axis=1)
            left = self.a[own] @ x + self.coefficients[own, -self.n_s :] @ now + self.exact[own] - bend
            soft = self.obstacle[own] != HARD
            if not (left[~soft] >= -KEEPS).all():
                return "a limit of the hand is exceeded"
            if not (left[soft] >= 0).all():
                return "between two instants a node may come nearer than the clearance"
            x = self.F @ x + self.D @ now
        if not float(np.abs(self.tail_real @ x).sum() + np.abs(self.tail_imag @ x).sum()) <= 1:
            return "behind the horizon the body or the hand may break its limits"
        return ""


def octagon(pair: Array) -> Array:
    """Bound on the length of the pairs along the last axis, at most 8.3 % above it and without a root."""
    size = np.abs(pair)
    return np.asarray(size.max(axis=-1) + (np.sqrt(2.0) - 1) * size.min(axis=-1))
