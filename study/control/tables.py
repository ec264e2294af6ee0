"""Tables of ``softgrasp control``: the summary, reduced gains, re-tuning, closed loops, the trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from softgrasp.fem.columns import hand_columns
from softgrasp.fem.petsc import Array
from softgrasp.lqr.design.controller import CertifiedController
from softgrasp.lqr.design.feedback import Design
from softgrasp.lqr.design.orders import BasisGains
from softgrasp.lqr.plant.identities import rigid_gains
from softgrasp.lqr.reduced.riccati import GainQuality
from softgrasp.study.control.result import TITLES, ControlStudy, Retuned, radius_of, settled
from softgrasp.study.forward.result import trajectory_header
from softgrasp.study.report.tables import Table

Row = tuple[Any, ...]
SPECTRUM = ("abscissa [1/s]", "radius a tick")
EXCESS = ("excess cost", "proved to the end", "at most")
REDUCED_HEADER = ("basis", "N", "error of P", "error of K", *EXCESS, *SPECTRUM, "reduced ARE [ms]", "gain")
BOX_HEADER = ("lambda [Pa]", "mu [Pa]", "error of K", *EXCESS, *SPECTRUM, "re-tuned in [ms]", "gain")
LOOP_HEADER = ("gain", "N", "distance at the end [m]", "cost", "over the optimal")
BEST_HEADER = (
    "best stable gain", "N", "error P", "error K", "excess", "at most", "abscissa", "ARE, ms", "unstable N",
)  # fmt: skip


def summary_rows(study: ControlStudy, seconds: dict[str, float]) -> list[tuple[str, str]]:
    """The short table as label and text."""
    full, loops, away = study.loops.full, study.loops, study.distance(study.loops.full)
    arrived = settled(full.times, away)
    rows = [
        *gain_rows(study.design),
        ("distance to the target", f"{away[0]:.3g} m at first, {away[-1]:.3g} m at the end"),
        ("stays within 1 % of the way from", "not within the run" if arrived is None else f"{arrived:.4g} s on"),
        ("cost of the run + still to come", f"{full.cost[-1]:.6g} + {loops.to_come:.3g}"),
    ]
    if study.finite is not None:
        rows.append((f"on the plant of finite strain ({study.finite.law})", study.finite.text))
    if full.saturated:
        rows.append(("steps with a load at its limit", f"{100 * full.saturated:.3g} %"))
    rows += controller_rows(study.controller, study.tick)
    if study.margins is not None:
        low, high, phase = study.margins.together
        text = (
            f"gain x {low:.3g} to {high:.3g}, phase {phase:.3g} deg"
            if high < 1e3
            else f"gain x {low:.3g} or more, phase {phase:.3g} deg"
        )
        rows.append(("its margins, all inputs at once", text))
    rows += [("re-tuned", _fast(r)) for r in study.retuned]
    stages = ", ".join(f"{seconds.get(k, 0.0):.3g} s" for k in ("are", "reduced", "loop"))
    return [*rows, ("time: ARE, reduced, loop", stages)]


def summary(study: ControlStudy) -> list[str]:
    """What came out, in three sentences."""
    full, loops, optimal = study.loops.full, study.loops, study.design.judge.optimal
    arrived = settled(full.times, study.distance(full))
    reaches = "does not settle within 1 % of the way in this run" if arrived is None else (
        f"reaches the target, within 1 % of the way, in {arrived:.3g} s"
    )  # fmt: skip
    excess, told = (full.cost[-1] + loops.to_come) / optimal - 1, [f"The optimal gain {reaches}."]
    if full.saturated:
        told.append(f"With the limits of the loads the move costs {excess:.2%} more than without them.")
    else:
        told.append(f"The move costs {full.cost[-1]:.4g}; the Riccati equation predicts {optimal:.4g}.")
    return [*told, _controller(study.controller, study.tick)]


def gain_summary(design: Design, controller: CertifiedController | None, tick: float) -> list[str]:
    """What came out of the Riccati equation alone, in three sentences."""
    solution, quality = design.solution, design.quality
    return [
        f"The Riccati equation is solved to the relative residual {solution.residual:.1e}.",
        f"The move costs {design.judge.optimal:.4g} at least; the abscissa of its loop is {quality.abscissa:.3g} 1/s.",
        _controller(controller, tick),
    ]


def _controller(controller: CertifiedController | None, tick: float) -> str:
    if controller is None:
        return "No small controller is certified, see the notes."
    c = controller.controller
    return (
        f"The small controller has N = {c.plant.N} columns and takes {1e6 * tick:.2g} us of each tick of "
        f"{1e3 * c.period:g} ms."
    )


def gain_rows(design: Design) -> list[tuple[str, str]]:
    """The solution of the Riccati equation and its closed loop as label and text."""
    solution, (displaced, moving) = design.solution, rigid_gains(design.problem, design.solution)
    counts = [str(n) for n in (solution.rank, *(solution.counts.get(k, 0) for k in ("newton_steps", "solves")))]
    return [
        ("method", solution.summary),
        ("rank, Newton steps, solves", ", ".join(counts)),
        ("true relative residual", f"{solution.residual:.1e}"),
        ("optimal cost from the start", f"{design.judge.optimal:.6g}"),
        *_spectrum(design),
        ("gain, body displaced", _matrix(displaced)),
        ("gain, body moving", _matrix(moving)),
    ]


def controller_rows(controller: CertifiedController | None, tick: float) -> list[tuple[str, str]]:
    """The small controller as label and text, if there is one."""
    if controller is None:
        return []
    c = controller.controller
    return [("small controller", f"N = {c.plant.N}, {1e6 * tick:.2g} us a tick of {1e3 * c.period:g} ms")]


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


def _matrix(values: Array) -> str:
    return "; ".join(" ".join(f"{v:.5g}" for v in row) for row in values)


def _fast(r: Retuned) -> str:
    stable = [p for p in r.points if p.stable]
    largest, bound = (
        max((getattr(p, key) for p in stable), default=float("nan")) for key in ("cost_excess", "cost_excess_at_most")
    )
    return (
        f"{TITLES[r.name]}, N = {r.N}: {len(stable)} of {len(r.points)} stable, at most {1e3 * r.slowest:.2g} ms, "
        f"excess cost up to {largest:.1e}, at most {bound:.1e}"
    )


def _mark(gain: GainQuality) -> str:
    if gain.reason:
        return "none"
    if gain.stable or not gain.certified:
        return "stable" if gain.stable else "not certified"
    if gain.abscissa_full >= 0 or gain.sampled is None:
        return "unstable"
    return "unstable as sampled" if gain.sampled.value >= 1 else "not certified as sampled"


def _cells(gain: GainQuality, *values: float) -> list[float | None]:
    """Nothing where there is no gain, or no finite number."""
    return [None if gain.reason or not np.isfinite(x) else float(x) for x in values]


def _excess(gain: GainQuality) -> tuple[float, float, float]:
    return gain.cost_excess, gain.cost_excess_proved, gain.cost_excess_at_most


def reduced_table(bases: Sequence[BasisGains]) -> Table:
    """One row a gain; errors of an unusable gain are shown, its cost is not."""
    rows = [
        (
            TITLES[b.name],
            r.N,
            *_cells(r, r.error_P, r.error_K, *_excess(r)),
            None if r.reason else r.abscissa_full,
            None if r.sampled is None else radius_of(r),
            None if r.reason else 1e3 * r.time_are,
            _mark(r),
        )
        for b in bases
        for r in b.reports
    ]
    reports = [(b, r) for b in bases for r in b.reports]
    best = [i for i, (b, r) in enumerate(reports) if r is b.best()]
    return Table(REDUCED_HEADER, rows, "Reduced Riccati equations", best)


def best_table(bases: Sequence[BasisGains]) -> Table:
    """The best stable gain of every basis, in short."""
    rows: list[Row] = []
    for b in bases:
        r, unstable = b.best(), ", ".join(str(x.N) for x in b.reports if not x.stable)
        if r is None:
            rows.append((TITLES[b.name], *([""] * 7), unstable or b.refused))
            continue
        excess = (f"{r.cost_excess:.1e}", f"{r.cost_excess_at_most:.1e}")
        values = (f"{r.error_P:.1e}", f"{r.error_K:.1e}", *excess, f"{r.abscissa_full:.4g}")
        rows.append((TITLES[b.name], r.N, *values, f"{1e3 * r.time_are:.2g}", unstable))
    return Table(BEST_HEADER, rows)


def box_rows(r: Retuned) -> list[Row]:
    """One row a setting."""
    return [
        (
            p.materials[0].lam,
            p.materials[0].mu,
            *_cells(p, p.error_K, *_excess(p), p.abscissa_full, radius_of(p), 1e3 * p.seconds),
            _mark(p),
        )
        for p in r.points
    ]


def loop_table(study: ControlStudy) -> Table:
    """Full plant under every gain."""
    full = study.loops.full
    rows: list[Row] = [("optimal", None, float(study.distance(full)[-1]), float(full.cost[-1]), 0.0)]
    for r in study.loops.reduced:
        if r.run is None:
            rows.append((f"{TITLES[r.method]}: {r.reason}", r.N, None, None, None))
            continue
        cost, end = float(r.run.cost[-1]), float(study.distance(r.run)[-1])
        rows.append((TITLES[r.method], r.N, end, cost, cost / float(full.cost[-1]) - 1))
    return Table(LOOP_HEADER, rows, "Closed loop")


def trajectory_table(study: ControlStudy) -> Table:
    """Hand, outputs, load and cost at every instant under the optimal gain."""
    full, d = study.loops.full, study.design.problem.layout.dimension
    n_s = full.q_s.shape[1]
    names = trajectory_header(n_s, d, full.columns, velocity=False)
    names += [*(f"{u.label} [{u.load_unit}]" for u in hand_columns(n_s, d, "u")), "cost"]
    inputs = np.vstack([full.inputs, full.inputs[-1:]])
    data = np.column_stack([full.times, full.q_s, full.outputs, inputs, full.cost])
    return Table(tuple(names), data.tolist())


def tables(study: ControlStudy) -> dict[str, Table]:
    """CSV file name -> table."""
    files = {"trajectory.csv": trajectory_table(study)}
    if study.bases:
        files["reduced.csv"] = reduced_table(study.bases)
    if study.retuned:
        rows = [(TITLES[r.name], r.N, *row) for r in study.retuned for row in box_rows(r)]
        files["retune.csv"] = Table(("basis", "N", *BOX_HEADER), rows)
    return files
