"""What a sweep over bases and N shows, in sentences that its numbers make: stability, and what structure costs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from softgrasp.study.reduce.linear.result import COMPARED, MethodSweep
from softgrasp.study.report import percent


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
