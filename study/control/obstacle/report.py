"""The part of a page about a plan: what it keeps, what it costs, what it took."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.lqr import Plan, PlannedControl
from softgrasp.lqr.design.constrained import FinitePlan
from softgrasp.study.control.obstacle.result import PlannedStudy, freedoms
from softgrasp.study.report import Section, Table, captioned, in_words, percent
from softgrasp.study.report.document import number

CAPTIONS = {
    "gaps.png": "Gap of the body to every obstacle on the full plant, with a band of three standard deviations where "
    "an observer keeps it on its way under noise. Dashed: clearance and margins, which the reduced plant keeps; the "
    "full plant may use the margins up. Where control.constraints.body gives nodes, gaps are theirs. Below: force "
    "and speed of the hand with their limits.",
    "times.png": "Times of the quadratic program in Python, without a guess and from the active rows of a plan nearby, "
    "against a tick of the loop and the interval after which the next plan is due.",
}
FEW = 4  # nodes that a sentence lists
GAPS = ("obstacle", "least gap [m]", "at [s]", "without the plan [m]")


def plan_sections(study: PlannedStudy, drawn: Sequence[Path]) -> list[Section]:
    """The way past the obstacles, as the first picture of the page; gaps, margins and costs with the others."""
    runs = study.planned.runs
    gaps = [
        (name, least, at, free)
        for name, least, at, free in zip(
            study.planned.names, runs.planned.least.tolist(), runs.planned.times_least.tolist(),
            runs.free.least.tolist(), strict=True,
        )
    ]  # fmt: skip
    figures = captioned(drawn, CAPTIONS | {"obstacle.png": _way(study)})
    way = [each for each in figures if each[0].name == "obstacle.png"]
    others = [each for each in figures if each not in way]
    parts = [Section("", figures=way), Section("Plan", rows=facts(study), figures=others, terminal=True)]
    if gaps:
        text = (
            f"Distance of {'body' if study.named is None else 'these nodes'} and obstacle on the full plant at every "
            f"step of {1e3 * runs.dt:g} ms; negative: overlap."
        )
        parts.append(Section("Gaps", text, header=GAPS, rows=gaps, terminal=True))
    return parts


def _way(study: PlannedStudy) -> str:
    """What the picture of the way past the obstacles shows."""
    task = study.planned.plan.task
    text = (
        "The boundary of the body on the full plant under the plan at some instants, and the way of its middle; grey "
        "and dashed: under the optimal feedback, which knows no obstacles, where it is deepest inside."
    )
    if study.planned.runs.planned.body.shape[-1] == 3:
        text += " It is seen from the front and from above, where outlines may cross and nothing touches."
    if study.named is not None:
        text += " Dots: the nodes that keep gaps."
    if any(task.path(i) is not None for i in range(len(task.shapes))):
        text += " Obstacles that move are drawn at the same instants."
    return text


def plan_table(study: PlannedStudy) -> Table:
    """Force of every interval, and the hand and the least gaps of the full plant in it."""
    run, grid = study.planned.runs.planned, study.planned.plan.horizon.plant.grid
    each = round(grid / study.planned.runs.dt)
    axes = freedoms(study.planned)
    header = [
        "t [s]",
        *(f"u_{x} [{'N m' if turns else 'N'}]" for x, turns in axes),
        *(f"v_{x} [{'rad/s' if turns else 'm/s'}]" for x, turns in axes),
    ]
    gaps = [run.gaps[n : n + each + 1].min(axis=0) for n in range(0, len(run.inputs), each)]
    rows = np.column_stack([run.times[:-1:each], run.inputs[::each], run.v_s[:-1:each], np.array(gaps)])
    names = [f"least gap to {name} [m]" for name in study.planned.names]
    return Table((*header, *names), rows.tolist(), "Plan")


def sentence(study: PlannedStudy) -> str:
    """What came out."""
    plan = study.planned.plan
    paid = study.planned.runs.planned.cost
    more = f"{percent(study.excess)} more than that of the optimal feedback without obstacles and limits"
    cost = f"The cost of the plan is {paid:.4g}, {more}."
    whose = "" if study.named is None else f" of {_nodes(study.named)}"
    if not plan.certified:
        run = "keeps" if study.kept else "does not keep"
        return f"The plan is not certified: {plan.reason}. The full plant {run} every gap{whose} in its run. {cost}"
    kept = f"every limit, and every gap{whose}" if whose else "every gap and limit"
    other = ", but for no other node" if whose else ""
    return f"The full linear plant keeps {kept} under the plan at every time: this is proved{other}. {cost}"


def facts(study: PlannedStudy) -> list[tuple[str, str]]:
    """Label and text."""
    plan, runs = study.planned.plan, study.planned.runs
    task, plant = plan.task, plan.horizon.plant
    rows: list[tuple[str, Any]] = []
    if study.named is not None and task.shapes:
        least = in_words([f"{gap:.3g} m" for gap in study.boundary])
        rows.append(("least gap of the whole boundary", f"{least}, which the plan does not look at"))
    rows += [
        ("reduced plant", f"N = {plant.N}, forces held for {plant.grid:g} s"),
        ("horizon", f"{plan.horizon.steps} intervals, {plan.followed} more followed until the rest is safe"),
        ("quadratic program", f"{len(plan.c)} variables, {study.rows} rows, {_held(plan)}"),
    ]
    if task.shapes:
        rows += [
            (
                "margin for the reduced plant",
                f"{task.error.max():.3g} m, its error in this plan {runs.reduction_error:.2g} m{_behind(study)}",
            ),
            (
                "margin between two instants" + (" and for the square of the angle" if task.angle is not None else ""),
                f"{plan.bend:.2g} m where a gap is active",
            ),
            ("clearance", f"{task.clearance - study.margin_finite:.3g} m"),
            ("error of the run's own step", f"{runs.step_error:.2g} m, measured against {_modes(study)}"),
            ("cost of a metre of one gap at one instant", f"{plan.multiplier:.3g} at most"),
        ]
    rows += _noisy(study)
    if study.margin_finite:
        text = (
            f"{study.margin_finite:.3g} m, the error of the linear plant under a plan without it: an estimate, no bound"
        )
        rows.append(("margin for finite strain", text))
    if study.finite is not None:
        rows.append(("on the plant of finite strain", _finite(study.finite)))
    rows += [
        ("excess cost", f"{percent(study.excess)}, of which held forces {percent(study.excess_held)}"),
        ("cost predicted and run", f"{plan.cost:.6g} and {runs.planned.cost:.6g}"),
        ("largest force", _largest(study.planned, runs.planned.inputs, "N", "N m")),
        ("largest speed", _largest(study.planned, runs.planned.v_s, "m/s", "rad/s")),
        ("rounds and steps of the active set", f"{len(plan.costs)} and {plan.steps} on the way that was chosen"),
    ]
    if len(plan.tried) > 1:
        ways = [f"{words(sides)} {_cost(cost, depth)}" for sides, cost, depth in plan.tried]
        more = f"; {plan.untried} more ways were not tried" if plan.untried else ""
        rows.append(("ways tried", "; ".join(ways) + more))
    if plan.active:
        cold, warm = (1e3 * float(np.median(x)) for x in (study.seconds_cold, study.seconds_warm))
        rows.append(
            (
                "time of the quadratic program",
                f"{cold:.2g} ms, from a plan nearby {warm:.2g} ms, in Python; a plan is due every {plant.grid:g} s",
            )
        )
    return rows


def _nodes(nodes: Array) -> str:
    """The nodes that keep gaps, in words."""
    if len(nodes) > FEW:
        return f"the {len(nodes)} nodes of control.constraints.body, and of what is between them,"
    places = in_words([f"({', '.join(f'{x:.4g}' for x in node)})" for node in nodes.tolist()])
    return f"the node at {places}" if len(nodes) == 1 else f"the nodes at {places}, and of what is between them,"


def _noisy(study: PlannedStudy) -> list[tuple[str, str]]:
    """Margin for noise, and what the controller that plans again did in its run."""
    online, task = study.planned.online, study.planned.plan.task
    if online is None or online.controller.planner is None:
        return [("planned again online", f"no: {study.planned.reason}")]
    rows: list[tuple[str, str]] = []
    noisy = online.covariance is not None
    if online.covariance is not None:
        sd = np.sqrt(np.einsum("jdd->jd", online.covariance)).max()
        text = f"{np.max(task.noise):.3g} m, a node deviates by {sd:.2g} m: an estimate, no bound"
        rows.append(("margin for noise", text))
    counts, seconds = study.outcomes, 1e3 * np.array(study.seconds_online)
    words = (
        f"{counts['new']} of {len(seconds)} intervals began with a new plan from the estimate, "
        f"{counts['kept']} with the last plan"
    )
    if counts["soft"]:
        words += f", {counts['soft']} gave up gaps by {max(entry.depth for entry in online.log):.2g} m at most"
    program = online.controller.planner
    overlap = ": the body overlaps an obstacle" if online.gaps.min() < 0 else ""
    return [
        *rows,
        ("planned again online", words),
        ("least gap of that run", f"{online.gaps.min():.3g} m, {'with' if noisy else 'without'} noise{overlap}"),
        (
            "program online",
            f"{program.count(0)} of {study.rows} rows, which imply all that can become active; "
            f"{number(np.median(seconds))} ms in the median and {number(seconds.max())} ms at most in Python, with its "
            "check",
        ),
    ]


def _finite(finite: FinitePlan) -> str:
    """Least gap at finite strain, and the error of the linear plant there."""
    if finite.reason:
        return f"the run fails: {finite.reason}"
    least = float(finite.gaps.min(initial=np.inf))
    kept = "every gap is kept" if least >= 0 else f"a gap is exceeded by {-least:.2g} m"
    return f"{kept}; the linear plant has an error of up to {finite.error:.2g} m, an estimate of the clearance to give"


def _modes(study: PlannedStudy) -> str:
    whole = study.planned.run_error is None
    return "the exact modes" if whole else "the lowest modes and the static answer"


def _behind(study: PlannedStudy) -> str:
    """Of a margin from runs: the part of their time steps in it."""
    part = study.planned.run_error
    return (
        ""
        if part is None
        else f"; it comes from runs of the full plant, whose time steps have an error of {part:.1g} m at most"
    )


def _largest(planned: PlannedControl, values: Array, unit: str, turning: str) -> str:
    """Largest of every freedom of the hand, (times, n_s)."""
    units = [turning if turns else unit for _, turns in freedoms(planned)]
    return in_words([f"{x:.3g} {of}" for x, of in zip(np.abs(values).max(axis=0), units, strict=True)])


def _held(plan: Plan) -> str:
    """How many rows hold a plan, or that they are exceeded."""
    return f"{len(plan.active)} of them are active" if plan.depth == 0 else "no forces keep all of them"


def words(sides: Sequence[int]) -> str:
    """On which sides the obstacles on the way are passed."""
    return ", ".join({1: "left", -1: "right", 2: "above", -2: "below"}[side] for side in sides)


def _cost(cost: float, depth: float) -> str:
    return f"costs {cost:.4g} more" if depth == 0 else f"goes {depth:.3g} m inside"
