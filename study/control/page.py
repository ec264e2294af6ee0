"""The page of ``softgrasp control``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from softgrasp.study.control.result import TITLES, ControlStudy
from softgrasp.study.control.tables import BOX_HEADER, box_rows, loop_table, reduced_table, summary_rows
from softgrasp.study.pictures.shapes import speed_up
from softgrasp.study.report.equation import controlled
from softgrasp.study.report.page import Section, captioned

CAPTIONS = {
    "move.png": "The move to the target at some instants, full plant under the optimal gain.",
    "move.gif": "The move in motion{speed}.",
    "histories.png": "Outputs, force on the hand, and the distance of the farthest output to the target, on the "
    "full plant; dashed and dash-dotted under the a-priori gain and the paper's reduced gain of largest cost.",
    "errors.png": "Reduced Riccati equations: relative error of P, relative error of the gain and excess cost against "
    "N. Errors above 100 % are not drawn, excess cost below 1e-12 at 1e-12. Red crosses: gains that leave the full "
    "plant unstable or without certificate; on the upper edge those with an error above 100 %.",
    "retune.png": "Excess cost over the box when the basis stays that of the scene's parameter. Red crosses: no stable "
    "gain.",
    "bode.png": "The loop at each input, all others closed, on the controller's own plant, sampled and held; marked: "
    "the crossover and its phase margin.",
    "decay.png": "Decay rates of the lowest modes without feedback and with the gains.",
}


def captions(drawn: Sequence[Path], settle: float) -> dict[str, tuple[Path, str]]:
    """Pictures by name with their captions, in the order of :data:`CAPTIONS`."""
    faster = speed_up(np.array([0.0, settle]))
    speed = "" if faster == 1 else f" at {faster:g} times its speed"
    return {file.name: (file, text.format(speed=speed)) for file, text in captioned(drawn, CAPTIONS)}


def sections(study: ControlStudy, seconds: Mapping[str, float], drawn: Sequence[Path]) -> list[Section]:
    """Parts of the page."""
    figures = captions(drawn, study.loops.plan.settle)

    def pick(*names: str) -> list[tuple[Path, str]]:
        return [figures[name] for name in names if name in figures]

    notes = "\n\n".join((*study.findings, *(note.text for note in study.notes)))
    parts = [
        Section("", figures=pick("move.png", "move.gif")),
        *([Section("Notes", text=notes)] if notes else []),
        Section("Result", rows=summary_rows(study, dict(seconds)), figures=pick("histories.png", "decay.png")),
        Section("Equation", equation=controlled(study.design.model.scene)),
    ]
    if study.bases:
        parts += _reduced(study, pick("errors.png"))
    if study.margins is not None:
        from softgrasp.study.control.bode import margin_table, margin_text  # brings Matplotlib

        parts.append(margin_table(study.margins).section(margin_text(study.margins), figures=pick("bode.png")))
    for i, r in enumerate(study.retuned):
        text = f"{TITLES[r.name]}, N = {r.N}: basis of the scene's parameter, gain re-tuned at others."
        own = [] if i else pick("retune.png")
        parts.append(Section("" if i else "Re-tuning", text, header=BOX_HEADER, rows=box_rows(r), figures=own))
    return parts


def _reduced(study: ControlStudy, figures: list[tuple[Path, str]]) -> list[Section]:
    plan = study.loops.plan
    text = (
        "Each equation is projected on N basis vectors and solved; its gain is tested on the full plant. The bases "
        "of the paper need P first, the a-priori modes do not. Only stable gains are offered as controllers. "
        "The excess cost is J/J* - 1 on the modes kept. The first bound beside it is proved for the whole plant, by "
        f"the duality gap, for the run to t = {plan.dt * plan.steps:.4g} s and the optimal feedback after it; the "
        "second makes room for what the gain's own way costs after that time, which is an allowance, not a proof."
    )
    none = [(f"{TITLES[b.name]}, N = {r.N}", r.unbounded) for b in study.bases for r in b.reports if r.unbounded]
    parts = [reduced_table(study.bases).section(text, figures=figures)]
    refused = [(TITLES[b.name], b.refused) for b in study.bases if b.refused]
    parts += [Section("Refused", header=("basis", "reason"), rows=refused)] if refused else []
    parts += [Section("Without a bound of the cost", header=("gain", "reason"), rows=none)] if none else []
    return [*parts, loop_table(study).section("Full plant, same start, time step and actuation.")]
