"""The page of ``softgrasp reduce`` in the frame of the hand, and its tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

from softgrasp.reduction import FullRun
from softgrasp.study.reduce.times import TIMES, FullTimes, timed
from softgrasp.study.reduce.turning.measure import TurningPoint
from softgrasp.study.report import Columns, Page, Section, Table, captioned, percent, table_of

CAPTIONS = {
    "errors.png": "Error of the deformation against N of each basis, beside the full run in the frame of the hand."
}
ERRORS: Columns = {
    "basis": "method", "N": "N", "deformation": lambda p: known(p.error), "velocity": lambda p: known(p.error_velocity),
    "energy norm": lambda p: known(p.error_energy_norm), "force on the hand": "error_force %",
}  # fmt: skip
ROUNDED = 1e-7  # a smaller error is a difference of squares that rounding decides
NOTE = (
    "N counts the hand's 2 n_s. Errors are relative, in the axes of the hand, over all snapshots of the scene's run, "
    "which also made the bases but craig_bampton. Force on the hand: largest difference of an entry over the largest."
)


def known(error: float) -> str:
    """A relative error in words, as far as rounding leaves it."""
    return percent(error) if error >= ROUNDED else f"below {percent(ROUNDED)}"


def best(points: Sequence[TurningPoint]) -> TurningPoint:
    """The point of the least error."""
    return min(points, key=lambda p: p.error)


def compose(
    full: FullRun, times: FullTimes, points: Sequence[TurningPoint], refused: dict[str, str], drawn: Sequence[Path],
    models: Sequence[Path],
) -> Page:  # fmt: skip
    """The page; ``drawn``: pictures, ``models``: files of the reduced models."""
    rows = [timed(p, times, m=p.method, N=p.N) for p in points]
    parts = [
        Section("", figures=captioned(drawn, CAPTIONS)),
        table_of(points, ERRORS, "Errors").section(details=NOTE, terminal=True),
        table_of(rows, {"basis": "m", "N": "N", **TIMES}, "Times").section(terminal=True),
    ]
    names = [field.name for field in fields(TurningPoint)]
    table = Table(tuple(names), [tuple(asdict(p).values()) for p in points])
    top = best(points)
    head = (
        f"The most accurate reduced model, {top.method} with N = {top.N}, has an error of the deformation of "
        f"{known(top.error)} against the scene's run."
    )
    notes = [*dict.fromkeys(p.caution for p in points if p.caution), *(f"{k} refused: {v}" for k, v in refused.items())]
    title = f"{full.model.scene.name}: reduced models in the frame of the hand"
    summary = ["The models turn by any angle with the hand and are linear in the strain."]
    return Page(title, summary, parts, {"points.csv": table}, [*drawn, *models], errors=[head], warnings=notes)
