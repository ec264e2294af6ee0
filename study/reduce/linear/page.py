"""What ``softgrasp reduce`` shows: one page, parts of which a terminal shows too, and its tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.study.reduce.linear.result import (
    COMPARED,
    N_NOTE,
    POINT_UNITS,
    DomainTests,
    MethodSweep,
    Point,
    ReductionStudy,
    by_error,
    nearest,
    timed_points,
)
from softgrasp.study.reduce.times import TIMES, timed
from softgrasp.study.report import Columns, Page, Section, Table, captioned, percent, table_of

LEVELS = (1e-1, 1e-2, 1e-3)  # of the error of the deformation, for which the least N is named
FIRST = ("errors.png", "errors_beyond.png")  # pictures below the summary
CAPTIONS = {
    "errors.png": "Error of the deformation against N, all columns of V counted, of the paper's six methods and of "
    "Craig-Bampton and PSD SVD-like where they ran. A curve "
    "is dotted where its model is unstable (crosses). Errors above 100 % are drawn at 100 %.",
    "errors_beyond.png": "Error of the deformation against N of the methods beyond the paper, beside the best of the "
    "paper's that ran. A curve is dotted where its model is unstable.",
    "errors_state.png": "Further errors of the paper's six methods: of the state [q_s, v_s, q_e, v_e], which is the "
    "paper's, of [q_s, p_s, q_e, p_e], and of the energy of the tissue.",
    "times.png": "Error of the deformation of all stable models against the time of a run, and against offline plus "
    "online time. Bold: the models that no other beats in both. Dashed: the full run with its matrix factored "
    "beforehand.",
    "sigma.png": "Singular values over the first of each decomposition; thin lines are its further parts. Those of "
    "PSD are symplectic or of complex snapshots, each a pair of columns.",
    "modes.png": "First modes of the best method of the paper that keeps the hand apart, and of Craig-Bampton or the "
    "best beyond the paper, scaled to the same largest displacement. Colour: displacement relative to the hand. The "
    "paper's modes contain absolute displacements of the tissue alone, and columns of their own move the hand: here "
    "the hand follows the tissue beside it.",
    "compare.png": "Reduced bodies under the outline of the full one, at instants of large deformation or error.",
    "compare.gif": "The same in motion.",
}
PULL = "In pull.html, listed below, the mouse pulls the hand and a reduced model of the tissue follows."
HOW = "Each method is built from the snapshots of one run and repeats it, driven by the same hand."


def compose(study: ReductionStudy, drawn: Sequence[Path], models: Sequence[Path], pulled: Path | None = None) -> Page:
    """The page; ``drawn``: pictures, ``models``: files of the reduced models, ``pulled``: the page with the mouse."""
    scene, sweeps, figures = study.full.model.scene, study.sweeps, captioned(drawn, CAPTIONS)
    energy, refused = scene.reduction.energy, refused_table(sweeps)
    notes = (N_NOTE, error_note(energy), inner_note(sweeps))
    parts = [
        Section("", figures=[(file, text) for file, text in figures if file.name in FIRST]),
        error_table(sweeps, energy).section(HOW, details="\n\n".join(notes), terminal=True),
        Section("Findings", text="\n\n".join(study.findings), terminal=True),
        time_table(study).section(details="\n\n".join(study.speed_notes), terminal=True),
        *([refused.section(terminal=True)] if refused.rows else []),
        *box_sections(study.box, scene.effects.damping is not None),
        Section(
            "Pictures", PULL if pulled else "", figures=[(file, t) for file, t in figures if file.name not in FIRST]
        ),
    ]
    tables, files = {"points.csv": point_table(study)}, [*drawn, *models, *([pulled] if pulled else [])]
    return Page(f"{scene.name}: reduced models", summary(study), parts, tables, files, errors=headline(study))


def error_table(sweeps: Sequence[MethodSweep], energy: float) -> Table:
    """N by energy, errors at the N nearest to the one compared, least N for some errors, stability."""
    columns: Columns = {
        "method": "s.method.short_title", f"{100 * energy:g} %": "s.N_energy 3", "N": _size,
        "V_e": lambda r: r["p"] and "+".join(map(str, r["p"].split)), "deform.": "p.error_deformation %",
        "state": "p.error %", "energy": "p.error_energy %",
        **{f"to {percent(x)}": lambda r, x=x: least_size(r["s"].points, x) or "-" for x in LEVELS},  # type: ignore[misc]
        "stable N": lambda r: stability(r["s"]),
    }  # fmt: skip
    return table_of([{"s": s, "p": nearest(s.points, stable=False)} for s in sweeps], columns, "Errors")


def _size(row: dict[str, Any]) -> str:
    p = row["p"]
    return "-" if p is None else str(p.N) if p.stable else f"{p.N} !"


def least_size(points: Sequence[Point], level: float) -> int | None:
    """Least N of a stable model whose error of the deformation is at most ``level``."""
    return min((p.N for p in points if p.stable and p.error_deformation <= level), default=None)


def stability(sweep: MethodSweep) -> str:
    """At which N a method is stable, in few words."""
    points = sweep.points
    if not points:
        return "refused" if sweep.refused else "no model"
    bad = [p.N for p in points if not p.stable]
    if not bad:
        return f"all, {points[0].N} to {points[-1].N}"
    return "none" if len(bad) == len(points) else "not " + ", ".join(map(str, bad))


def error_note(energy: float) -> str:
    """What the columns of the first table hold; ``energy``: share of the scene."""
    return (
        f"Energy of {100 * energy:g} %: N that keeps this share of the energy of the snapshots. Then, at the N nearest "
        f"to {COMPARED}, the relative errors of the deformation, of the state [q_s, v_s, q_e, v_e] (the paper's error) "
        "and of the energy, the same for every method; the least N of a stable model with an error of the deformation "
        f"up to {', '.join(map(percent, LEVELS))}; !: unstable. fixed: with fixed solid modes."
    )


def refused_table(sweeps: Sequence[MethodSweep]) -> Table:
    """N that were refused, the methods, and the one reason: methods and N that share it stand together."""
    groups: dict[tuple[str, str], list[str]] = {}
    for s in sweeps:
        for reason in dict.fromkeys(s.refused.values()):
            sizes = ", ".join(str(N) for N, why in s.refused.items() if why == reason)
            groups.setdefault((sizes, reason), []).append(s.method.short_title)
    rows = [(sizes, "; ".join(titles), reason) for (sizes, reason), titles in groups.items()]
    return Table(("N", "method", "reason"), rows, "Refused")


def headline(study: ReductionStudy) -> list[str]:
    """Error and speed of the most accurate stable model at the N compared."""
    if not (chosen := by_error(study.sweeps)):
        return []
    s, point = chosen[0]
    tested = [e for e in study.box.summary if (e.method, e.N) == (s.method.key, point.N) and e.runs <= 1]
    others = f"not tested at new materials ({study.box.none})"
    if tested:
        others = f"{percent(tested[0].median)} in the median and {percent(tested[0].largest)} at most at new materials"
    return [
        f"At N = {point.N} the most accurate stable model is {s.method.title}.",
        *([] if study.turns is None else [study.turns.sentence(point.error_deformation, others)]),
    ]


def summary(study: ReductionStudy) -> list[str]:
    """How many methods are stable."""
    held = [s for s in study.sweeps if s.points and all(p.stable for p in s.points)]
    if not by_error(study.sweeps):
        return ["No method has a stable model."]
    return [f"{len(held)} of {len(study.sweeps)} methods are stable at every N that was tried."]


def time_table(study: ReductionStudy) -> Table:
    """Seconds and speed-ups."""
    rows = [timed(p, study.times, method=method.short_title) for method, p in timed_points(study.sweeps)]
    return table_of(rows, {"method": "method", "N": _size, **TIMES}, "Times")


def box_table(box: DomainTests) -> Table:
    """Errors at other parameters, trained by one run or by several."""
    titles = {m.method.key: m.method.short_title for m in box.models}
    columns: Columns = {
        "method": lambda e: titles[e.method], "N": "N", "runs": lambda e: e.runs or "-", "own": "own %",
        "median": "median %", "largest": "largest %",
    }  # fmt: skip
    return table_of(box.summary, columns, "Other parameters")


def box_note(box: DomainTests) -> str:
    """What the table of other parameters shows."""
    tests, (lam, mu) = sum(not p.trained for p in box.points), box.ranges
    text = (
        f"Deformation error at the scene's own parameter, and median and largest over {tests} others with lambda in "
        f"[{lam[0]:.3g}, {lam[1]:.3g}] and mu in [{mu[0]:.3g}, {mu[1]:.3g}] Pa."
    )
    if not box.trained_at:
        return f"{text} Bases: from the scene's run; set reduction.train to train them by more."
    return (
        f"{text} Bases: from the scene's run, or from {len(box.trained_at)} runs with as many snapshots altogether "
        f"(reduction.train); parameters that trained one are no tests."
    )


def inner_note(sweeps: Sequence[MethodSweep]) -> str:
    """Which methods were built in which inner product."""
    groups: dict[str, list[str]] = {}
    for s in sweeps:
        if s.inner:
            groups.setdefault(s.inner, []).append(s.method.short_title)
    if len(groups) < 2:
        return f"Inner product: {next(iter(groups), 'none')}."
    most = max(groups, key=lambda inner: len(groups[inner]))
    others = [f"{inner} for {'; '.join(titles)}" for inner, titles in groups.items() if inner != most]
    return f"Inner product: {', '.join(others)}; else {most}."


def point_table(study: ReductionStudy) -> Table:
    """All points, numbers in full."""
    names = tuple(f.name + POINT_UNITS.get(f.name, "") for f in fields(Point))
    return Table(("method", *names), [(s.method.key, *astuple(p)) for s in study.sweeps for p in s.points])


def box_sections(box: DomainTests, damped: bool) -> list[Section]:
    """Errors at other parameters: a summary, and one table for each N with a column for each basis."""
    if box.none:
        return [Section("Other parameters", f"No tests at other parameters: {box.none}.", terminal=True)]
    text = "Vibrations of slightly wrong frequency drift out of phase, so errors grow with the run"
    text += " until damping has ended them." if damped else "."
    parts = [box_table(box).section(box_note(box), details=text, terminal=True)]
    for N in sorted({m.model.N for m in box.models}):
        shown = [(i, m) for i, m in enumerate(box.models) if m.model.N == N]
        names = (m.method.short_title + (", several runs" if m.several else "") for _, m in shown)
        rows = [
            (f"{p.lam:.4g}", f"{p.mu:.4g}", "trained" if p.trained else "test",
             *(percent(p.errors[i]) for i, _ in shown))
            for p in box.points
        ]  # fmt: skip
        table = Table(("lambda [Pa]", "mu [Pa]", "", *names), rows)
        parts.append(table.section(f"All parameters, N = {N}.", best=None))
    return parts


def findings(sweeps: Sequence[MethodSweep]) -> tuple[str, ...]:
    """How many models are unstable with structure and without, and the least errors of both."""
    shown = [s for s in sweeps if s.points]
    return (*_stability(shown), *_structure(shown)) if shown else ()


def _stability(sweeps: Sequence[MethodSweep]) -> Iterator[str]:
    for keeps, label in ((True, "keep the structure"), (False, "do not keep the structure")):
        group = [s for s in sweeps if s.method.preserving == keeps]
        bad = [(s.method.short_title, [p.N for p in s.points if not p.stable]) for s in group]
        total, count = sum(len(s.points) for s in group), sum(len(sizes) for _, sizes in bad)
        where = "; ".join(f"{title} at N = {', '.join(map(str, sizes))}" for title, sizes in bad if sizes)
        unstable = {0: "none is unstable.", 1: f"one is unstable: {where}."}.get(
            count, f"{count} are unstable: {where}."
        )
        if total:
            yield f"Of the {total} models that {label}, {unstable}"


def _structure(sweeps: Sequence[MethodSweep]) -> Iterator[str]:
    N = min({p.N for s in sweeps for p in s.points}, key=lambda N: (abs(N - COMPARED), N))
    groups = [
        [(s, p) for s in sweeps if s.method.preserving == keeps for p in s.points if p.N == N and p.stable]
        for keeps in (True, False)
    ]
    if not all(groups):
        return
    (s, p), (t, q) = (min(group, key=lambda b: b[1].error_deformation) for group in groups)
    tiny = np.finfo(float).tiny
    ratio = max(p.error_deformation, tiny) / max(q.error_deformation, tiny)
    yield (
        f"At N = {N} the least error of the deformation of a stable model is {percent(p.error_deformation)} with "
        f"structure ({s.method.short_title}) and {percent(q.error_deformation)} without ({t.method.short_title}): "
        f"structure {'raises' if ratio > 1 else 'lowers'} it by a factor of {max(ratio, 1 / ratio):.1f}."
    )
