"""Page of ``softgrasp reduce``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from softgrasp.study.reduce import tables
from softgrasp.study.reduce.result import ReductionStudy
from softgrasp.study.report.page import Section, captioned

CAPTIONS = {
    "errors.png": "Error of the deformation of the paper's six methods against N, all columns of V counted. A curve "
    "is dotted where its model is unstable (crosses). Errors above 1 are drawn at 1.",
    "errors_beyond.png": "The same for the methods beyond the paper, beside its best.",
    "errors_state.png": "Further errors of the paper's six methods: of the state [q_s, v_s, q_e, v_e], which is the "
    "paper's, of [q_s, p_s, q_e, p_e], and of the energy of the tissue.",
    "times.png": "Error of the deformation of all stable models against the time of a run, and against offline plus "
    "online time. Bold: the models that no other beats in both. Dashed: the full run with its matrix factored "
    "beforehand.",
    "sigma.png": "Singular values over the first of each decomposition; thin lines are its further parts. Those of "
    "PSD are symplectic or of complex snapshots, each a pair of columns.",
    "modes.png": "First modes of the best method of the paper that keeps the hand apart, and of Craig-Bampton or the "
    "best beyond the paper, scaled to the same largest displacement. Colour: displacement relative to the hand. The "
    "paper's modes hold absolute displacements of the tissue alone, and columns of their own move the hand: here the "
    "hand stands where the tissue beside it goes.",
    "compare.png": "Reduced bodies under the outline of the full one, at instants of large deformation or error.",
    "compare.gif": "The same in motion.",
}


def sections(study: ReductionStudy, files: Sequence[Path]) -> list[Section]:
    """Parts of the page. Rank 0 only."""
    energy = study.full.model.scene.reduction.energy
    text = (
        f"{tables.N_NOTE}\n\n{tables.error_note(energy)} Each method is built from the snapshots of one run and "
        f"repeats it, driven by the same hand. {tables.inner_note(study.sweeps)}"
    )
    parts = [
        tables.error_table(study.sweeps, energy).section(text),
        Section("What holds", text="\n\n".join(study.findings)),
        Section("", figures=captioned(files, CAPTIONS)),
        tables.time_table(study.speeds).section("\n\n".join(study.speed_notes)),
    ]
    refused = tables.refused_table(study.sweeps)
    if refused.rows:
        parts.append(refused.section())
    return [*parts, *box_sections(study)]


def box_sections(study: ReductionStudy) -> list[Section]:
    """Errors at other parameters: a summary, and one table for each N with a column for each basis."""
    box = study.box
    if box.none:
        return [Section("Other parameters", f"No tests at other parameters: {box.none}.")]
    text = tables.box_note(box)
    text += " Undamped vibrations of slightly wrong frequency drift out of phase, so errors grow with the run."
    points = [table.section(f"All parameters, N = {N}.") for N, table in tables.box_point_tables(box)]
    return [tables.box_table(box).section(text), *points]
