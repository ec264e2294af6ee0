"""The page of ``softgrasp reduce`` with contact, parts of which a terminal shows too, and its tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

from softgrasp.study.reduce.contact.measure import ContactPoint, ContactStudy
from softgrasp.study.report import Columns, Page, Section, Table, captioned, percent, table_of

CAPTIONS = {
    "errors.png": "Error of the deformation and of the forces of the obstacles against N. Filled: on the motion of the "
    "scene; open: largest on the held-out motions.",
    "force.png": "Force and least gap of the obstacles over time on one motion, of the full model and of the most "
    "accurate reduced one.",
}
NOTE = (
    "The basis has the response to the hand and what a rich model needs beside it on the motion of the scene and on "
    "others along and towards the obstacle. Every node that may touch has a row; the static answer to its force that "
    "the basis lacks goes with the force, without mass. z: relative error of the deformation over all nodes and steps; "
    "force: of the forces of all obstacles over all steps. Held out: largest on motions that trained no model."
)
ERRORS: Columns = {
    "N": "p.N", "nodes": "p.nodes", "z": "p.error %3", "force": "p.error_force %3",
    "z held out": "p.error_held_out %3", "force held out": "p.error_force_held_out %3",
}  # fmt: skip
TIMES: Columns = {
    "N": "p.N", "run [ms]": lambda r: f"{1e3 * r['p'].time_online:.2f}",
    "step [us]": lambda r: f"{1e6 * r['p'].time_online / r['steps']:.2f}", "offline [s]": "p.time_offline 3",
    "x full": "up .3g",
}  # fmt: skip
NO_CERTIFICATE = (
    "No certificate covers contact: the errors are known on the motions of this page, where full runs are beside the "
    "models, and on no other."
)


def speed_up(study: ContactStudy, p: ContactPoint) -> float:
    """Processor time of the steps of the full run over that of a reduced one [1]."""
    return study.times.steps / p.time_online


def compose(study: ContactStudy, drawn: Sequence[Path], models: Sequence[Path]) -> Page:
    """The page; ``drawn``: pictures, ``models``: files of the reduced models."""
    steps = len(study.full.trajectory.times) - 1
    rows = [{"p": p, "up": speed_up(study, p), "steps": steps} for p in study.points.values()]
    parts = [
        Section("", figures=captioned(drawn, CAPTIONS)),
        table_of(rows, ERRORS, "Errors").section(details=NOTE, terminal=True),
        table_of(rows, TIMES, "Times").section(terminal=True),
    ]
    if study.motions:
        parts.append(_motions(study).section())
    names = [field.name for field in fields(ContactPoint)]
    table = Table(("model", *names), [(key, *asdict(p).values()) for key, p in study.points.items()])
    notes = [NO_CERTIFICATE, *(f"{what} refused: {why}" for what, why in study.refused.items())]
    title = f"{study.full.model.scene.name}: reduced models with contact"
    files = [*drawn, *models]
    return Page(title, [headline(study)], parts, {"points.csv": table}, files, errors=[accuracy(study)], warnings=notes)


def accuracy(study: ContactStudy) -> str:
    """Errors of the most accurate model."""
    p = study.points[study.best]
    own = f"{percent(p.error, digits=3)} in the deformation" + _and(p.error_force)
    if p.error_held_out is None:
        return f"The most accurate reduced model, N = {p.N}, has an error of {own}; it was tested on no other motion."
    held = f"{percent(p.error_held_out, digits=3)} in the deformation" + _and(p.error_force_held_out)
    return (
        f"The most accurate reduced model, N = {p.N}, has an error of {own}; on {len(study.motions)} held-out motions "
        f"at most {held}."
    )


def headline(study: ContactStudy) -> str:
    """Its speed."""
    p = study.points[study.best]
    steps = len(study.full.trajectory.times) - 1
    return (
        f"A step takes {1e6 * p.time_online / steps:.3g} us of processor time, that of the full model "
        f"{speed_up(study, p):.3g} times as much."
    )


def _and(force: float | None) -> str:
    return "" if force is None else f" and {percent(force, digits=3)} in the forces"


def _motions(study: ContactStudy) -> Table:
    """The held-out motions with the errors of the most accurate model."""
    rows = []
    for motion in study.motions:
        z, force = motion.errors.get(study.best, (None, None))
        rows.append((
            motion.title, ", ".join(f"{x + 0.0:.3g}" for x in motion.target), percent(motion.touching), motion.force,
            None if z is None else percent(z, digits=3), None if force is None else percent(force, digits=3),
        ))  # fmt: skip
    header = ("motion", "target [m]", "steps with contact", "largest force [N]", "z", "force")
    return Table(header, rows, f"Held-out motions, errors of {study.best}")
