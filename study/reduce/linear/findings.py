"""What a sweep over bases and N shows, in sentences that its numbers make: best methods, structure, the paper."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np

from softgrasp.reduction.bases.registry import PAPER_METHODS, PAPER_PLAIN
from softgrasp.study.reduce.linear.result import COMPARED, MethodSweep, Point

MEASURES = (
    ("error_deformation", "the deformation"),
    ("error", "the state [q_s, v_s, q_e, v_e]"),
    ("error_canonical", "[q_s, p_s, q_e, p_e]"),
)


def leader(sweeps: Sequence[MethodSweep], N: int, key: str, stable: bool = True) -> tuple[MethodSweep, Point] | None:
    """Method with the least value at exactly N, among stable models or all; None without any."""
    models = [
        (getattr(p, key), k, s, p)
        for k, s in enumerate(sweeps)
        for p in s.points
        if p.N == N and np.isfinite(getattr(p, key)) and (p.stable or not stable)
    ]
    return min(models)[2:] if models else None


def all_sizes(sweeps: Sequence[MethodSweep]) -> list[int]:
    """All N of any method, ascending."""
    return sorted({p.N for s in sweeps for p in s.points})


def findings(sweeps: Sequence[MethodSweep]) -> tuple[str, ...]:
    """Who is best at which N in which measure, what structure buys, and whether the paper's ranking holds."""
    shown = [s for s in sweeps if s.points]
    return (*_best(shown), *_stability(shown), *_structure(shown), *_paper(shown)) if shown else ()


def _best(sweeps: Sequence[MethodSweep]) -> Iterator[str]:
    seen: dict[tuple[tuple[str, int], ...], str] = {}
    for key, name in MEASURES:
        best = [b for N in all_sizes(sweeps) if (b := leader(sweeps, N, key)) is not None]
        order = tuple((s.method.key, p.N) for s, p in best)
        if order in seen:
            yield f"In {name} the same methods lead as in {seen[order]}."
        elif best:
            seen[order] = name
            rows = [list(group) for _, group in groupby(best, key=lambda b: b[0].method.key)]
            texts = [_span(row[0][0], [p for _, p in row], key) for row in rows]
            yield f"Least error of {name} among stable models: {'; '.join(texts)}."


def _span(s: MethodSweep, points: Sequence[Point], key: str) -> str:
    """Method, its N, and the value at the N compared where it is among the points, else at the last."""
    span = " to ".join(str(N) for N in sorted({points[0].N, points[-1].N}))
    p = next((p for p in points if p.N == COMPARED), points[-1])
    at = f" at N = {p.N}" if len(points) > 1 else ""
    return f"{s.method.short_title} at N = {span} ({getattr(p, key):.1e}{at})"


def _stability(sweeps: Sequence[MethodSweep]) -> Iterator[str]:
    for keeps, label in ((True, "that keep the structure"), (False, "that do not")):
        group = [s for s in sweeps if s.method.preserving == keeps]
        bad = [(s.method.short_title, [p.N for p in s.points if not p.stable]) for s in group]
        total, count = sum(len(s.points) for s in group), sum(len(sizes) for _, sizes in bad)
        where = "; ".join(f"{title} at N = {', '.join(map(str, sizes))}" for title, sizes in bad if sizes)
        if total:
            yield f"Unstable models among the {total} {label}: " + (f"{count} ({where})." if count else "none.")


def _structure(sweeps: Sequence[MethodSweep]) -> Iterator[str]:
    N = min(all_sizes(sweeps), key=lambda N: (abs(N - COMPARED), N))
    groups = [
        [(s, p) for s in sweeps if s.method.preserving == keeps for p in s.points if p.N == N and p.stable]
        for keeps in (True, False)
    ]
    if not all(groups):
        return
    kept, lost = ([p.error_energy for _, p in group] for group in groups)
    yield (
        f"Error of the tissue's energy at N = {N}: {min(kept):.1e} to {max(kept):.1e} in models that keep the "
        f"structure, {min(lost):.1e} to {max(lost):.1e} in stable models that do not."
    )
    (s, p), (t, q) = (min(group, key=lambda b: b[1].error_deformation) for group in groups)
    tiny = np.finfo(float).tiny
    ratio = max(p.error_deformation, tiny) / max(q.error_deformation, tiny)
    verdict = f"structure {'costs' if ratio > 1 else 'gains'} a factor of {max(ratio, 1 / ratio):.1f}"
    yield (
        f"Least error of the deformation at N = {N}: {p.error_deformation:.1e} with structure "
        f"({s.method.short_title}), {q.error_deformation:.1e} without ({t.method.short_title}, stable at this N), so "
        f"{verdict} here."
    )


def _paper(sweeps: Sequence[MethodSweep]) -> Iterator[str]:
    """The paper's two statements on its six methods, in its own error, at every N where both sides have a model."""
    six = [s for s in sweeps if s.method.key in PAPER_METHODS]
    others = [s for s in six if s.method.key in PAPER_PLAIN]
    yield from _statement(
        "PSD, and all with fixed solid modes, which it calls structure-preserving, are better than the other POD bases",
        [s for s in six if s.method.key not in PAPER_PLAIN], others, "for the former", "for the latter",
    )  # fmt: skip
    psd = [s for s in six if s.method.key == "psd"]
    others = [s for s in six if s.method.key != "psd"]
    yield from _statement("PSD without fixed solid modes is the best", psd, others, "for it", "for the best other")


def _statement(
    text: str, left: Sequence[MethodSweep], right: Sequence[MethodSweep], one: str, other: str
) -> Iterator[str]:
    pairs = [
        (N, a, b)
        for N in all_sizes([*left, *right])
        if (a := leader(left, N, "error", stable=False)) and (b := leader(right, N, "error", stable=False))
    ]
    if not pairs:
        return
    holds = [N for N, (_, p), (_, q) in pairs if p.error < q.error]
    fails = [N for N, *_ in pairs if N not in holds]
    N, (s, p), (t, q) = min(pairs, key=lambda pair: (abs(pair[0] - COMPARED), pair[0]))
    verdict = (
        "this holds at every N" if not fails
        else "this holds at no N" if not holds
        else f"this holds but for N = {', '.join(map(str, fails))}" if len(fails) < len(holds)
        else f"this holds at N = {', '.join(map(str, holds))} only"
    )  # fmt: skip
    left_title, right_title = (x.method.short_title + ("" if y.stable else ", unstable") for x, y in ((s, p), (t, q)))
    yield (
        f"The paper: among its six methods, {text}. Here, in its own error of the state, {verdict}; at N = {N}: "
        f"{p.error:.1e} {one} ({left_title}), {q.error:.1e} {other} ({right_title})."
    )
