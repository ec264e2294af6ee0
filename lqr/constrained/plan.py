"""Plans past obstacles: a sequence of problems of least distance, each with one half-space per interval and obstacle.

The half-planes of one plan separate body and obstacle, so that it is feasible for the half-planes drawn from it: costs
fall from round to round and every round is safe. Both sides of an obstacle on the way are tried, in space four.
That of an obstacle on a known path moves with it, n.(y - s(t)) >= h(n).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice, product

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.errors import ResourceError
from softgrasp.fem.obstacles.shapes import HalfSpace, Shape
from softgrasp.fem.petsc import Array
from softgrasp.fem.resources import free_memory, size_text
from softgrasp.lqr.constrained.horizon import HeldPlant, Horizon
from softgrasp.lqr.constrained.rows import bends, both_ends, broken, follow, gap_rows, limit_rows, tail_level, turned
from softgrasp.lqr.constrained.separation import past, separate
from softgrasp.lqr.constrained.task import Task, after_paths, at_target, free_ways, instants, path_turns, seen_by
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.program.least_distance import InfeasibleError, nearest, nearest_soft

ROUNDS = 20  # of half-planes; four to eight are usual
SETTLED = 2e-4  # of the cost of obstacles, between two rounds
ROOM = 1.05  # of the bends of the last round that the next one keeps
MOST_WAYS = 8  # sides of obstacles that are tried
LONGEST = 4  # times the first horizon
MOST_FOLLOWED = 5000  # intervals behind the horizon that are followed
COPIES = 7  # of the rows, at the peak of a program that may exceed its gaps; 3.5 of one that keeps them
PRICE = 20.0  # of a metre inside an obstacle, over the mean cost of a metre of the way
SLIGHT = 1e-10  # [m]: a slack that is rounding of the price
ROUNDING = 1e-10  # of the extent of the body [1]: what every row keeps beyond its bound
TIGHT = 1e-9  # of the extent of the body [1]: a row so near to its bound holds the plan


@dataclass(frozen=True)
class Plan:
    """Inputs that lead to the target past the obstacles."""

    horizon: Horizon  # reduced plant and number of intervals
    task: Task  # what it was made for
    c: Array  # deviations from the gain of the grid, (n_s H,)
    normals: Array  # of the half-plane of every obstacle and interval, (obstacles, H, d)
    slack: Array  # depth inside clearance and margin, by obstacle and interval [m], (obstacles, H)
    bend: float  # largest margin of a node with an active gap, between two instants and for the square of the angle [m]
    multiplier: float  # largest dJ of a metre of one gap at one instant, twice its multiplier in |c|^2 / 2 [1/m]
    active: tuple[int, ...]  # rows that hold the plan, empty where gaps are not kept
    costs: tuple[float, ...]  # |c|^2 of the rounds
    steps: int  # changes of the active set in all rounds
    sides: tuple[int, ...]  # on which the obstacles on the way are passed, 1: left of it
    tried: tuple[tuple[tuple[int, ...], float, float], ...]  # sides, cost |c|^2 and largest slack of every way
    untried: int  # ways that were not tried
    gap: float  # least certified gap to the clearance, at every time of horizon and tail [m]; inf without obstacles
    followed: int  # intervals behind the horizon that were followed under u = K x
    unsafe: int  # intervals that the horizon needs more to be safe behind it; 0 where it is

    @property
    def certified(self) -> bool:
        """Whether the full linear plant keeps every gap for ever, in exact arithmetic and time."""
        return not self.reason

    @property
    def reason(self) -> str:
        """Why it is not certified; empty where it is."""
        if self.slack.max(initial=0.0) > 0 and not self.gap >= 0:
            return f"the body is inside clearance and margin for {self.outside:.4g} s, {self.depth:.3g} m at most"
        if not self.gap >= 0 and self.unsafe:
            return (
                f"within the horizon of {self.horizon.steps} intervals, or in the {self.unsafe} behind it, the body "
                f"may come {-self.gap:.2g} m nearer than the clearance"
            )
        if not self.gap >= 0:
            return f"between two instants the body may come {-self.gap:.2g} m nearer than the clearance"
        if not self.task.bounded:
            return "control.constraints.margin is a number, no bound on what the reduced plant leaves out"
        if self.unsafe:
            return f"behind the horizon of {self.horizon.steps} intervals the body or the hand may break its limits"
        return ""

    @property
    def depth(self) -> float:
        """Largest depth inside clearance and margin [m]."""
        return float(self.slack.max(initial=0.0))

    @property
    def outside(self) -> float:
        """Time of the intervals that have an instant inside clearance and margin [s]."""
        return self.horizon.plant.grid * int((self.slack > 0).any(axis=0).sum())

    @property
    def inputs(self) -> Array:
        """Inputs u of every interval [N], (H, n_s)."""
        return self.horizon.input(self.task.start, self.c) + self.task.u_bar

    @property
    def free_cost(self) -> float:
        """x_0'P x_0, the cost of held inputs without obstacles and limits."""
        return float(self.task.start @ self.horizon.plant.P @ self.task.start)

    @property
    def cost(self) -> float:
        """J of the reduced plant, for ever."""
        return self.free_cost + float(self.c @ self.c)

    def body(self) -> Array:
        """Places of the nodes at all instants [m], (H, parts + 1, nodes, d)."""
        return places(self.horizon, self.task, self.c)


def places(horizon: Horizon, task: Task, c: Array) -> Array:
    """Nodes of the reduced plant at all instants of a plan [m], (H, parts + 1, nodes, d)."""
    return np.asarray(task.places + np.einsum("jdn,kin->kijd", horizon.plant.Y, horizon.state(task.start, c)))


def make_plan(plant: HeldPlant, task: Task, steps: int, longest: int | None = None) -> Plan:
    """The cheapest plan of all ways that are tried, on a horizon that is made longer until the tail is safe.

    Args:
        plant: reduced plant on the grid.
        task: start, obstacles and limits.
        steps: intervals of the first horizon.
        longest: intervals of the last one; None for :data:`LONGEST` times the first.

    Raises:
        ControlError: the target keeps no gap or limit, or the limits of the hand cannot be kept.
        ResourceError: the quadratic program does not fit in the memory that is free now.
    """
    automatic = longest is None
    longest = LONGEST * steps if longest is None else longest
    steps = after_paths(plant, task, steps, longest)
    if automatic:
        _check_in_time(plant, task, longest * plant.grid)
    while True:
        level = tail_level(plant, at_target(task, steps * plant.grid), task.limits, task.u_bar, task.arms, task.angle)
        if not level > 0:
            raise ControlError("the steady force at the target is not below its limit; raise control.constraints.force")
        _check_memory(plant, task, steps)
        plan = _cheapest(Horizon(plant, steps), task, level)
        # where the longest plan ends before what follows is safe, a plan that keeps no gap is not worth its time
        if not plan.unsafe or steps >= longest or (plan.gap < 0 and steps + plan.unsafe > longest):
            return plan
        steps = min(longest, steps + plan.unsafe)


def _check_memory(plant: HeldPlant, task: Task, steps: int) -> None:
    """Raises ResourceError where the rows of a horizon do not fit; they grow with the square of its intervals."""
    rows = (plant.parts + 1) * (len(task.shapes) * len(task.places) + plant.N) + 6 * plant.n_s  # of an interval
    needed, free = COPIES * 8.0 * rows * plant.n_s * float(steps) ** 2, free_memory()
    if needed > free:
        raise ResourceError(
            f"a plan of {steps:.6g} intervals would need about {size_text(needed)} of memory, and {size_text(free)} is "
            "free; lower control.constraints.horizon or parts, or raise control.constraints.grid"
        )


def _check_in_time(plant: HeldPlant, task: Task, longest: float) -> None:
    """Raises ControlError where the hand cannot come to rest at its target in ``longest`` seconds."""
    n_s, speed = plant.n_s, np.inf if task.limits.speed is None else task.limits.speed
    least, way = 0.0, np.abs(task.start[:n_s])
    if task.limits.force is not None:
        fastest = np.abs(plant.B[n_s : 2 * n_s]) @ (task.limits.force + np.abs(task.u_bar))
        least = float((2 * np.sqrt(way / fastest)).max())
    least = max(least, float((way[: plant.Y.shape[1]] / speed).max()))
    if least > longest:
        raise ControlError(
            f"within its limits the hand needs at least {least:.4g} s to the target, and a plan lasts {longest:.4g} s "
            "at most; raise control.constraints.speed or force, or set control.constraints.horizon in seconds"
        )


def _cheapest(horizon: Horizon, task: Task, level: float) -> Plan:
    """All sides of the obstacles on the way."""
    free = places(horizon, task, np.zeros(horizon.plant.n_s * horizon.steps))
    seen = [seen_by(horizon, task, i, free) for i in range(len(task.shapes))]
    first = [_normals(shape, body) for shape, body in zip(task.shapes, seen, strict=True)]
    moving = [i for i, shape in enumerate(task.shapes) if not isinstance(shape, HalfSpace)]
    on_way = [i for i in moving if _left(task.shapes[i], task, first[i], seen[i]).min() < 0]
    still, d = task.places - task.places.mean(axis=0), task.places.shape[1]
    ways = _ways(d, len(on_way))
    plans: list[Plan] = []
    for sides in ways:
        normals = list(first)
        for i, side in zip(on_way, sides, strict=True):
            normals[i] = past(task.shapes[i], seen[i][:, 0].mean(axis=1), still, side)
        plans.append(_rounds(horizon, task, np.array(normals).reshape(-1, horizon.steps, d), level, sides))
    best = min(plans, key=lambda p: (p.depth > 0, p.depth if p.depth > 0 else float(p.c @ p.c)))
    tried = tuple((p.sides, float(p.c @ p.c), p.depth) for p in plans)
    return replace(best, tried=tried, untried=(2 * (d - 1)) ** len(on_way) - len(plans))


def _ways(d: int, count: int) -> list[tuple[int, ...]]:
    """The first sides of obstacles on the way, at most :data:`MOST_WAYS`: each obstacle is passed on every side."""
    sides = (1, -1, 2, -2)[: 2 * (d - 1)]
    turns = product(range(len(sides)), repeat=max(count - 1, 0))
    ways = (tuple(sides[(k + t) % len(sides)] for t in (0, *turn)) for turn in turns for k in range(len(sides)))
    return list(islice(ways, MOST_WAYS)) if count else [()]


def _left(shape: Shape, task: Task, normals: Array, body: Array) -> Array:
    """What clearance and margin leave of the gap of every node at all instants, (H, parts + 1, nodes)."""
    return np.asarray(free_ways(shape, task, normals)[:, None] + np.einsum("kd,kijd->kij", normals, body - task.places))


def _normals(shape: Shape, body: Array) -> Array:
    """Of the half-spaces that keep the body of every interval farthest off, (H, d)."""
    return np.array([separate(shape, at.reshape(-1, at.shape[-1]))[0] for at in body])


def _rounds(horizon: Horizon, task: Task, normals: Array, level: float, sides: tuple[int, ...]) -> Plan:
    """Half-planes, plan, half-planes from the plan, until nothing changes."""
    c, best = np.zeros(horizon.plant.n_s * horizon.steps), None
    active: tuple[int, ...] = ()
    hard = limit_rows(horizon, task.start, task.limits, task.u_bar)
    costs: list[float] = []
    steps = 0
    for _ in range(ROUNDS):
        G, h, group = _rows(horizon, task, normals, c)
        c, slack, multipliers, active, more = _solve(G, h, group, hard, active, _price(horizon, task))
        steps, slack = steps + more, slack.reshape(len(normals), horizon.steps)
        costs.append(float(c @ c))
        plan = _judged(horizon, task, c, normals, slack, multipliers, level)
        plan = replace(plan, active=active, sides=sides)
        if best is None or _better(plan, best):
            best = plan
        elif best.gap >= 0 and plan.gap >= 0:  # other half-spaces, and no gain
            break
        if len(costs) > 1 and abs(costs[-1] - costs[-2]) <= SETTLED * costs[-1] and (plan.gap >= 0 or plan.depth > 0):
            break
        body = plan.body()
        normals = np.array([_normals(s, seen_by(horizon, task, i, body)) for i, s in enumerate(task.shapes)])
        normals = normals.reshape(-1, horizon.steps, body.shape[-1])
    assert best is not None
    return replace(best, costs=tuple(costs), steps=steps)


def quadratic_program(plan: Plan) -> tuple[Array, Array]:
    """G c <= h of all gaps and limits with the half-planes and the bends of a plan: one more round."""
    G, h, _ = _rows(plan.horizon, plan.task, plan.normals, plan.c)
    task = plan.task
    hard = limit_rows(plan.horizon, task.start, task.limits, task.u_bar)
    return np.vstack([G, hard[0]]), np.concatenate([h, hard[1]])


def _better(plan: Plan, other: Plan) -> bool:
    """Certified gaps first, then less depth, then less cost."""
    return (not plan.gap >= 0, plan.depth, float(plan.c @ plan.c)) <= (
        not other.gap >= 0, other.depth, float(other.c @ other.c),
    )  # fmt: skip


def _price(horizon: Horizon, task: Task) -> float:
    """Of a metre inside an obstacle [1/m]."""
    if task.penalty is not None:
        return task.penalty
    way = float(np.linalg.norm(task.start[: horizon.plant.n_s]))
    return PRICE * float(task.start @ horizon.plant.P @ task.start) / way


def _rows(horizon: Horizon, task: Task, normals: Array, c: Array) -> tuple[Array, Array, NDArray[np.int64]]:
    """Rows of all obstacles with room for the bends of the plan c, and the group of each: its obstacle and interval."""
    rows, right = [np.zeros((0, len(c)))], [np.zeros(0)]
    x, u = horizon.state(task.start, c), horizon.input(task.start, c)
    off = _by_angle(horizon.plant, task, x, u)
    rounding = ROUNDING * task.size  # so that no gap of the plan is below zero by it
    for i, (shape, n) in enumerate(zip(task.shapes, normals, strict=True)):
        margin = ROOM * (both_ends(bends(horizon.plant, x, u, n, path_turns(horizon, task, i, n))) + off)
        moved = np.einsum("kd,kid->ki", n, task.shifts(i, instants(horizon)))[:, :, None]
        G, h = gap_rows(horizon, task.start, n, free_ways(shape, task, n)[:, None] - moved - margin - rounding)
        rows.append(G)
        right.append(h)
    h = np.concatenate(right)
    count = len(normals) * horizon.steps
    group = np.repeat(np.arange(count), len(h) // max(count, 1))
    return np.vstack(rows), h, group


def _by_angle(plant: HeldPlant, task: Task, x: Array, u: Array) -> Array | float:
    """Bound on the distance of nodes from their places by small angles, (H, parts + 1, nodes) [m]."""
    return 0.0 if task.angle is None else turned(plant, x, u, np.asarray(task.arms), task.angle)


def _solve(
    G: Array, h: Array, group: NDArray[np.int64], hard: tuple[Array, Array], active: tuple[int, ...], price: float
) -> tuple[Array, Array, Array, tuple[int, ...], int]:
    """Hard rows, and where no c keeps them soft ones: c, slack, multipliers of the gaps, active rows, steps."""
    count = int(group.max(initial=-1)) + 1
    try:
        found = nearest(np.vstack([G, hard[0]]), np.concatenate([h, hard[1]]), active)
        return found.x, np.zeros(count), found.multipliers[: len(h)], found.active, found.steps
    except InfeasibleError:
        try:
            soft = nearest_soft(G, h, group, hard, price / 2)  # which has |c|^2 / 2
        except InfeasibleError:
            raise ControlError(
                "no plan keeps the limits of the hand; raise force, speed or jump of control.constraints"
            ) from None
        return soft.x, np.where(soft.slack > SLIGHT, soft.slack, 0.0), soft.multipliers[: len(h)], (), soft.steps


def _judged(
    horizon: Horizon, task: Task, c: Array, normals: Array, slack: Array, multipliers: Array, level: float
) -> Plan:
    """A plan with what is certain of it."""
    plant, H = horizon.plant, horizon.steps
    end = horizon.states[0][-1] @ task.start + horizon.states[1][-1] @ c
    x, u = follow(plant, end, level, MOST_FOLLOWED)
    x, u = np.concatenate([horizon.state(task.start, c), x]), np.concatenate([horizon.input(task.start, c), u])
    body = task.places + np.einsum("jdn,kin->kijd", plant.Y, x)
    unsafe = np.zeros(len(u), dtype=bool)
    if len(u) - H == MOST_FOLLOWED:
        unsafe[-1] = True
    gap, bend = np.inf, 0.0
    target, off = at_target(task, H * plant.grid), _by_angle(plant, task, x, u)
    for i, (shape, ahead, (normal, _)) in enumerate(zip(task.shapes, normals, target, strict=True)):
        n = np.concatenate([ahead, np.tile(normal, (len(u) - H, 1))])
        turns = path_turns(horizon, task, i, n)
        if len(u) > H and not isinstance(turns, float):
            turns[H:] = 0.0  # it rests, or goes away along a line
        own = both_ends(bends(plant, x, u, n, turns)) + off
        left = _left(shape, task, n, seen_by(horizon, task, i, body)) - own
        gap = min(gap, float(left.min()))
        unsafe |= (left < 0).any(axis=(1, 2))
        holds = left[:H] <= (ROOM - 1) * own[:H] + TIGHT * task.size
        bend = max(bend, float(own[:H][holds].max(initial=0.0)))
    unsafe |= broken(plant, x, u, task.limits, task.u_bar)
    last = np.flatnonzero(unsafe[H:])
    more = 0 if len(last) == 0 else int(last[-1]) + 1
    if task.limits.jump is not None and (np.abs(plant.K @ x[-1, -1] - u[-1]) > task.limits.jump).any():
        more = len(u) - H + 1  # the first interval of the tail
    return Plan(
        horizon, task, c, normals, slack, bend, 2 * float(multipliers.max(initial=0.0)), (),
        (), 0, (), (), 0, gap, len(u) - H, more,
    )  # fmt: skip
