"""Tables, sentences and page of ``softgrasp reduce``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, fields
from pathlib import Path

from softgrasp.reduction.bases.registry import Method
from softgrasp.study.reduce.linear.result import (
    COMPARED,
    N_NOTE,
    DomainTests,
    MethodSweep,
    Point,
    ReductionStudy,
    by_error,
    nearest,
    timed_points,
)
from softgrasp.study.reduce.tables import TIMES, short, time_cells
from softgrasp.study.report.page import Section, captioned
from softgrasp.study.report.tables import Table

LEVELS = (1e-1, 1e-2, 1e-3)  # of the error of the deformation, for which the least N is named
LEVEL_NAMES = tuple(f"{level:.0e}".replace("e-0", "e-") for level in LEVELS)
CAPTIONS = {
    "errors.png": "Error of the deformation of the paper's six methods against N, all columns of V counted. A curve "
    "is dotted where its model is unstable (crosses). Errors above 1 are drawn at 1.",
    "errors_beyond.png": "The same for the methods beyond the paper, beside its best.",
    "errors_state.png": "Further errors of the paper's six methods: of the state [q_s, v_s, q_e, v_e], which is the "
    "paper's, of [q_s, p_s, q_e, p_e], and of the energy of the tissue.",
    "times.png": "Error of the deformation of all stable models against the time of a run, and against offline plus "
    "online time. Bold: the models that no other beats in both. Dashed: the full run with its matrix factored "
    "beforehand.",
    "sigma.png": "Singular values over the first of each decomposition; thin lines are its further parts. Those of "
    "PSD are symplectic or of complex snapshots, each a pair of columns.",
    "modes.png": "First modes of the best method of the paper that keeps the hand apart, and of Craig-Bampton or the "
    "best beyond the paper, scaled to the same largest displacement. Colour: displacement relative to the hand. The "
    "paper's modes hold absolute displacements of the tissue alone, and columns of their own move the hand: here the "
    "hand stands where the tissue beside it goes.",
    "compare.png": "Reduced bodies under the outline of the full one, at instants of large deformation or error.",
    "compare.gif": "The same in motion.",
}


def least_size(points: Sequence[Point], level: float) -> int | None:
    """Least N of a stable model whose error of the deformation is at most ``level``."""
    return min((p.N for p in points if p.stable and p.error_deformation <= level), default=None)


def title_of(method: Method, narrow: bool) -> str:
    """The name of a method in a table, short in a narrow one."""
    return method.short_title if narrow else method.title


def stability(points: Sequence[Point]) -> str:
    """At which N a method is stable, in few words."""
    bad = [p.N for p in points if not p.stable]
    if not points:
        return "no model"
    if not bad:
        return f"all, {points[0].N} to {points[-1].N}"
    if len(bad) == len(points):
        return "none"
    return "not " + ", ".join(map(str, bad))


def _size(p: Point) -> str:
    return str(p.N) if p.stable else f"{p.N} !"


def error_table(sweeps: Sequence[MethodSweep], energy: float, narrow: bool = False) -> Table:
    """N by energy, errors at the N nearest to the one compared, least N for some errors, stability."""
    header = ("method", f"{100 * energy:g} %", "N", "V_e", "deform.", "state", "energy", *LEVEL_NAMES, "stable N")
    rows = []
    for s in sweeps:
        p, cells = nearest(s.points, stable=False), ["" for _ in header[2:-1]]
        if p is not None:
            errors = (f"{value:.1e}" for value in (p.error_deformation, p.error, p.error_energy))
            least = ("-" if (n := least_size(s.points, level)) is None else str(n) for level in LEVELS)
            cells = [_size(p), "+".join(map(str, p.split)), *errors, *least]
        stable = stability(s.points) if s.points else "refused" if s.refused else "no model"
        rows.append((title_of(s.method, narrow), "-" if s.N_energy is None else str(s.N_energy), *cells, stable))
    return Table(header, rows, "Errors")


def error_note(energy: float) -> str:
    """What the columns of the first table hold; ``energy``: share of the scene."""
    return (
        f"{100 * energy:g} %: N that keeps this share of the energy of the snapshots. Then, at the N nearest to "
        f"{COMPARED}, the relative errors of the deformation, of the state [q_s, v_s, q_e, v_e] (the paper's error) "
        "and of the energy, the same for every method; the least N of a stable model with an error of the deformation "
        f"up to {', '.join(LEVEL_NAMES)}; !: unstable."
    )


def refused_table(sweeps: Sequence[MethodSweep], narrow: bool = False) -> Table:
    """N that were refused, the methods, and the one reason: methods and N that share it stand together."""
    groups: dict[tuple[str, str], list[str]] = {}
    for s in sweeps:
        for reason in dict.fromkeys(s.refused.values()):
            sizes = ", ".join(str(N) for N, why in s.refused.items() if why == reason)
            groups.setdefault((sizes, reason), []).append(title_of(s.method, narrow))
    rows = [(sizes, "; ".join(titles), reason) for (sizes, reason), titles in groups.items()]
    return Table(("N", "method", "reason"), rows, "Refused")


def summary(study: ReductionStudy) -> list[str]:
    """What came out, in three sentences."""
    if not (chosen := by_error(study.sweeps)):
        return ["No method has a stable model."]
    s, point = chosen[0]
    held = [s for s in study.sweeps if s.points and all(p.stable for p in s.points)]
    tested = [e for e in study.box.summary if (e.method, e.N) == (s.method.key, point.N) and e.runs <= 1]
    others = f"not tested at new materials ({study.box.none})"
    if tested:
        others = f"{tested[0].median:.2%} in the median and {tested[0].largest:.2%} at most at new materials"
    return [
        f"At N = {point.N} the most accurate stable model is {s.method.title}.",
        *([] if study.turns is None else [study.turns.sentence(point.error_deformation, others)]),
        f"{len(held)} of {len(study.sweeps)} methods are stable at every N that was tried.",
    ]


def time_table(study: ReductionStudy, narrow: bool = False) -> Table:
    """Seconds and speed-ups."""
    chosen = timed_points(study.sweeps)
    rows = [(title_of(method, narrow), _size(p), *time_cells(p, study.times)) for method, p in chosen]
    return Table(("method", "N", *TIMES), rows, "Times")


def box_table(box: DomainTests, narrow: bool = False) -> Table:
    """Errors at other parameters, trained by one run or by several."""
    titles = {m.method.key: title_of(m.method, narrow) for m in box.models}
    rows = [
        (titles[e.method], str(e.N), str(e.runs or "-"), *map(short, (e.own, e.median, e.largest))) for e in box.summary
    ]
    return Table(("method", "N", "runs", "own", "median", "largest"), rows, "Other parameters")


def box_note(box: DomainTests) -> str:
    """What the table of other parameters shows."""
    tests, (lam, mu) = sum(not p.trained for p in box.points), box.ranges
    text = (
        f"Deformation error at the scene's own parameter, and median and largest over {tests} others with lambda in "
        f"[{lam[0]:g}, {lam[1]:g}] and mu in [{mu[0]:g}, {mu[1]:g}]."
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
    units = {"spectral_abscissa": " [1/s]", "time_offline": " [s]", "time_setup": " [s]", "time_online": " [s]"}
    names = tuple(f.name + units.get(f.name, "") for f in fields(Point))
    return Table(("method", *names), [(s.method.key, *astuple(p)) for s in study.sweeps for p in s.points])


def sections(study: ReductionStudy, files: Sequence[Path]) -> list[Section]:
    """Parts of the page. Rank 0 only."""
    energy = study.full.model.scene.reduction.energy
    text = (
        f"{N_NOTE}\n\n{error_note(energy)} Each method is built from the snapshots of one run and "
        f"repeats it, driven by the same hand. {inner_note(study.sweeps)}"
    )
    parts = [
        error_table(study.sweeps, energy).section(text),
        Section("What holds", text="\n\n".join(study.findings)),
        Section("", figures=captioned(files, CAPTIONS)),
        time_table(study).section("\n\n".join(study.speed_notes)),
    ]
    refused = refused_table(study.sweeps)
    parts += [refused.section()] if refused.rows else []
    return [*parts, *box_sections(study.box)]


def box_sections(box: DomainTests) -> list[Section]:
    """Errors at other parameters: a summary, and one table for each N with a column for each basis."""
    if box.none:
        return [Section("Other parameters", f"No tests at other parameters: {box.none}.")]
    text = " Undamped vibrations of slightly wrong frequency drift out of phase, so errors grow with the run."
    parts = [box_table(box).section(box_note(box) + text)]
    for N in sorted({m.model.N for m in box.models}):
        shown = [(i, m) for i, m in enumerate(box.models) if m.model.N == N]
        names = (m.method.title + (", several runs" if m.several else "") for _, m in shown)
        rows = [
            (f"{p.lam:.4g}", f"{p.mu:.4g}", "trained" if p.trained else "test", *(p.errors[i] for i, _ in shown))
            for p in box.points
        ]
        table = Table(("lambda [Pa]", "mu [Pa]", "", *names), rows)
        parts.append(table.section(f"All parameters, N = {N}."))
    return parts
