"""The page of a certified model, parts of which a terminal shows too, and its tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.reduction import NORMS, CertifiedModel, Validation
from softgrasp.reduction.certified.greedy import REASONS
from softgrasp.study.reduce.certified.measure import BoxCheck
from softgrasp.study.report import Columns, Page, Section, Table, captioned, percent, table_of

CAPTIONS = {
    "certified_box.png": "Error of the reduction over the box, relative to the largest energy norm of the deformation: "
    "the proved bound, the estimate by two bases, and the truth from full runs at parameters that were not trained.",
    "certified_greedy.png": "The greedy: largest bound on its grid after every round, and where it ran the full model "
    "(numbers: rounds; a place may come again). With two bases it goes on to half the tolerance: the rest is for "
    "the small basis.",
    "certified_sizes.png": "Leading parts of the basis: bound over true error at the tests (line: median, bar: from "
    "least to largest), and largest error against the time of an answer, beside the time of a full run.",
}


TESTS: Columns = {
    "k": "size.k", "k2": "size.k2", "lambda [Pa]": "test.lam", "mu [Pa]": "test.mu", "true error": "test.truth",
    "estimate": lambda r: r["test"].estimate if np.isfinite(r["test"].estimate) else None, "bound": "test.bound",
    "bound / true error": "test.effectivity",
}  # fmt: skip
GREEDY: Columns = {
    "round": "number", "trained at lambda [Pa]": lambda r: r["at"][0], "mu [Pa]": lambda r: r["at"][1], "k": "k",
    "N": "N", "largest bound": lambda r: shown(r["bound"]), "where lambda [Pa]": lambda r: r["worst"][0],
    "where mu [Pa]": lambda r: r["worst"][1], "bounds computed": "evaluations", "time [s]": "seconds .1f",
}  # fmt: skip


def compose(
    certified: CertifiedModel,
    check: BoxCheck | None,
    result: dict[str, Any],
    unknown: str,
    drawn: Sequence[Path],
    file: Path,
) -> Page:
    """The page; ``unknown``: why the error of the mesh is not known, ``drawn``: pictures, ``file``: the model's."""
    greedy, figures = greedy_table(certified), captioned(drawn, CAPTIONS)
    parts = [
        Section("", figures=figures),
        Section("Findings", "\n\n".join(sentences(certified, check, result)), terminal=True),
        greedy.section("Each round runs the full model where the proved bound was largest."),
    ]
    tables = {"greedy.csv": greedy} | ({} if check is None else {"tests.csv": tests_table(check)})
    query, full = (f"{1e3 * result['time'][key]:.3g} ms" for key in ("query", "full"))
    return Page(
        f"{result['scene']}: certified reduced model", [f"A query takes {query}, a full run {full} with its factor."],
        parts, tables, [*drawn, file], errors=[error_sentence(certified, result)],
        warnings=[*result["certified"]["own"]["reasons"], *([unknown] if unknown else [])],
    )  # fmt: skip


def shown(bound: float) -> str:
    """A bound in few letters."""
    return percent(bound) if np.isfinite(bound) else "> 100 %"


def tests_table(check: BoxCheck) -> Table:
    """One row a size and test."""
    return table_of([{"size": s, "test": t} for s in check.sizes for t in s.tested], TESTS, "Tests")


def greedy_table(certified: CertifiedModel) -> Table:
    """One row a round."""
    hand, points = 2 * len(certified.fine.parts["M_hand"]), certified.training["points"]
    rows = [
        {**r, "number": i, "N": hand + 2 * r["k"], "at": points[r["at"]], "worst": points[r["worst"]]}
        for i, r in enumerate(certified.training["rounds"], 1)
    ]
    return table_of(rows, GREEDY, "The greedy")


def error_sentence(certified: CertifiedModel, result: dict[str, Any]) -> str:
    """What was built and the largest error over the box."""
    about, share = result["certified"], certified.training["proved"]
    text = f"The certified model has N = {about['N']} columns"
    if certified.k < certified.k2:
        text += f" and is measured by one of N = {about['N2']}"
    if np.isfinite(share):
        text += (
            f": its error is {'estimated' if certified.certify == 'estimate' else 'proved'} to be at most "
            f"{percent(share)} of the {NORMS[certified.norm]} everywhere on the grid and at "
            f"{about['checked'] - len(certified.training['points'])} random parameters."
        )
    else:
        text += ": in parts of the box its bound is larger than the deformation itself."
    if share > about["tolerance"]:
        text += f" That is above the tolerance of {percent(about['tolerance'])}: runs above it are refused."
    return text


def sentences(certified: CertifiedModel, check: BoxCheck | None, result: dict[str, Any]) -> list[str]:
    """How it was built, and how far its bound is from the truth."""
    about, time, lines = result["certified"], result["time"], []
    lines.append(f"The greedy stopped after {len(about['rounds'])} rounds: {REASONS[about['reason']]}.")
    if added := len(about["added"]):
        lines.append(f"Of the random parameters {added} had a larger bound than the grid and were trained on too.")
    if "validation" in about:
        v = Validation(**about["validation"])
        if v.factor is not None:  # null in result.json where there is no estimate
            lines.append(
                f"In {v.n} random full runs the error was at most {v.factor:.3g} times the estimate; with 95 % "
                f"confidence it is larger on at most {percent(v.share)} of the box."
            )
    lines += [
        f"At the scene's own material: {about['own']['sentence']}.",
    ]
    if check is not None:
        ratios = [t.effectivity for t in check.own.tested if t.truth]
        lines.append(
            f"In {len(check.own.tested)} full runs between the corners of the box the true error is at most "
            f"{percent(check.own.largest('truth'))}; the bound is {np.median(ratios):.3g} times as large in the "
            f"median, {max(ratios):.3g} times at most."
        )
    if time["query"] > time["full"]:
        lines.append("A query takes longer than a full run here: the model is faster on a finer mesh only.")
    return lines
