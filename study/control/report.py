"""What ``softgrasp control`` shows: one page, parts of which a terminal shows too, and its tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem import Array, hand_columns
from softgrasp.lqr import (
    BasisGains,
    Design,
    GainQuality,
    LoopMargins,
    RiccatiProblem,
    RiccatiSolution,
    rigid_gains,
    running_words,
)
from softgrasp.study.control.result import TITLES, ControlStudy, GainStudy, Retuned, gain_change, settled
from softgrasp.study.control.touching import TOUCHING_CAPTIONS, touching_sections, touching_sentence, trajectory_table
from softgrasp.study.pictures import speed_up
from softgrasp.study.report import Columns, Page, Section, Share, Table, captioned, entry, percent, table_of
from softgrasp.study.report.equation import control_equation

Row = tuple[Any, ...]
HOW = (
    "Each equation is projected on N basis vectors and solved. The bases of the paper need P first, the a-priori modes "
    "do not."
)
LOOP_HEADER = ("gain", "N", "distance at the end [m]", "cost", "over the optimal")
CAPTIONS = {
    "move.png": "The move to the target at some instants, full plant under the optimal gain.",
    "move.gif": "The move in motion{speed}.",
    "histories.png": "Outputs, force on the hand, and the distance of the farthest output to the target, on the "
    "full plant; dashed and dash-dotted under the a-priori gain and the paper's reduced gain of largest cost.",
    "errors.png": "Reduced Riccati equations: relative error of P, relative error of the gain and excess cost against "
    "N. Errors above 100 % are not drawn, excess cost below 1e-12 at 1e-12. Red crosses: gains that leave the full "
    "plant unstable or without certificate; on the upper edge those with an error above 100 %.",
    "retune.png": "Excess cost over the box when the basis stays that of the scene's parameter. Red crosses: no stable "
    "gain.",
    "bode.png": "The loop at each input, all others closed, on the controller's own plant, sampled and held; marked: "
    "the crossover and its phase margin.",
    "decay.png": "Decay rates of the lowest modes without feedback and with the gains.",
}


def _mark(gain: GainQuality) -> str:
    if gain.reason:
        return "none"
    if not gain.examined and gain.promising:
        return "not examined"
    if gain.stable or (gain.examined and not gain.certified):
        return "stable" if gain.stable else "not certified"
    if gain.abscissa_full >= 0 or gain.sampled is None:
        return "unstable"
    return "unstable as sampled" if gain.sampled.value >= 1 else "not certified as sampled"


def _value(path: str, factor: float = 1.0, kind: type[float] = float) -> Callable[[GainQuality], float | None]:
    """The number of a gain; nothing where there is no gain, or no finite number."""

    def cell(gain: GainQuality) -> float | None:
        value = entry(gain, path)
        return None if gain.reason or value is None or not np.isfinite(value) else kind(factor * value)

    return cell


def _share(path: str) -> Callable[[GainQuality], float | None]:
    return _value(path, kind=Share)


def _number(x: float) -> str:
    return "any" if np.isinf(x) or x > 1e3 else "none" if np.isnan(x) else f"{x:.3g}"


GAIN: Columns = {
    "excess cost as it runs": _share("cost_excess"), "proved to the end": _share("cost_excess_proved"),
    "at most": _share("cost_excess_at_most"), "abscissa [1/s]": _value("abscissa_full"),
    "radius a tick": _value("sampled.value"),
}  # fmt: skip
REDUCED: Columns = {
    "basis": lambda r: TITLES[r.method], "N": "N", "error of P": _share("error_P"), "error of K": _share("error_K"),
    **GAIN, "reduced ARE [ms]": _value("time_are", 1e3), "gain": _mark,
}  # fmt: skip
BOX: Columns = {
    "lambda [Pa]": lambda p: p.materials[0].lam, "mu [Pa]": lambda p: p.materials[0].mu,
    "error of K": _share("error_K"), **GAIN, "re-tuned in [ms]": _value("seconds", 1e3), "gain": _mark,
}  # fmt: skip
BEST: Columns = {
    "best stable gain": lambda b: TITLES[b["basis"].name], "N": "best.N", "error P": "best.error_P %",
    "error K": "best.error_K %", "excess": "best.cost_excess %", "at most": "best.cost_excess_at_most %",
    "abscissa": "best.abscissa_full .4g", "ARE, ms": lambda b: b["best"] and f"{1e3 * b['best'].time_are:.2g}",
    "unstable N": lambda b: ", ".join(str(r.N) for r in b["basis"].reports if r.ruled_out) or b["basis"].refused,
}  # fmt: skip
MARGINS: Columns = {
    "input": "name", "gain may change by a factor": lambda a: f"{a.gain_down:.3g} to {_number(a.gain_up)}",
    "phase margin": lambda a: f"{_number(a.phase)} deg", "at": lambda a: f"{_number(a.crossover)} rad/s",
    "delay margin": lambda a: f"{_number(a.delay)} s",
}  # fmt: skip


def _rigid_gain_rows(problem: RiccatiProblem, gains: tuple[Array, Array]) -> list[tuple[str, str]]:
    """A row for each load on the hand and each kind of gain, by axis: "-1 N/m in x"; rounding of others is zero."""
    columns, rows = hand_columns(problem.layout.n_s, problem.layout.dimension), []
    for kind, per, gain in (("displaced", "m", gains[0]), ("moving", "(m/s)", gains[1])):
        small = 1e-6 * np.abs(gain).max(initial=0.0)  # what rounding and the solver's tolerance leave
        for column, row in zip(columns, gain, strict=True):
            load = f"{'torque about' if column.rotation else 'force along'} {column.axis[-1]}"
            unit = f"{column.load_unit}/{per}"
            parts = [
                f"{v if abs(v) > small else 0.0:.5g} {unit} in {axis}" for v, axis in zip(row, "xyz", strict=False)
            ]
            rows.append((f"{load}, body {kind}", ", ".join(parts)))
    return rows


def result_rows(study: GainStudy, seconds: Mapping[str, float]) -> list[tuple[str, str]]:
    """The short table as label and text: Riccati equation, closed loop, small controller, re-tuning."""
    solution, gains = study.design.solution, rigid_gains(study.design.problem, study.design.solution)
    counts = [str(n) for n in (solution.rank, *(solution.counts.get(k, 0) for k in ("newton_steps", "solves")))]
    rows = [
        ("method", solution.summary),
        ("rank, Newton steps, solves", ", ".join(counts)),
        ("true relative residual", f"{solution.residual:.1e}"),
        *_settled_gain(solution),
        ("optimal cost from the start", f"{study.design.gain_check.optimal:.6g}"),
        *_spectrum(study.design),
        *_rigid_gain_rows(study.design.problem, gains),
    ]
    whole = study if isinstance(study, ControlStudy) else None
    if whole is not None:
        full, away = whole.loops.full, whole.distance(whole.loops.full)
        arrived = settled(full.times, away)
        rows += [
            ("distance to the target", f"{away[0]:.3g} m at first, {away[-1]:.3g} m at the end"),
            ("stays within 1 % of the way from", "not within the run" if arrived is None else f"{arrived:.4g} s on"),
            ("cost of the run + still to come", f"{full.cost[-1]:.6g} + {whole.loops.to_come:.3g}"),
        ]
        if whole.finite is not None:
            rows.append((f"on the plant of finite strain ({whole.finite.law})", whole.finite.text))
        if full.saturated:
            rows.append(("steps with a load at its limit", f"{100 * full.saturated:.3g} %"))
    if study.controller is not None:
        c = study.controller.controller
        rows.append(
            (
                "small controller",
                f"N = {c.plant.N}, {1e6 * study.tick:.2g} us a tick of {1e3 * c.period:g} ms in Python",
            )
        )
    if whole is not None and study.margins is not None:
        low, high, phase = study.margins.together
        up = f"to {high:.3g}" if high < 1e3 else "or more"
        rows.append(("its margins, all inputs at once", f"gain x {low:.3g} {up}, phase {phase:.3g} deg"))
    if whole is not None:
        if whole.bases:
            rows.append(("loop of the excess cost", running_words(study.design)))
        rows += [("re-tuned", _fast(r)) for r in whole.retuned]
        stages = ", ".join(f"{seconds.get(k, 0.0):.3g} s" for k in ("are", "reduced", "loop"))
        rows.append(("time: ARE, reduced, loop", stages))
    return rows


def _settled_gain(solution: RiccatiSolution) -> list[tuple[str, str]]:
    """Of a Galerkin gain the changes between the last two spaces: its residual is no measure of the gain."""
    change = gain_change(solution)
    text = change and f"rows of the hand {percent(change['hand'])}, of the tissue {percent(change['tissue'])}"
    return [("last change of the gain", text)] if text else []


def accuracy(study: GainStudy) -> list[str]:
    """How far equation and small gain are from exact, in a sentence each."""
    residual, change = study.design.solution.residual, gain_change(study.design.solution)
    solved = f"The Riccati equation is solved to the relative residual {residual:.1e}."
    if change is not None:
        solved = (
            f"The Riccati equation is solved by a Galerkin method: its true relative residual is {residual:.1e}; "
            f"between the last two spaces the gain changed by {percent(change['hand'])} in the rows of the hand and by "
            f"{percent(change['tissue'])} in those of the tissue."
        )
    bound = small_excess(study)
    share = f"at most {percent(bound)}" if bound >= 1e-6 else "less than 0.0001 %"
    small = f"The gain of the small controller costs {share} more than the optimal one."
    return [solved, *([small] if np.isfinite(bound) else [])]


def small_excess(study: GainStudy) -> float:
    """Bound on the excess cost of the small controller's gain, as ``reduced.csv`` has it; nan where there is none."""
    if (small := study.controller) is None:
        return float("nan")
    N = small.controller.plant.N
    found = (r for b in study.bases if b.name == small.method for r in b.reports if r.N == N)
    return next((r.cost_excess_at_most for r in found), float("nan"))


def summary(study: GainStudy) -> list[str]:
    """What came out, in two or three sentences."""
    design, optimal = study.design, study.design.gain_check.optimal
    outcome: list[str] = []
    cost = f"The move costs {optimal:.4g} at least; the abscissa of its loop is {design.quality.abscissa:.3g} 1/s."
    if isinstance(study, ControlStudy):
        full = study.loops.full
        arrived, paid = settled(full.times, study.distance(full)), full.cost[-1]
        reaches = "does not settle within 1 % of the way in this run, see the notes" if arrived is None else (
            f"reaches the target, within 1 % of the way, in {arrived:.3g} s"
        )  # fmt: skip
        free = "" if study.planned is None else " without obstacles and limits"
        free = free if study.loops.touching is None else " without obstacles"
        outcome = [f"The optimal gain{free} {reaches}."]
        rest = study.loops.to_come
        later = f", and {rest:.3g} after the run" if rest > 1e-3 * paid else ""
        cost = f"The move{free} costs {paid:.4g}{later}; the Riccati equation predicts {optimal:.4g} in all."
        if full.saturated:
            excess = (paid + study.loops.to_come) / optimal - 1
            cost = f"With the limits of the loads the move costs {percent(excess)} more than without them."
    if study.controller is None:
        return [*outcome, cost, "No small controller is certified, see the notes."]
    c = study.controller.controller
    return [
        *outcome,
        cost,
        f"The small controller has N = {c.plant.N} columns and takes {1e6 * study.tick:.2g} us of each tick of "
        f"{1e3 * c.period:g} ms.",
    ]


def _spectrum(design: Design) -> list[tuple[str, str]]:
    """Abscissa and radius of the closed loop, with what is certain of them."""
    quality, left_out = design.quality, ", not certified for the modes left out"
    if not quality.certified:
        remark = left_out
    elif not quality.abscissa < 0:
        remark = ": not stable"
    else:
        remark = "" if quality.exact else ", a lower bound; stable for certain"
    if remark and design.modal and not design.problem.system.damping.active:
        remark = ": that of the modes left out, zero to rounding"
    rows = [("closed-loop spectral abscissa", f"{quality.abscissa:.4g} 1/s{remark}")]
    if quality.sampled is not None:
        remark = "" if quality.sampled.exact else ", of the modes kept"
        remark += "" if quality.sampled.certified else left_out
        rows.append(("spectral radius from tick to tick", f"{quality.sampled.value:.6g}{remark}"))
    return rows


def _fast(r: Retuned) -> str:
    stable = [p for p in r.points if p.stable]
    largest, bound = (
        max((getattr(p, key) for p in stable), default=float("nan")) for key in ("cost_excess", "cost_excess_at_most")
    )
    return (
        f"{TITLES[r.name]}, N = {r.N}: {len(stable)} of {len(r.points)} stable, at most {1e3 * r.slowest:.2g} ms, "
        f"excess cost up to {percent(largest)}, at most {percent(bound)}"
    )


def reduced_table(bases: Sequence[BasisGains]) -> Table:
    """One row a gain; errors of an unusable gain are shown, its cost is not."""
    return table_of([r for b in bases for r in b.reports], REDUCED, "Reduced Riccati equations")


def margin_section(margins: LoopMargins, figures: Sequence[tuple[Path, str]]) -> Section:
    """One row an input: gain factors, phase margin, crossover, delay; above them what all withstand at once."""
    low, high, phase = margins.together
    up = f"to {high:.3g}" if high < 1e3 else "upwards"
    text = (
        f"All inputs together withstand any gain factors from {low:.3g} {up}, or phase shifts up to "
        f"{phase:.3g} deg; the smallest singular value of I + L is {margins.distance:.3g}."
    )
    return table_of(margins.axes, MARGINS, "Margins of the small controller").section(text, figures=figures)


def loop_table(study: ControlStudy) -> Table:
    """Full plant under every gain."""
    full = study.loops.full
    rows: list[Row] = [("optimal", None, float(study.distance(full)[-1]), float(full.cost[-1]), Share(0.0))]
    for r in study.loops.reduced:
        if r.run is None:
            rows.append((f"{TITLES[r.method]}: {r.reason}", r.N, None, None, None))
            continue
        cost, end = float(r.run.cost[-1]), float(study.distance(r.run)[-1])
        rows.append((TITLES[r.method], r.N, end, cost, Share(cost / float(full.cost[-1]) - 1)))
    return Table(LOOP_HEADER, rows, "Closed loop")


def csv_tables(study: ControlStudy) -> dict[str, Table]:
    """CSV file name -> table; the first has hand, outputs, load and cost at every instant under the optimal gain."""
    d, touching = study.design.problem.layout.dimension, study.loops.touching
    files = {"trajectory.csv": trajectory_table(study.loops.full, d)}
    if touching is not None and touching.run is not None:
        files["contact.csv"] = trajectory_table(touching.run, d)
    if study.planned is not None:
        from softgrasp.study.control.obstacle.report import plan_table

        files["plan.csv"] = plan_table(study.planned)
    if study.bases:
        files["reduced.csv"] = reduced_table(study.bases)
    if study.retuned:
        rows = [(TITLES[r.name], r.N, *row) for r in study.retuned for row in table_of(r.points, BOX).rows]
        files["retune.csv"] = Table(("basis", "N", *BOX), rows)
    return files


def compose(study: GainStudy, seconds: Mapping[str, float], pictures: Sequence[Path], files: Sequence[Path]) -> Page:
    """The page of the loops, or that of the gain alone; ``files``: controllers and fields."""
    name, notes = study.design.model.scene.name, "\n\n".join((*study.findings, *study.notes))
    noted = [Section("Notes", text=notes, terminal=True)] if notes else []
    result = Section("Result", rows=result_rows(study, seconds), terminal=True)
    if not isinstance(study, ControlStudy):
        return Page(
            f"{name}: optimal gain", summary(study), [*noted, *_observed(study), result], {}, files, " --gain-only",
            errors=accuracy(study),
        )  # fmt: skip
    parts, outcome = sections(study, noted, result, pictures), summary(study)
    if study.loops.touching is not None:
        outcome = [touching_sentence(study, study.loops.touching), *outcome]
    if study.planned is not None:
        from softgrasp.study.control.obstacle.report import sentence

        outcome = [sentence(study.planned), *outcome]
    tables = csv_tables(study)
    return Page(f"{name}: optimal feedback", outcome, parts, tables, [*pictures, *files], errors=accuracy(study))


def sections(study: ControlStudy, notes: Sequence[Section], result: Section, drawn: Sequence[Path]) -> list[Section]:
    """Parts of the page of the loops."""
    faster = speed_up(np.array([0.0, study.loops.plan.settle]))
    speed = "" if faster == 1 else f" at {faster:g} times its speed"
    captions = CAPTIONS if study.loops.touching is None else CAPTIONS | TOUCHING_CAPTIONS
    figures = {file.name: (file, text.format(speed=speed)) for file, text in captioned(drawn, captions)}

    def pick(*names: str) -> list[tuple[Path, str]]:
        return [figures[name] for name in names if name in figures]

    planned: list[Section] = []
    if study.planned is not None:
        from softgrasp.study.control.obstacle.report import plan_sections

        planned = plan_sections(study.planned, drawn)
    parts = [
        *planned[:1],
        Section("", figures=pick("move.png", "move.gif")),
        *notes,
        *planned[1:],
        *_observed(study),
        *touching_sections(study, pick("contact.png")),
        replace(result, figures=pick("histories.png", "decay.png")),
        Section("Equation", equation=control_equation(study.design.model.scene)),
    ]
    if study.bases:
        parts += _reduced(study, pick("errors.png"))
    if study.margins is not None:
        parts.append(margin_section(study.margins, pick("bode.png")))
    for i, r in enumerate(study.retuned):
        text = f"{TITLES[r.name]}, N = {r.N}: basis of the scene's parameter, gain re-tuned at others."
        own = [] if i else pick("retune.png")
        parts.append(table_of(r.points, BOX, "" if i else "Re-tuning").section(text, figures=own))
    return parts


def _observed(study: GainStudy) -> list[Section]:
    """The observer, where there is one."""
    if study.observed is None:
        return []
    from softgrasp.study.control.observer.report import observer_sections

    return observer_sections(study.observed)


def _reduced(study: ControlStudy, figures: list[tuple[Path, str]]) -> list[Section]:
    plan = study.loops.plan
    end = max((r.bounded_to for b in study.bases for r in b.reports if r.stable), default=plan.dt * plan.steps)
    text = (
        "The gain of least cost of each basis is tested on the full plant, and the next best where that "
        "is not stable; the poles of the others are those of the modes kept. Only stable gains are offered. "
        f"Excess cost and its bounds are those of the loop as it runs: {running_words(study.design)}. The excess cost "
        "is J/J* - 1 over the least cost J* of all inputs, which need not be held, wait or keep a limit. The first "
        f"bound beside it is proved for the whole plant, by the duality gap, for the run to t = {end:.4g} s and the "
        "optimal feedback after it; the second makes room for what the loop's own way costs after that time, which is "
        "an allowance, not a proof."
    )
    none = [(f"{TITLES[b.name]}, N = {r.N}", r.unbounded) for b in study.bases for r in b.reports if r.unbounded]
    best = [{"basis": b, "best": b.best()} for b in study.bases]
    parts = [
        table_of(best, BEST, "Best stable gain of each basis").section(terminal=True),
        reduced_table(study.bases).section(HOW, details=text, figures=figures, best=None),
    ]
    refused = [(TITLES[b.name], b.refused) for b in study.bases if b.refused]
    parts += [Section("Refused", header=("basis", "reason"), rows=refused)] if refused else []
    parts += [Section("Without a bound of the cost", header=("gain", "reason"), rows=none)] if none else []
    return [*parts, loop_table(study).section("Full plant, same start, time step and actuation.")]
