"""The program of a plan for the time after it: rows by state and lag, those left out that cannot be met near its way.

A row is left out where the box about the first plan and the largest swings in it cannot use up what the plan leaves of
it; :meth:`softgrasp.lqr.program.program.Program.judge` takes no plan that leaves either, so that none of them is ever
broken. Rows that others imply are left out too, see :mod:`softgrasp.lqr.constrained.thin`. What follows the horizon is
safe where sum_m b_m |w_m| <= 1 for x = V w in the modes of u = K x, since |r F^t x| <= sum_m |r V_m| |w_m|: b_m is the
largest |r V_m| over what row r has left at the target.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.petsc import Array
from softgrasp.lqr.constrained.horizon import HeldPlant, held
from softgrasp.lqr.constrained.plan import ROOM, Plan, _price
from softgrasp.lqr.constrained.rows import Limits, _pace, both_ends, follow, swings
from softgrasp.lqr.constrained.task import at_target, free_ways, instants, path_turns
from softgrasp.lqr.constrained.thin import Order, coarse_to_fine, thinned
from softgrasp.lqr.loop.controller import Controller
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.program.program import HARD, Program, octagon

BOX = 0.05  # of the extent of the body: way of the hand from the first plan where rows are left out
SHARE = 0.5  # of the largest value of a mode in it: the same of the tissue
STILL = 3e-3  # of the extent: the same, and bend, of a mode that the first plan hardly moves
FASTER = 1.0  # times the largest swing of a mode in it: by how much it may swing more
FREER = 3.0  # times the largest force of the first plan, where the scene limits none
DIGITS = 1e-10  # of the extent: what a row keeps beyond its bound, so that rounding breaks none
GIVEN = 0.02  # of the gap of the first plan: what a row may keep for others that it stands for
NEARBY = 0.05  # of the box, and of the swings beyond the planned ones: where this is enough for them
ROUNDS = 4  # of the first plan under its own rows
TAIL = 50  # intervals behind the horizon whose swings the rows at the target have room for
ROUNDING = 1e-6  # of the extent: a deviation that the steps of another rule make


@dataclass(frozen=True)
class Ticks:
    """The controller's own plant over a tick."""

    A: Array  # state a tick later, (N, N)
    B: Array  # of a held load, (N, n_s)
    f: Array  # of the constant load, (N,)


def carried_ticks(controller: Controller) -> Ticks:
    """A tick of a hand that hears no tissue, exact, and of the tissue as a controller without observer carries it."""
    plant, n_s, period = controller.plant, controller.n_s, controller.period
    hand = slice(2 * n_s)
    solved = np.linalg.solve(plant.E[hand, hand], np.column_stack([plant.A[hand, hand], plant.B[hand], plant.f[hand]]))
    moved, loads = held(solved[:, : 2 * n_s], solved[:, 2 * n_s :], period)
    step, accelerated, _, constant = controller.model
    A, B, f = np.zeros_like(plant.A), np.zeros_like(plant.B), constant.copy()
    A[hand, hand], B[hand] = moved, loads[:, :-1]
    faster = moved[n_s:] - np.eye(n_s, 2 * n_s, n_s)
    A[2 * n_s :, hand], A[2 * n_s :, 2 * n_s :] = accelerated @ faster, step
    B[2 * n_s :] = accelerated @ loads[n_s:, :-1]
    return Ticks(A, B, np.concatenate([loads[:, -1], f + accelerated @ loads[n_s:, -1]]))


@dataclass(frozen=True)
class _Flow:
    """The plan's plant at the instants of an interval, with the last input where jumps are limited."""

    plant: HeldPlant
    jump: bool

    @property
    def n(self) -> int:
        return self.plant.N + self.plant.n_s * self.jump

    def wide(self, rows: Array) -> Array:
        """Rows on the state, for the one with the input."""
        return np.concatenate([rows, np.zeros((*rows.shape[:-1], self.n - rows.shape[-1]))], axis=-1)

    def long(self, drive: Array, gain: Array) -> Array:
        """What a deviation or a state adds to the state, and to the input."""
        return np.vstack([drive, gain]) if self.jump else drive


@dataclass(frozen=True)
class _Way:
    """The first plan, the box about it and the swings in it."""

    x: Array  # states at the instants, (H, parts + 1, N)
    c: Array  # deviations, (H, n_s)
    u: Array  # inputs, (H, n_s)
    near: Array  # states that are displacements: hand and modes, (n_s + k,)
    boxes: Array  # of them, (H + 1, n_s + k)
    planned: Array  # swings of the plan, in the last row those behind it, (H + 1, parts, k)
    most: Array  # largest swings, (H + 1, parts, k)
    pushed: Array  # largest inputs behind the horizon, (n_s,)


def _way(plan: Plan, chord: float) -> _Way:
    plant, task, horizon = plan.horizon.plant, plan.task, plan.horizon
    n_s, H, extent = plant.n_s, horizon.steps, plan.task.size
    x, u = horizon.state(task.start, plan.c), horizon.input(task.start, plan.c)
    near = np.r_[0:n_s, 2 * n_s : 2 * n_s + len(plant.tissue.omega)]
    T, W = swings(plant)

    def swung(states: Array, inputs: Array) -> Array:
        pairs = np.einsum("men,kin->kime", T, states[:, :-1]) + np.einsum("mes,ks->kme", W, inputs)[:, None]
        return octagon(pairs)

    behind, pushed = follow(plant, x[-1, -1], -1.0, TAIL)
    planned = np.concatenate([swung(x, u), swung(behind, pushed).max(axis=0)[None]])
    seen = np.abs(plant.tissue.seen).max(axis=(0, 1))
    seen[seen == 0] = 1.0  # nodes that the hand holds see no mode: any width is as good
    still = STILL * extent / np.sqrt(len(seen)) / seen
    moves = np.abs(x[..., near[n_s:]]).max(axis=(0, 1))
    box = np.concatenate([np.full(n_s, BOX * extent), np.maximum(SHARE * moves, still)])
    boxes = np.vstack([np.tile(box, (H, 1)), box + np.abs(behind[..., near]).max(axis=(0, 1))])
    most = planned + np.maximum(FASTER * planned.max(axis=(0, 1)), still / (chord * _pace(plant)))
    return _Way(x, plan.c.reshape(H, n_s), u, near, boxes, planned, most, np.abs(pushed).max(axis=0))


def make_program(plan: Plan, T: Array, x_bar: Array, ticks: Ticks, period: float) -> Program:
    """What a robot needs to plan again from a plan that keeps everything.

    Args:
        plan: the first plan.
        T: state of the plan's plant, from the target, by that of the controller, (N, N_c).
        x_bar: state of the controller at the target, (N_c,).
        ticks: the controller's own plant.
        period: length of a tick [s].

    Raises ControlError: the plan does not keep everything, or an interval is no multiple of the tick.
    """
    plant, limits = plan.horizon.plant, plan.task.limits
    if plan.depth > 0 or not plan.gap >= 0 or plan.unsafe:
        raise ControlError(f"only a plan that keeps everything is made again online; {plan.reason}")
    every = round(plant.grid / period)
    if abs(every * period - plant.grid) > 1e-9 * plant.grid:
        raise ControlError(
            f"control.constraints.grid = {plant.grid:g} s must be a multiple of the tick of {period:g} s of a loop "
            "that follows a plan"
        )
    force, reason = limits.force, ""
    if force is None:
        force = FREER * np.abs(plan.inputs).max(axis=0)
    order = coarse_to_fine(plan.task.places)
    for i in range(ROUNDS):  # the room between two instants is that of the plan before
        program = _program(plan, T, x_bar, ticks, every, force, order, NEARBY if i < ROUNDS // 2 else 1.0)
        begins = replace(program, c=program.solve(0, program.start)[0])
        reason = begins.judge(0, program.start, begins.c)
        if not reason:
            return begins
        plan = replace(plan, c=begins.c.ravel())
    raise ControlError(f"the plan is not safe with the coarser bounds of a program online: {reason}")


def _program(
    plan: Plan, T: Array, x_bar: Array, ticks: Ticks, every: int, force: Array, order: Order, nearby: float
) -> Program:
    """The program with what a plan needs between two instants; ``nearby``: see :data:`NEARBY`."""
    plant, task, H, limits = plan.horizon.plant, plan.task, plan.horizon.steps, plan.task.limits
    flow, n_s = _Flow(plant, limits.jump is not None), plant.n_s
    A, B = (np.stack(parts) for parts in zip(*plant.held, strict=True))
    flows, drives = flow.wide(A + B @ plant.K), B @ plant.L  # (parts + 1, N, n), (parts + 1, N, n_s)
    F, D = flow.long(flows[-1], flow.wide(plant.K)), flow.long(drives[-1], plant.L)
    chord = (plant.grid / plant.parts) ** 2 / 8
    rows = _Rows(flow, H, flows, drives, chord, DIGITS * task.size, order, nearby)
    first_way = _way(plan, rows.chord)
    first = _all_rows(rows, plan, first_way, force, F, D)
    a, d, free, exact, obstacle, part, leaves, along, spread, instant = rows.arrays()
    boxes = zip(first_way.boxes, first_way.planned, first_way.most, strict=True)
    reach = np.stack([rows.reach(*box)[0] for box in boxes])
    real, imag = _tail(plan, flow, flows, F, force, limits)
    lags, power = [d], a
    for _ in range(H - 1):
        lags.append(power @ D)
        power = power @ F
    swing, driven = swings(plant)
    swing_x, swing_c = (
        np.einsum("men,inr->imer", swing, x[:-1]) + np.einsum("mes,sr->mer", driven, u)
        for x, u in ((flows, flow.wide(plant.K)), (drives, plant.L))
    )
    way = np.vstack([flow.wide(first_way.x[:, 0]), np.zeros((1, flow.n))])
    if flow.jump:  # u of the interval before
        way[1:H, plant.N :] = first_way.u[:-1]
    tube = np.broadcast_to(task.noise, task.places.shape) + ROUNDING * task.size
    rest = x_bar.copy()
    rest[:n_s] += task.start[:n_s]
    return Program(
        F, D, flow.wide(plant.K), plant.L, a, np.hstack(lags[::-1]), free, exact, obstacle, part, leaves, along,
        first, swing_x, swing_c, first_way.most,
        flows[:, first_way.near], drives[:, first_way.near], way, first_way.c, first_way.boxes,
        real, imag, flow.wide(plant.Y.reshape(-1, plant.N)), tube.ravel(), way[0],
        first_way.c, _price(plan.horizon, task) / 2, T, ticks.A, ticks.B, ticks.f, rest, every,
        spread, instant, reach, chord * _pace(plant),
    )  # fmt: skip


def _all_rows(rows: _Rows, plan: Plan, way: _Way, force: Array, F: Array, D: Array) -> NDArray[np.int64]:
    """Rows of every interval and of all later ones; the first of each, (H + 2,)."""
    plant, task, H = plan.horizon.plant, plan.task, plan.horizon.steps
    first, target, largest = [0], at_target(task, H * plant.grid), force + np.abs(task.u_bar)
    ends = np.vstack([instants(plan.horizon), np.full((1, plant.parts + 1), H * plant.grid)])
    turns = [path_turns(plan.horizon, task, o, n) for o, n in enumerate(plan.normals)]
    for k in range(H + 1):
        for o, (shape, (at_end, _)) in enumerate(zip(task.shapes, target, strict=True)):
            n = plan.normals[o, k] if k < H else at_end
            x = way.x[k] if k < H else np.zeros_like(way.x[0])
            moved = x @ np.einsum("d,jdn->jn", n, plant.Y).T
            inputs = way.u[k] if k < H else way.pushed
            free = free_ways(shape, task, n[None])[0] - (task.shifts(o, ends[k]) @ n)[:, None]
            if k < H:  # later it rests, or goes away along a line
                free = free - rows.chord * both_ends(np.broadcast_to(turns[o], (H, plant.parts))[k : k + 1, :, None])[0]
            rows.gaps(
                o, n, free, moved, way.planned[k], way.most[k], way.boxes[k], way.near,
                inputs, largest,
            )  # fmt: skip
        rows.limits(force, task.limits, task.u_bar, F, D)
        first.append(rows.count)
    return np.array(first, dtype=np.int64)


class _Rows:
    """Rows of a program as they are made."""

    def __init__(
        self, flow: _Flow, H: int, flows: Array, drives: Array, chord: float, slack: float, order: Order, nearby: float
    ) -> None:
        self.slack, self.order, self.nearby = slack, order, nearby
        self.flow, self.H, self.flows, self.drives, self.chord = flow, H, flows, drives, chord
        self.parts: list[tuple[Array, ...]] = []
        self.count = 0

    def _add(self, *columns: Array) -> None:
        self.parts.append(columns)
        self.count += len(columns[0])

    def gaps(
        self, o: int, n: Array, free: Array, moved: Array, planned: Array, most: Array, box: Array,
        near: Array, inputs: Array, largest: Array,
    ) -> None:  # fmt: skip
        """Rows of an obstacle in an interval that the box can reach.

        ``free``: at every instant, (parts + 1, nodes); ``moved``: way of the nodes along n in the first plan, the same.
        """
        plant = self.flow.plant
        n_s = plant.n_s
        Y = np.einsum("d,jdn->jn", n, plant.Y)
        leaves = self.chord * np.abs(np.einsum("d,jdm->jm", n, plant.tissue.seen)) * _pace(plant)
        along = self.chord * (n @ plant.B[n_s : 2 * n_s])
        need = both_ends(np.maximum(planned @ leaves.T + along @ inputs, 0.0)[None])[0]  # (parts + 1, nodes)
        worst = both_ends((most @ leaves.T + np.abs(along) @ largest)[None])[0]
        reached = free + moved - worst < np.abs(Y[:, near]) @ box
        if not reached.any():
            return
        reach, whole = self.reach(box, planned, most)
        left = free + moved
        allowed = GIVEN * np.maximum(left.min(axis=1), 0.0)
        thin = thinned(self.order, left, Y[:, near[n_s:]], reach, whole, allowed)
        at_most = thin.least + np.einsum("iak,ik->ia", thin.spread, whole - reach)
        reached = (left - worst)[:, thin.nodes] - at_most < (np.abs(Y[:, near]) @ box)[thin.nodes]
        i, a = np.nonzero(thin.stays & reached)
        j, last = thin.nodes[a], plant.parts - 1
        self._add(
            np.einsum("mn,mnr->mr", Y[j], self.flows[i]), np.einsum("mn,mns->ms", Y[j], self.drives[i]),
            free[i, j] - ROOM * need[i, j] - thin.least[i, a] - self.slack, free[i, j] - thin.least[i, a],
            np.full(len(i), o),
            np.column_stack([np.maximum(i - 1, 0), np.minimum(i, last)]),
            leaves[j], np.broadcast_to(along, (len(i), n_s)), thin.spread[i, a], i,
        )  # fmt: skip

    def reach(self, box: Array, planned: Array, most: Array) -> tuple[Array, Array]:
        """Nearby and largest z of :mod:`softgrasp.lqr.constrained.thin` in an interval, (parts + 1, k).

        ``box``: of hand and modes, (n_s + k,); ``planned``, ``most``: swings, (parts, k).
        """
        plant, share = self.flow.plant, self.nearby
        modes, unit = box[plant.n_s :], self.chord * _pace(plant)
        swung = both_ends(np.stack([unit * (planned + share * (most - planned)), unit * most]))
        return share * modes + swung[0], modes + swung[1]

    def limits(self, force: Array, limits: Limits, u_bar: Array, F: Array, D: Array) -> None:
        """Rows of force, speed and jump in an interval."""
        plant, flow = self.flow.plant, self.flow
        n_s, k, K = plant.n_s, len(plant.tissue.omega), flow.wide(plant.K)
        sides: list[tuple[Array, Array, Array, Array]] = [(K, plant.L, force + u_bar, force - u_bar)]
        if limits.speed is not None:
            v, most = slice(n_s, 2 * n_s), np.full(n_s, limits.speed)
            sides.append((F[v], D[v], most, most))
        if limits.jump is not None:
            before, most = np.zeros_like(K), np.full(n_s, limits.jump)
            before[:, plant.N :] = np.eye(n_s)
            sides.append((K - before, plant.L, most, most))
        for a, d, below, above in sides:
            for sign, free in ((1.0, below), (-1.0, above)):
                self._add(
                    sign * a, sign * d, free, free, np.full(n_s, HARD), np.zeros((n_s, 2), dtype=np.int64),
                    np.zeros((n_s, k)), np.zeros((n_s, n_s)), np.zeros((n_s, k)), np.zeros(n_s, dtype=np.int64),
                )  # fmt: skip

    def arrays(self) -> list[Any]:
        """All of them, column by column."""
        return [np.concatenate(column) for column in zip(*self.parts, strict=True)]


def _tail(plan: Plan, flow: _Flow, flows: Array, F: Array, force: Array, limits: Limits) -> tuple[Array, Array]:
    """Real and imaginary part of diag(b) V^-1, (n, n)."""
    plant, task = plan.horizon.plant, plan.task
    n_s = plant.n_s
    V = np.linalg.eig(F)[1]
    K = flow.wide(plant.K) @ V
    shown = flows @ V
    T, W = swings(plant)
    pairs = np.einsum("men,inr->imer", T, shown[:-1]) + np.einsum("mes,sr->mer", W, K)
    size = np.linalg.norm(pairs, axis=2) * _pace(plant)[None, :, None]  # (parts, modes, n)
    b = (np.abs(K) / (force - np.abs(task.u_bar))[:, None]).max(axis=0)
    for normal, free in at_target(task, plan.horizon.steps * plant.grid):
        rows = np.abs(np.einsum("d,jdn,inr->ijr", normal, plant.Y, shown))
        seen = np.abs(np.einsum("d,jdm->jm", normal, plant.tissue.seen))
        bend = np.einsum("jm,imr->ijr", seen, size) + np.abs(normal @ plant.B[n_s : 2 * n_s] @ K)
        bend = np.pad((plant.grid / plant.parts) ** 2 / 8 * bend, ((1, 1), (0, 0), (0, 0)))
        b = np.maximum(b, ((rows + np.maximum(bend[1:], bend[:-1])) / free[None, :, None]).max(axis=(0, 1)))
    if limits.speed is not None:
        b = np.maximum(b, (np.abs(shown[-1][n_s : 2 * n_s]) / limits.speed).max(axis=0))
    if limits.jump is not None:
        b = np.maximum(b, (np.abs(K - V[plant.N :]) / limits.jump).max(axis=0))
    inverse = b[:, None] * np.linalg.inv(V)
    return inverse.real, inverse.imag
