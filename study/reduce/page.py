"""Files of ``softgrasp reduce``: result.json, points.csv, scene.toml, figures and report.html."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from softgrasp.fem.scene.file import resolved_toml
from softgrasp.fem.scene.scene import Scene
from softgrasp.reduction.parameters import box_of
from softgrasp.study.reduce.tables import (
    BOX_HEADER,
    ERROR_HEADER,
    N_NOTE,
    TIME_HEADER,
    box_note,
    box_rows,
    error_note,
    error_rows,
    inner_note,
    refused_rows,
    time_rows,
    write_csv,
)
from softgrasp.study.report.files import write_json, write_scene
from softgrasp.study.report.origin import command_line, made_with
from softgrasp.study.report.page import Section, write_report

if TYPE_CHECKING:
    from softgrasp.study.reduce.pictures import Views
    from softgrasp.study.reduce.run import Reduced

CAPTIONS = {
    "errors.png": "Relative errors of the paper's six methods against N, all columns of V counted. First the "
    "deformation, after removing the rigid motion of the hand; then the state [q_s, v_s, q_e, v_e], the paper's error; "
    "then [q_s, p_s, q_e, p_e]; then the energy of the tissue; each the same for every method. Thin dotted: projection "
    "error, which no model of the basis can fall below. Red crosses: unstable models. Errors above 1 are drawn at 1.",
    "errors_beyond.png": "The same for the methods beyond the paper, beside its best.",
    "times.png": "Errors of all models against the time of a run, and against offline plus online time. Open marks: "
    "global bases. Red crosses: unstable models. Errors above 1 are drawn at 1. Dashed: the full run with its matrix "
    "factored beforehand.",
    "sigma.png": "Singular values over the first of each decomposition; thin lines are its further parts. Those of "
    "PSD are symplectic or of complex snapshots, each a pair of columns.",
    "modes.png": "First modes of the best method of the paper that keeps the hand apart, and of Craig-Bampton or the "
    "best beyond the paper, scaled to the same largest displacement. Colour: displacement. Modes in absolute "
    "coordinates hold the motion that the hand gives, so that the body leaves its contact.",
    "compare.png": "Reduced bodies under the outline of the full one, at instants of large deformation or error.",
    "compare.gif": "The same in motion.",
}


def draw_all(out: Path, found: Reduced, views: Views | None) -> list[Path]:
    """All figures. Rank 0 only."""
    from softgrasp.study.reduce.pictures import figure_compare, figure_modes, gif_compare
    from softgrasp.study.reduce.plots import beyond_paper, figure_errors, figure_sigma, figure_times, of_paper

    files: list[Path] = []
    shown = [s for s in found.swept if s.points]
    if of_paper(shown):
        files += figure_errors(of_paper(shown), out / "errors.png")
    if any(s not in of_paper(shown) for s in shown):
        files += figure_errors(beyond_paper(shown), out / "errors_beyond.png")
    if shown:
        files += figure_times(shown, found.times.steps, out / "times.png")
        files += figure_sigma(shown, out / "sigma.png") or ()
    if views is not None and views.modes:
        files += figure_modes(views, out / "modes.png")
    if views is not None and views.reduced:
        files += figure_compare(views, out / "compare.png")
        files.append(gif_compare(views, out / "compare.gif"))
    return files


def write_all(
    out: Path, path: Path, overrides: list[str], scene: Scene, found: Reduced, result: dict[str, Any], files: list[Path]
) -> list[Path]:
    """Numbers and report beside the figures that are there. Rank 0 only."""
    table = write_csv(out / "points.csv", found.swept)
    drawn = {file.name for file in files}
    report = write_report(
        out / "report.html",
        title=f"{scene.name}: reduced models",
        subtitle=scene.description,
        sections=sections(found, result, [(out / name, text) for name, text in CAPTIONS.items() if name in drawn]),
        scene=resolved_toml(scene),
        reproduce=command_line("reduce", path, overrides, result["ranks"]),
    )
    return [write_json(out / "result.json", result), table, write_scene(out, scene), *files, report]


def sections(found: Reduced, result: dict[str, Any], figures: list[tuple[Path, str]]) -> list[Section]:
    """Parts of the page."""
    share = f"{100 * result['reduction']['energy']:g} %"
    explained = (
        f"{N_NOTE}\n\n{error_note(share)} Each method is built from the snapshots of one run and repeats it, driven by "
        f"the same hand. {inner_note(found.swept)}"
    )
    header = (ERROR_HEADER[0], share, *ERROR_HEADER[2:])
    parts = [
        Section("Errors", text=explained, header=header, rows=error_rows(found.swept)),
        Section("What holds", text="\n\n".join(result["findings"])),
        Section("", figures=figures),
        Section("Times", text="\n\n".join(result["speed_notes"]), header=TIME_HEADER, rows=time_rows(found.speeds)),
    ]
    if refused := refused_rows(found.swept):
        parts.append(Section("Refused", header=("N", "method", "reason"), rows=refused))
    parts += box_sections(found)
    about = [(key, result[key]) for key in ("n_s", "n_e", "states", "steps")]
    about += [*made_with(result), *((f"time {key}", f"{value:.3g} s") for key, value in result["time"].items())]
    return [*parts, Section("Made with", rows=about)]


def box_sections(found: Reduced) -> list[Section]:
    """Errors at other parameters: a summary, and one table for each N with a column for each basis."""
    title, box = "Other parameters", found.box
    if box.none:
        return [Section(title, f"No tests at other parameters: {box.none}.")]
    text = box_note(box, *box_of(found.against.model))
    text += " Undamped vibrations of slightly wrong frequency drift out of phase, so errors grow with the run."
    parts = [Section(title, text, header=BOX_HEADER, rows=box_rows(box))]
    for N in sorted({case.N for case in box.cases}):
        shown = [i for i, case in enumerate(box.cases) if case.N == N]
        names = [box.cases[i].method.title + (", several runs" if box.cases[i].several else "") for i in shown]
        rows = [
            (f"{p.lam:.4g}", f"{p.mu:.4g}", "trained" if p.trained else "test", *(p.errors[i] for i in shown))
            for p in box.points
        ]
        parts.append(Section("", f"All parameters, N = {N}.", header=("lambda [Pa]", "mu [Pa]", "", *names), rows=rows))
    return parts
