"""Tables of ``softgrasp reduce``: errors, stability, times against our own full model, and all points as CSV."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.study.reduce.box import Box, summary
from softgrasp.study.reduce.sweep import COMPARED, Point, Swept, nearest

LEVELS = (1e-1, 1e-2, 1e-3)  # of the error of the deformation, for which the least N is named
PAPER_FULL, PAPER_REDUCED = 16.22, 0.097  # seconds of [SBRH21]: 2n = 1916, 600 steps, and PSD at N = 14
LEAST_MESH = 50  # tissue unknowns: a body of fewer deforms in no useful way
N_NOTE = (
    "N counts all columns of V for every method, as in the paper, also the hand's own 2 n_s of bases with fixed solid "
    "modes. V_e: those without the hand's (N_tissue), for componentwise POD displacements + velocities."
)


@dataclass(frozen=True)
class FullTimes:
    """Seconds of the full model: the steps of a run alone, and the factorisation before them."""

    steps: float
    factor: float


@dataclass(frozen=True)
class Speed:
    """One method against the full model at the stable N nearest to the one compared.

    Attributes:
        method, title: which.
        N: columns of V.
        N_tissue: those without the hand's own.
        stable: no model is otherwise; False when the method has no stable one.
        time_offline, time_setup, time_online: [s].
        speedup_same_model: full steps over a reduced run of the same model again, both with everything prefactored.
        speedup_new_parameter: full factorisation and steps over reduced set-up and run.
        break_even_runs: time_offline / (full run - reduced run) at new parameters; None when the reduced is not faster.
    """

    method: str
    title: str
    N: int
    N_tissue: int
    stable: bool
    time_offline: float
    time_setup: float
    time_online: float
    speedup_same_model: float
    speedup_new_parameter: float
    break_even_runs: float | None


def speed_of(swept: Swept, full: FullTimes) -> Speed | None:
    """Compare times; None for a method without points."""
    i = nearest(swept.points)
    i = nearest(swept.points, stable=False) if i is None else i
    if i is None:
        return None
    p = swept.points[i]
    whole, new = full.factor + full.steps, p.time_setup + p.time_online
    return Speed(
        method=swept.method.key,
        title=swept.method.title,
        N=p.N,
        N_tissue=p.N_tissue,
        stable=p.stable,
        time_offline=p.time_offline,
        time_setup=p.time_setup,
        time_online=p.time_online,
        speedup_same_model=full.steps / p.time_online,
        speedup_new_parameter=whole / new,
        break_even_runs=p.time_offline / (whole - new) if whole > new else None,
    )


def least_size(points: Sequence[Point], level: float) -> int | None:
    """Least N of a stable model whose error of the deformation is at most ``level``."""
    return min((p.N for p in points if p.stable and p.error_deformation <= level), default=None)


def short(value: float | None, digits: int = 2) -> str:
    """A number for a narrow column; what overflowed says so."""
    if value is None:
        return "-"
    return f"{value:.{digits}g}" if np.isfinite(value) else "overflow"


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


LEVEL_NAMES = tuple(f"{level:.0e}".replace("e-0", "e-") for level in LEVELS)
ERROR_HEADER = ("method", "99.9 %", "N", "V_e", "deform.", "state", "energy", *LEVEL_NAMES, "stable N")
TIME_HEADER = ("method", "N", "run [ms]", "new [ms]", "offline [s]", "x again", "x new", "break-even")


def error_rows(swept: Sequence[Swept]) -> list[tuple[str, ...]]:
    """Rows of the first table: N by energy, errors at the N nearest to the one compared, least N, stability."""
    rows = []
    for s in swept:
        i = nearest(s.points, stable=False)
        kept = "-" if s.kept is None else str(s.kept)
        if i is None:
            rows.append((s.method.title, kept, *[""] * 8, "refused" if s.refused else "no model"))
            continue
        p = s.points[i]
        sizes = ["-" if (n := least_size(s.points, level)) is None else str(n) for level in LEVELS]
        errors = [f"{value:.1e}" for value in (p.error_deformation, p.error, p.error_energy)]
        size = (f"{p.N}" if p.stable else f"{p.N} !", "+".join(map(str, p.split)))
        rows.append((s.method.title, kept, *size, *errors, *sizes, stability(s.points)))
    return rows


def error_note(share: str) -> str:
    """What the columns of the first table hold; ``share`` of the energy in words."""
    return (
        f"{share}: N that keeps this share of the energy of the snapshots. Then, at the N nearest to {COMPARED}, the "
        "relative errors of the deformation, of the state [q_s, v_s, q_e, v_e] (the paper's error) and of the energy, "
        f"the same for every method; the least N of a stable model with an error of the deformation up to "
        f"{', '.join(LEVEL_NAMES)}; !: unstable."
    )


def refused_rows(swept: Sequence[Swept]) -> list[tuple[str, str, str]]:
    """N that were refused, the methods, and the one reason: methods and N that share it stand together."""
    found: dict[tuple[str, str], list[str]] = {}
    for s in swept:
        reasons: dict[str, list[int]] = {}
        for N, reason in s.refused.items():
            reasons.setdefault(reason.removeprefix(f"N = {N}: "), []).append(N)
        for reason, sizes in reasons.items():
            found.setdefault((", ".join(map(str, sizes)), reason), []).append(s.method.title)
    return [(sizes, "; ".join(titles), reason) for (sizes, reason), titles in found.items()]


def time_rows(speeds: Sequence[Speed]) -> list[tuple[str, ...]]:
    """Rows of the second table."""
    return [
        (
            s.title,
            str(s.N) if s.stable else f"{s.N} !",
            f"{1e3 * s.time_online:.2f}",
            f"{1e3 * (s.time_setup + s.time_online):.2f}",
            f"{s.time_offline:.2f}",
            short(s.speedup_same_model, 3),
            short(s.speedup_new_parameter, 3),
            "never" if s.break_even_runs is None else str(math.ceil(s.break_even_runs)),
        )
        for s in speeds
    ]


BOX_HEADER = ("method", "N", "runs", "own", "median", "largest")


def box_rows(box: Box) -> list[tuple[str, ...]]:
    """Rows of the third table: errors at other parameters, trained by one run or by several."""
    titles = {case.method.key: case.method.title for case in box.cases}
    return [
        (titles[r["method"]], str(r["N"]), str(r["runs"] or "-"), *(short(r[k]) for k in ("own", "median", "largest")))
        for r in summary(box)
    ]


def box_note(box: Box, lam: Sequence[float], mu: Sequence[float]) -> str:
    """What the third table shows, with the ranges of lambda and mu [Pa]."""
    tests = sum(not p.trained for p in box.points)
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


def inner_note(swept: Sequence[Swept]) -> str:
    """Which methods were built in which inner product."""
    groups: dict[str, list[str]] = {}
    for s in swept:
        if s.inner:
            groups.setdefault(s.inner, []).append(s.method.title.replace(", fixed solid modes", ", fixed"))
    if len(groups) < 2:
        return f"Inner product: {next(iter(groups), 'none')}."
    most = max(groups, key=lambda inner: len(groups[inner]))
    others = [f"{inner} for {'; '.join(titles)}" for inner, titles in groups.items() if inner != most]
    return f"Inner product: {', '.join(others)}; else {most}."


def break_even_mesh(n_e: int, full: FullTimes, online: float) -> float:
    """Tissue unknowns at which a full run would take as long as a reduced one, at this mesh's time per unknown."""
    return n_e * online / full.steps


def speed_notes(n_e: int, steps: int, full: FullTimes, speeds: Sequence[Speed]) -> list[str]:
    """What the speed-up is measured against, the mesh that pays, and the paper's figure beside ours."""
    notes = [
        f"Full model, prefactored: {steps} steps in {1e3 * full.steps:.1f} ms; its factorisation takes "
        f"{1e3 * full.factor:.1f} ms. new: a new parameter, small matrices, test of stability and propagator with the "
        "run. x again: steps of the full model over a run of the same small model again, all made beforehand on both "
        "sides. x new: factorisation and steps over new. Break-even runs = offline / (full - new), at new parameters; "
        "the full run that gives the snapshots is one more."
    ]
    stable = [s for s in speeds if s.stable]
    chosen = next((s for s in stable if s.method == "psd"), None) or next(iter(stable), None)
    if chosen is None:
        return notes
    mesh, named = break_even_mesh(n_e, full, chosen.time_online), f"{chosen.title}, N = {chosen.N}"
    found = f"at this mesh's time per unknown a full run of n_e = {mesh:.0f} takes as long as the reduced one ({named})"
    if mesh < LEAST_MESH:
        found = (
            f"none, the reduced run ({named}) is faster on every mesh (by its time per unknown from n_e = {mesh:.0f})"
        )
    notes.append(
        f"Break-even mesh: {found}. The reduced time does not grow with the mesh, see "
        "python -m softgrasp.study.bench meshes."
    )
    notes.append(
        f"The paper reports {PAPER_FULL} s against {PAPER_REDUCED} s at 2n = 1916 and N = 14, a speed-up of "
        f"{PAPER_FULL / PAPER_REDUCED:.0f}; here the same comparison, each side from its matrices on, gives "
        f"{1e3 * (full.factor + full.steps):.1f} ms against {1e3 * (chosen.time_setup + chosen.time_online):.2f} ms, "
        f"a speed-up of "
        f"{chosen.speedup_new_parameter:.0f} for a new parameter ({named})."
    )
    return notes


def write_csv(path: Path, swept: Sequence[Swept]) -> Path:
    """All points, one a line, numbers in full. Not collective: rank 0."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        names = list(Point.__dataclass_fields__)
        writer.writerow(["method", *names])
        for s in swept:
            writer.writerows([s.method.key, *asdict(p).values()] for p in s.points)
    return path


def speed_dicts(speeds: Sequence[Speed]) -> list[dict[str, Any]]:
    """For result.json."""
    return [asdict(s) for s in speeds]
