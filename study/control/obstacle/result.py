"""What ``softgrasp control`` finds of a plan, and its part of result.json."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from softgrasp.fem import AXES
from softgrasp.fem.petsc import Array
from softgrasp.lqr import PlannedControl
from softgrasp.lqr.design.constrained import FinitePlan
from softgrasp.lqr.program.replan import Outcome

ZERO = 1e-12  # of the largest coordinate: rounding of the mesh


def freedoms(planned: PlannedControl) -> list[tuple[str, bool]]:
    """Names of the freedoms of the hand, and whether they turn it."""
    run = planned.runs.planned
    d, n_s = run.body.shape[2], run.inputs.shape[1]
    turns = ["turn"] if d == 2 else [f"turn_{axis}" for axis in AXES]
    return [(axis, False) for axis in AXES[:d]] + [(name, True) for name in turns[: n_s - d]]


@dataclass(frozen=True)
class PlannedStudy:
    """A plan, its runs on the full plant, and the time of both."""

    planned: PlannedControl  # plan and runs
    optimal_cost: float  # least cost J* of all inputs without obstacles and limits
    rows: int  # number of rows of the quadratic program
    seconds_cold: tuple[float, ...]  # time of the quadratic program without a guess [s]
    seconds_warm: tuple[float, ...]  # time of programs nearby from its active rows [s]
    tick: float  # time between two ticks of the loop [s]
    finite: FinitePlan | None = None  # the plan on the plant of finite strain; None where the effect is off
    margin_finite: float = 0.0  # margin for the error of the linear plant, measured under a plan before [m]

    @property
    def seconds_online(self) -> tuple[float, ...]:
        """Time of every plan that was made again in the run from tick to tick, with its judgement [s]."""
        online = self.planned.online
        return () if online is None else tuple(entry.seconds for entry in online.log)

    @property
    def outcomes(self) -> dict[str, int]:
        """Intervals of that run by what they began with: a new plan, the last one, one that gives up gaps."""
        online = self.planned.online
        log = () if online is None else online.log
        return {kind.name.lower(): sum(entry.outcome is kind for entry in log) for kind in Outcome}

    @property
    def excess(self) -> float:
        """Cost of the plan on the full plant over the least cost, less one [1]."""
        return self.planned.runs.planned.cost / self.optimal_cost - 1

    @property
    def excess_held(self) -> float:
        """The part of it that holding the force over the grid costs without obstacles and limits [1]."""
        return self.planned.plan.free_cost / self.optimal_cost - 1

    @property
    def named(self) -> Array | None:
        """Nodes that keep gaps where they are not the whole boundary [m], (nodes, d); else None."""
        surface = self.planned.surface
        if surface.kept is None:
            return None
        nodes = surface.nodes[surface.kept]
        return np.asarray(np.where(np.abs(nodes) > ZERO * np.abs(surface.nodes).max(), nodes, 0.0))

    @property
    def boundary(self) -> list[float]:
        """Least gap of the whole boundary to each obstacle [m]."""
        run = self.planned.runs.planned
        least = self.planned.plan.task.gaps(run.body, run.times).min(axis=0)
        return [float(gap) for gap in least]

    @property
    def kept(self) -> bool:
        """Whether the full plant keeps every gap at every step."""
        return bool((self.planned.runs.planned.gaps >= 0).all())

    def result(self) -> dict[str, Any]:
        """The key "obstacle" of ``result.json``."""
        plan, runs = self.planned.plan, self.planned.runs
        task, plant, online = plan.task, plan.horizon.plant, self.planned.online
        noisy = online is not None and online.covariance is not None
        used = np.abs(runs.planned.inputs).max(axis=0)
        return {
            "names": list(self.planned.names),
            **({} if self.named is None else {"body": self.named.tolist(), "gap_min_boundary": self.boundary}),
            "gap_min": runs.planned.least.tolist(),
            "time": runs.planned.times_least.tolist(),
            "gap_min_without_plan": runs.free.least.tolist(),
            "margin": {
                "clearance": task.clearance - self.margin_finite,
                **({"finite_strain": self.margin_finite} if self.margin_finite else {}),
                "reduced_plant": float(task.error.max(initial=0.0)),
                "between_instants": plan.bend,
                **({"noise": float(np.max(task.noise))} if noisy else {}),
            },
            **({"gap_min_noisy": online.gaps.min(axis=0).tolist()} if noisy and online is not None else {}),
            "online": self._online(),
            **({} if self.planned.run_error is None else {"error_of_pulse_runs": self.planned.run_error}),
            "error_of_reduced_plant": runs.reduction_error,
            "error_of_run_step": runs.step_error,
            **({} if self.finite is None else {"finite_strain": _finite(self.finite)}),
            "certified": plan.certified,
            "reason": plan.reason,
            "gap_certified": plan.gap if task.bounded and np.isfinite(plan.gap) else None,
            "depth": plan.depth,
            "time_outside": plan.outside,
            "cost": runs.planned.cost,
            "cost_predicted": plan.cost,
            "cost_excess": self.excess,
            "cost_excess_held": self.excess_held,
            "multiplier": plan.multiplier,
            "input_largest": used.tolist(),
            "speed_largest": np.abs(runs.planned.v_s).max(axis=0).tolist(),
            "N": plant.N,
            "grid": plant.grid,
            "intervals": plan.horizon.steps,
            "intervals_followed": plan.followed,
            "variables": len(plan.c),
            "rows": self.rows,
            "rows_active": len(plan.active),
            "rounds": len(plan.costs),
            "steps": plan.steps,
            "ways": [{"sides": list(s), "cost": cost, "depth": depth} for s, cost, depth in plan.tried],
            "ways_untried": plan.untried,
            "inputs": plan.inputs.tolist(),
            "dt": runs.dt,
            "tick": self.tick,
            "time_cold": [float(np.median(self.seconds_cold)), max(self.seconds_cold)],
            "time_warm": [float(np.median(self.seconds_warm)), max(self.seconds_warm)],
        }

    def _online(self) -> dict[str, Any]:
        """The key "online" of a plan."""
        online = self.planned.online
        if online is None or online.controller.planner is None:
            return {"reason": self.planned.reason}
        program, seconds = online.controller.planner, self.seconds_online
        return {
            "gap_min": online.gaps.min(axis=0).tolist(),
            "rows": program.count(0),
            "rows_most": program.count(program.H),
            "time": [float(np.median(seconds)), max(seconds)],
            "steps": [entry.steps for entry in online.log],
            "depth": max(entry.depth for entry in online.log),
            **self.outcomes,
            "reasons": sorted({entry.reason for entry in online.log if entry.reason}),
        }


def _finite(finite: FinitePlan) -> dict[str, Any]:
    """The key "finite_strain" of a plan."""
    violation = max(0.0, -float(finite.gaps.min(initial=0.0))) if not finite.reason else None
    return {"gap_min": finite.gaps.tolist(), "violation": violation, "error": finite.error, "reason": finite.reason}
