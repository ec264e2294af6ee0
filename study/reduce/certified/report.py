"""Tables and sentences of a certified model."""

from __future__ import annotations

from typing import Any

import numpy as np

from softgrasp.reduction.certified.certificate import NORMS
from softgrasp.reduction.certified.greedy import REASONS
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.certified.trainer import Validation
from softgrasp.study.reduce.certified.result import BoxCheck
from softgrasp.study.report.tables import Table

CAPTIONS = {
    "certified_box.png": "Error of the reduction over the box, relative to the largest energy norm of the deformation: "
    "the proved bound, the estimate by two bases, and the truth from full runs at parameters that were not trained.",
    "certified_greedy.png": "The greedy: largest bound on its grid after every round, and where it ran the full model "
    "(numbers: rounds; a place may come again). With two bases it goes on to half the tolerance: the rest is for "
    "the small basis.",
    "certified_sizes.png": "Leading parts of the basis: bound over true error at the tests (line: median, bar: from "
    "least to largest), and largest error against the time of an answer, beside the time of a full run.",
}


def shown(bound: float) -> str:
    """A bound in few letters."""
    return f"{bound:.1e}" if np.isfinite(bound) else "above 1"


def tests_table(check: BoxCheck) -> Table:
    """One row a size and test."""
    rows = [
        (s.k, s.k2, t.lam, t.mu, t.truth, t.estimate if np.isfinite(t.estimate) else None, t.bound, t.effectivity)
        for s in check.sizes
        for t in s.tested
    ]
    header = ("k", "k2", "lambda [Pa]", "mu [Pa]", "true error", "estimate", "bound", "bound / true error")
    return Table(header, rows, "Tests")


def greedy_table(certified: CertifiedModel) -> Table:
    """One row a round."""
    hand, points = 2 * len(certified.fine.parts["M_hand"]), certified.training["points"]
    rows = [
        (
            i + 1, *(f"{x:.4g}" for x in points[r["at"]]), r["k"], hand + 2 * r["k"], shown(r["bound"]),
            *(f"{x:.4g}" for x in points[r["worst"]]), r["evaluations"], f"{r['seconds']:.1f}",
        )
        for i, r in enumerate(certified.training["rounds"])
    ]  # fmt: skip
    header = (
        "round", "trained at lambda [Pa]", "mu [Pa]", "k", "N", "largest bound", "at lambda [Pa]", "at mu [Pa]",
        "bounds computed", "time [s]",
    )  # fmt: skip
    return Table(header, rows, "The greedy")


def sentences(certified: CertifiedModel, check: BoxCheck | None, result: dict[str, Any]) -> list[str]:
    """What was built and how good it is."""
    about, time, share = result["certified"], result["time"], certified.training["proved"]
    lines = [f"The certified model has N = {about['N']} columns"]
    if certified.k < certified.k2:
        lines[0] += f" and is measured by one of N = {about['N2']}"
    if np.isfinite(share):
        lines[0] += (
            f": its error is at most {share:.1e} of the {NORMS[certified.norm]} everywhere on the grid and at "
            f"{about['checked'] - len(certified.training['points'])} random parameters, "
            f"{'estimated' if certified.certify == 'estimate' else 'proved'}."
        )
    else:
        lines[0] += ": in parts of the box its bound is larger than the deformation itself."
    if share > about["tolerance"]:
        lines[0] += f" That is above the tolerance {about['tolerance']:g}: runs above it are refused."
    lines.append(f"The greedy stopped after {len(about['rounds'])} rounds: {REASONS[about['reason']]}.")
    if added := len(about["added"]):
        lines.append(f"Of the random parameters {added} had a larger bound than the grid and were trained on too.")
    if "validation" in about:
        v = Validation(**about["validation"])
        if v.factor is not None:  # null in result.json where there is no estimate
            lines.append(
                f"In {v.n} random full runs the error was at most {v.factor:.3g} times the estimate; with 95 % "
                f"confidence it is larger on at most {v.share:.1%} of the box."
            )
    query, full = time["query"], time["full"]
    lines += [
        f"At the scene's own material: {about['own']['sentence']}.",
        *about["own"]["reasons"],
        f"A query takes {query * 1e3:.3g} ms, a full run {full * 1e3:.3g} ms with its factor.",
    ]
    if check is not None:
        ratios = [t.effectivity for t in check.own.tested if t.truth]
        lines.append(
            f"Against {len(check.own.tested)} full runs between the corners of the box: true error at most "
            f"{check.own.largest('truth'):.1e}, bound {np.median(ratios):.3g} times as large in the median, "
            f"{max(ratios):.3g} at most."
        )
    if query > full:
        lines.append("A query takes longer than a full run here: the model pays on a finer mesh only.")
    return lines
