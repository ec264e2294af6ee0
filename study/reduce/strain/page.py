"""The page of ``softgrasp reduce`` at finite strain, parts of which a terminal shows too, and its tables."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np

from softgrasp.study.reduce.strain.result import (
    CELLS_AT,
    HeldOutTest,
    StrainFamily,
    StrainPoint,
    StrainStudy,
    most_accurate,
)
from softgrasp.study.reduce.times import TIMES, timed
from softgrasp.study.report import Columns, Page, Section, Table, captioned, percent, table_of

CAPTIONS = {
    "strain_errors.png": "Error of the deformation z against N, and against the number of sampled cells at some N. "
    "Filled: over the runs that trained the models; open: largest of the held-out runs. Dotted: the same models on all "
    "cells. Grey: linear elasticity on the same scene.",
    "cells.png": "Cells that the models evaluate, and their weights: for how many cells of the body each of them is. "
    "In 3D a dot stands for a cell.",
}
NOTE = (
    "N counts the hand's 2 n_s, as for linear models. cells: those with a weight. own: error of z on the scene's own "
    "run, which trained the model; estimate: what the model says of it by itself, from its residual in twice the "
    "columns, no bound; energy: of (z, v) in the energy norm. all cells: error of z over the training runs without "
    "sampling. new material, new motion: largest error of z on full runs inside the box that trained no model; "
    "-: there are none, or the model refuses them. drift: of the model's own energy."
)
ERRORS: Columns = {
    "runs": "f.runs", "N": "p.N", "cells": "p.cells", "own": "p.error_own %", "estimate": "p.estimate_own %",
    "energy": "p.error_own_energy_norm %", "all cells": "p.error_galerkin %", "new material": "p.error_materials %",
    "new motion": "p.error_motions %", "drift": "p.drift .0e",
}  # fmt: skip
CELLS: Columns = {
    "runs": "f.runs", "N": "p.N", "tau": "p.tau .1e", "cells": "p.cells", "own": "p.error_own %",
    "new material": "p.error_materials %", "new motion": "p.error_motions %",
    "run [ms]": lambda r: f"{1e3 * r['p'].time_online:.2f}",
}  # fmt: skip


def compose(study: StrainStudy, drawn: Sequence[Path], models: Sequence[Path]) -> Page:
    """The page; ``drawn``: pictures, ``models``: files of the reduced models."""
    pairs = [{"f": f, "p": p} for f in study.families for p in f.points]
    curves = [
        {"f": f, "p": p}
        for f in study.families
        for p in sorted((p for p in f.curves if p.N in CELLS_AT), key=lambda p: (p.N, -p.tau))
    ]
    times = [timed(p, study.times, f=f) for f in study.families for p in f.points]
    held = [test_table(f).section(title=f"Held-out runs, models {f.title}") for f in study.families if f.tests]
    parts = [
        Section("", figures=captioned(drawn, CAPTIONS)),
        table_of(pairs, ERRORS, "Errors").section(details=NOTE, terminal=True),
        table_of(times, {"runs": "f.runs", "N": "p.N", "cells": "p.cells", **TIMES}, "Times").section(terminal=True),
        Section("Findings", "\n\n".join(sentences(study)), terminal=True),
        table_of(curves, CELLS, "Cells").section(),
        *held,
    ]
    names = (field.name for field in fields(StrainPoint))
    points = Table(("runs", *names), [(f.runs, *asdict(p).values()) for f in study.families for p in f.curves])
    model = study.full.model
    title = f"{model.scene.name}: reduced models at finite strain, {study.families[-1].points[0].engine} stepper"
    law = "" if model.system.points is None else f" (law: {model.system.points.law})"
    linear = f"Linear elasticity has an error of {percent(study.linear)} of the deformation of this scene{law}."
    files = [*drawn, *models]
    return Page(title, [linear], parts, {"points.csv": points}, files, errors=headline(study))


def test_table(family: StrainFamily) -> Table:
    """Every held-out run with a column for each N: the error, and its estimate in brackets."""

    def missed(t: HeldOutTest, N: int) -> str:
        error, estimate = ("-" if x is None else percent(x) for x in (t.errors[N], t.estimates[N]))
        return f"{error} ({estimate})"

    sizes = [p.N for p in family.points]
    turns = any(len(family.box.load) > len(t.target) for t in family.tests)
    unit = "target [m, rad]" if turns else "target [m]"
    rows = [
        (t.kind, f"{t.lam:.4g}", f"{t.mu:.4g}", ", ".join(f"{x:.3g}" for x in t.target), *(missed(t, N) for N in sizes))
        for t in family.tests
    ]
    return Table(("new", "lambda [Pa]", "mu [Pa]", unit, *(f"N = {N}" for N in sizes)), rows)


def sentences(study: StrainStudy) -> list[str]:
    """What the models answer for, and how good their estimates are."""
    full = study.full
    lines = [
        f"Full model: {len(full.trajectory.times) - 1} steps in {study.times.steps:.3g} s, factorisation "
        f"{1e3 * study.times.factor:.3g} ms. x again: its steps over a run of the same reduced model again. x new: "
        "factorisation and steps over a new parameter with its run. offline: basis, model on all cells, forces and "
        "weights; the full runs that train a model come on top.",
    ]
    for f in study.families:
        lam, mu, load = f.box.lam[0], f.box.mu[0], np.abs(f.box.load).max(axis=1)
        spin = ""
        if full.model.system.frame is not None:  # the last row of the box
            spin, load = f" and an angular velocity up to {load[-1]:.3g} rad/s", load[:-1]
        inside = f"lambda in [{lam[0]:.4g}, {lam[1]:.4g}] and mu in [{mu[0]:.4g}, {mu[1]:.4g}] Pa"
        if f.key == "own" and lam[0] == lam[1] and mu[0] == mu[1]:
            inside = f"lambda = {lam[0]:.4g}, mu = {mu[0]:.4g} Pa only"
        lines.append(
            f"Models {f.title} ({f.runs} full run{'s' if f.runs > 1 else ''}) answer for {inside} and "
            f"accelerations of the hand up to {', '.join(f'{x:.3g}' for x in load)} by degree of freedom{spin}; they "
            "refuse what lies outside."
        )
        errors = {N: [e for t in f.tests if (e := t.errors.get(N)) is not None] for N in f.models}
        best = min(((statistics.median(e), N) for N, e in errors.items() if e), default=None)
        if best is not None:
            lines.append(f"Median error over {len(f.tests)} held-out runs: least at N = {best[1]}, {percent(best[0])}.")
        pairs = [(t.estimates[N], error) for t in f.tests for N, error in t.errors.items()]
        ratios = [estimate / error for estimate, error in pairs if estimate is not None and error]
        if ratios:
            shares = [p.time_estimate / p.time_online for p in f.points]
            lines.append(
                f"The models estimate their own errors, an estimate and no bound: {min(ratios):.2g} to "
                f"{max(ratios):.2g} times the true ones of {len(ratios)} held-out runs, in {min(shares):.2g} to "
                f"{max(shares):.2g} times the time of a run."
            )
        lines += [f"N = {N} refused: {reason}." for N, reason in f.refused.items()]
    if {p.engine for f in study.families for p in f.points} == {"NumPy"}:
        lines.append("No C compiler was found, so the reduced runs stepped in NumPy, about thirty times slower.")
    if study.none:
        lines.append(f"No runs at other materials: {study.none}.")
    return lines


def headline(study: StrainStudy) -> list[str]:
    """Error and speed of the most accurate model."""
    p, f = most_accurate(study.families)
    held = [e for t in f.tests if (e := t.errors.get(p.N)) is not None]
    others = "not tested on other runs"
    if held:
        median, largest = percent(statistics.median(held)), percent(max(held))
        others = f"{median} in the median and {largest} at most on {len(held)} held-out runs"
    if f.key == "own":
        others += "; it refuses other materials"
    return [
        f"The most accurate reduced model, {f.title}, has N = {p.N} columns and {p.cells} sampled cells.",
        study.turns.sentence(p.error_own, others),
    ]
