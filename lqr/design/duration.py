"""How long a closed loop runs, and what it may cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.lqr.design.feedback import Design
from softgrasp.lqr.plant.operators import outputs

SETTLED = 6.0  # time constants of the slower hand pole after which 0.3 % of the way are left
LONGEST = 20  # times the steps of the scene that a run without [control] may need to settle


@dataclass(frozen=True)
class LoopPlan:
    """How long the loop runs."""

    dt: float  # time step [s]
    steps: int  # number of time steps
    settle: float  # time after which a rigid body under this gain is at the target [s]
    note: str = ""  # why the scene's own end is not used, or that it is too early; else empty


def plan(design: Design, own_end: bool) -> LoopPlan:
    """Steps of the closed loop, from the poles of the hand alone: M_s q'' = K_s [q; q'].

    ``own_end``: keep the end of the scene; else use as many steps as the move needs.
    """
    scene, n_s = design.model.scene, design.problem.layout.n_s
    dt, steps = scene.time_end / scene.time.steps, scene.time.steps
    A = np.vstack([np.eye(n_s, 2 * n_s, n_s), np.linalg.solve(design.problem.M_s, design.gain.K_s)])
    slowest = -float(np.linalg.eigvals(A).real.max())
    settle = SETTLED / slowest if slowest > 0 else scene.time_end
    needed = int(np.ceil(settle / dt))
    if needed <= steps:
        return LoopPlan(dt, steps, settle)
    if own_end:
        note = f"the loop ends at t = {scene.time_end:g} s, but this gain needs about {settle:.2g} s; raise "
        return LoopPlan(dt, steps, settle, note + "time.end, or control.Q for a faster move")
    longer = min(needed, LONGEST * steps)
    note = f"the loop runs {longer} steps to t = {longer * dt:.3g} s; at t = {scene.time_end:g} s it would still move"
    return LoopPlan(dt, longer, settle, note)


def largest_cost(design: Design, plan: LoopPlan) -> float:
    """A thousand times the cost of the optimal loop and of no motion, summed. Collective."""
    y = outputs(design.problem, design.error)[:, 0]
    return 1e3 * (design.gain_check.optimal + plan.dt * plan.steps * float(y @ design.problem.Q @ y))
