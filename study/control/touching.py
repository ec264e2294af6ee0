"""What the page of ``softgrasp control`` shows of the loop that meets the obstacles."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from softgrasp.fem import hand_columns
from softgrasp.lqr import LoopTrajectory
from softgrasp.study.control.result import ControlStudy, TouchingLoop
from softgrasp.study.forward.result import contact_columns, contact_rows, trajectory_header
from softgrasp.study.report import Section, Table, percent

TOUCHING_CAPTIONS = {
    "move.png": "The move at some instants on the full plant that meets the obstacles, under the optimal gain.",
    "histories.png": "Outputs, force on the hand, and the distance of the farthest output to the target, on the "
    "full plant without obstacles; dashed with them.",
    "contact.png": "Force of each obstacle on the tissue, thin in each step and bold the mean of two, its least gap, "
    "and how many nodes touch.",
}


def trajectory_table(run: LoopTrajectory, d: int) -> Table:
    """Hand, outputs, load, cost and what obstacles do at every instant."""
    n_s = run.q_s.shape[1]
    names = trajectory_header(n_s, d, run.columns, velocity=False)
    names += [*(f"{u.label} [{u.load_unit}]" for u in hand_columns(n_s, d, "u")), "cost"]
    parts = [run.times, run.q_s, run.outputs, np.vstack([run.inputs, run.inputs[-1:]]), run.cost]
    if run.contact is not None:
        more, values = contact_columns(run.contact)
        names, parts = names + more, [*parts, values]
    return Table(tuple(names), np.column_stack(parts).tolist())


def touching_sections(study: ControlStudy, figures: list[tuple[Path, str]]) -> list[Section]:
    """The loop that meets the obstacles."""
    touching = study.loops.touching
    if touching is None:
        return []
    run = touching.run
    if run is None or (contact := run.contact) is None:
        return [Section("At the obstacles", touching_sentence(study, touching), terminal=True)]
    load = ", ".join(f"{x:.4g}" for x in run.inputs[-2:].mean(axis=0))
    unit = "N" if run.inputs.shape[1] == contact.force.shape[2] else "N, N m"
    rows = [
        *contact_rows(contact),
        ("distance to the target", f"{touching.distance:.3g} m at the end"),
        ("load on the hand", f"({load}) {unit} at the end, mean of two steps"),
        ("cost of the run", f"{run.cost[-1]:.6g}, {percent(touching.cost_excess)} more than without obstacles"),
        ("drift of the energy", f"{run.energy_drift:.1e} of its largest value"),
    ]  # fmt: skip
    return [Section("At the obstacles", rows=rows, figures=figures, terminal=True)]


def touching_sentence(study: ControlStudy, touching: TouchingLoop) -> str:
    """What the obstacles do to the loop."""
    run = touching.run
    if run is None or (contact := run.contact) is None:
        return f"With the obstacles the run of the optimal gain fails: {touching.reason}."
    if not contact.touching.any():
        return "The tissue touches no obstacle under the optimal gain."
    force = float(np.linalg.norm(contact.force_end.sum(axis=0)))
    free = float(study.distance(study.loops.full)[-1])
    presses = f"the obstacles press with {force:.4g} N" if force > 0 else "nothing touches"
    return (
        f"With the obstacles, which the gain does not know, the outputs end {touching.distance:.3g} m from their "
        f"target instead of {free:.3g} m, where {presses}."
    )
