"""``softgrasp sweep``: a scene at many values of its keys, as table, picture and page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from rich.console import Console
from rich.progress import MofNCompleteColumn

from softgrasp.fem import SceneError
from softgrasp.fem.scene.file import unit_of
from softgrasp.study.report import SHOWN, Page, Section, Table, percent
from softgrasp.study.report.origin import origin
from softgrasp.study.runs.sweep import METHOD, Sweep, SweepPoint, axis_label, parse_axes, run_sweep_points
from softgrasp.study.shell import Session, folder_lock

UNITS = {"energy_drift": "energy drift", "seconds": "time [s]"}
COARSE = 0.1  # error of the deformation above which a reduced sweep is warned of
UNTESTED = (
    "A sweep estimates neither the error of mesh and time step nor that of linear elasticity: `softgrasp simulate` "
    "states them, one point at a time."
)
LAG = "lag: largest distance of an output from where it would be if the tissue moved rigidly with the hand."
REDUCED = (
    f"The model is reduced ({METHOD}) at the scene's own material; error_deformation: against a full run, "
    "measured at the first and the last point."
)


def sweep_table(points: Sequence[SweepPoint]) -> Table:
    """One row a point, all that is known; a reason where it failed."""
    rows = [point.row() for point in points]
    keys = list(dict.fromkeys(key for row in rows for key in row))
    return Table(tuple(UNITS.get(key, key) for key in keys), [[row.get(key) for key in keys] for row in rows])


def short_table(points: Sequence[SweepPoint]) -> Table:
    """The keys by their last words, with units, the lags and the error of the reduced model."""
    rows = [{**p.values, **{n: x for n, x in p.numbers.items() if " end " not in n and n not in UNITS}} for p in points]
    names = {key: axis_label(key) if key in points[0].values else key for row in rows for key in row}
    best = sorted({round(i * (len(rows) - 1) / (SHOWN - 1)) for i in range(SHOWN)})
    return Table(tuple(names.values()), [[row.get(key) for key in names] for row in rows], "Points", best)


def summary(sweep: Sweep, points: Sequence[SweepPoint]) -> list[str]:
    """What came out, in three sentences."""
    good = [point for point in points if not point.reason]
    keys = [f"{a.key} ({len(a.values)} values from {min(a.values):g} to {max(a.values):g})" for a in sweep.axes]
    model = f"a reduced model of {sweep.N} columns" if sweep.N else "the full model"
    texts = [f"{len(good)} of {len(points)} points of {' and '.join(keys)} were run with {model}."]
    if name := next(iter(good[0].lags()), ""):
        low, high = (pick(good, key=lambda point: point.lags()[name]) for pick in (min, max))
        output, unit = name.rstrip("]").split(" lag [")
        at = [
            f"{p.lags()[name]:.3g} {unit}, at "
            + ", ".join(f"{a.key} = {p.values[a.key]:g} {unit_of(a.key)}".rstrip() for a in sweep.axes)
            for p in (low, high)
        ]
        texts.append(f"The lag of {output} is smallest, {at[0]}, and largest, {at[1]}.")
    return [*texts, f"One run took {median(point.numbers['seconds'] or 0.0 for point in good):.2g} s in the median."]


@folder_lock()
def run_sweep(
    path: Path,
    out: Path,
    overrides: list[str],
    console: Console,
    *,
    axes: list[str],
    reduced: int | None = None,
    each: int = 1,
    quiet: bool = False,
    pictures: bool = True,
    empty: bool = False,
) -> dict[str, Any]:
    """Run a scene file at all combinations of values and write the results. Collective.

    Points are kept in ``out``; the same command after an interruption goes on from there. Raises SoftgraspError.
    """
    session = Session("sweep", path, overrides, out, console, quiet, pictures, empty)
    sweep = Sweep(path, overrides, parse_axes(axes), reduced)
    scene, comm = session.scene(), session.comm
    with session.progress(MofNCompleteColumn()) as bar:
        task = bar.add_task("points", total=len(sweep.points()))
        points = run_sweep_points(sweep, out, comm, each, lambda n, total: bar.update(task, completed=n, total=total))
    failed = [point.reason for point in points if point.reason]
    if len(failed) == len(points):
        raise SceneError(f"no point of the sweep could be run; the first: {failed[0]}")
    notes = [f"{len(failed)} of {len(points)} points failed: {failed[0]}"] if failed else []
    if (worst := max(point.numbers.get("error_deformation") or 0.0 for point in points)) > COARSE:
        notes.append(f"The error of the reduced model is above {percent(COARSE)}; use --reduced with more columns.")
    result = {"command": "sweep", **origin(scene, comm.size), "reduced": reduced}
    result |= {"points": [point.row() for point in points], "warnings": notes}

    def page() -> Page:
        from softgrasp.study.runs.plots import figure_sweep  # brings Matplotlib

        files = figure_sweep(sweep.axes, points, out / "sweep.png") if pictures else ()
        text = f"{LAG} {REDUCED}" if reduced else LAG
        parts = [
            Section("", figures=[(files[0], "Largest lag of every output.")] if files else []),
            short_table(points).section(text, terminal=True),
        ]
        tested = (
            f"At the ends of the sweep the reduced model has an error of the deformation of {percent(worst)} at most."
        )
        options = "".join(f" {text}" for text in axes) + (f" --reduced {reduced}" if reduced else "")
        table = {"sweep.csv": sweep_table(points)}
        return Page(
            f"{scene.name}: sweep", summary(sweep, points), parts, table, files, options,
            errors=[] if reduced is None else [tested],
            warnings=[*notes, UNTESTED],
        )  # fmt: skip

    session.write(scene, result, page)
    return result
