"""Files of ``softgrasp effects``: result.json, effects.csv, picture and report."""

from __future__ import annotations

import csv
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

from softgrasp.fem.errors import agree
from softgrasp.fem.scene.file import resolved_toml
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.effects.objects import in_words
from softgrasp.study.effects.plots import Mark, figure_effects
from softgrasp.study.report.files import write_json, write_scene
from softgrasp.study.report.origin import command_line, made_with, origin, peak_memory_mb
from softgrasp.study.report.page import Section, write_report

if TYPE_CHECKING:
    from softgrasp.study.effects.run import EffectsStudy, Finding

CAPTION = (
    "Each effect switched on against off, the rest of the scene as it is. Left: largest change of the outputs over the "
    "run, relative to their largest displacement; under a force, the same with the hand driven by the force that would "
    "carry it along the motion without tissue, for effects that the run itself does not show; with a partner, the "
    "change by an effect that shows only when another one is switched too. Right: what the effect adds to "
    "the time of a step (median and quartiles of paired samples) and to the memory that the run holds. "
    "Grey: quartiles of the scene's step time against itself. Open marks: the effect is off in the scene and was tried."
)


def write_effects(
    study: EffectsStudy, scene: Scene, comm: MPI.Intracomm, path: Path, out: Path, overrides: list[str], begin: float
) -> tuple[dict[str, Any], list[Path]]:
    """Write everything on rank 0; the result on all ranks, the files on rank 0. Collective.

    Raises:
        OSError: the folder cannot be written; on all ranks.
    """
    result: dict[str, Any] = {
        "command": "effects",
        **origin(scene, comm.size),
        **study.to_dict(),
        "memory_peak_mb": peak_memory_mb(comm),
        "time": {"total": comm.allreduce(time.perf_counter() - begin, MPI.MAX)},
    }
    files: list[Path] = []
    with agree(comm):
        if comm.rank == 0:
            out.mkdir(parents=True, exist_ok=True)
            files = [
                write_json(out / "result.json", result),
                write_csv(study, out / "effects.csv"),
                write_scene(out, scene),
            ]
            files += figure_effects(marks(study), study.tolerance, study.noise_quartiles, out / "effects.png")
            files.append(_report(study, scene, result, path, overrides, out))
    return result, files


def listed(names: Sequence[str]) -> str:
    """Names as one reads them: a, b and c. Not collective."""
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]])) or "none"


def judged_again(study: EffectsStudy) -> str:
    """What each effect changes beside all that are advised, one sentence. Not collective."""
    parts = [
        f"{f.name} {f.company.change.outputs:.1e}"
        + (f" ({f.company.control:.1e} under a force)" if f.company.control is not None else "")
        for f in study.findings
        if f.company is not None
    ]
    return f"judged again with {listed(study.advised)} on, each changes the outputs by: {', '.join(parts)}."


def marks(study: EffectsStudy) -> list[Mark]:
    """What the picture shows: the effects that were tried. Not collective."""
    return [
        Mark(
            name=f.name,
            on=f.on,
            verdict=f.verdict,
            label=f.label,
            change=f.change.outputs,
            control=f.control,
            together=f.company.together if f.company is not None and f.company.partners else None,
            step=f.cost.step_relative,
            quartiles=f.cost.step_quartiles,
            memory=f.cost.memory_relative,
        )
        for f in study.findings
        if f.change is not None and f.cost is not None
    ]


def write_csv(study: EffectsStudy, path: Path) -> Path:
    """One row an effect; empty where nothing was tried. Rank 0 only."""
    header = [
        "effect", "on", "value", "verdict", "gate", "gate_threshold", "gate_matters", "change_outputs",
        "change_deformation", "change_absolute [m]", "change_under_force", "change_advised",
        "change_advised_under_force", "partners", "assembly [s]", "setup [s]", "step [s]",
        "step_relative", "step_low", "step_high", "flops", "memory [byte]", "memory_relative", "off_is_free",
    ]  # fmt: skip
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(_csv_row(f) for f in study.findings)
    return path


def _csv_row(f: Finding) -> list[Any]:
    gate, change, cost = f.gate.gate, f.change, f.cost
    row: list[Any] = [f.name, int(f.on), f.value, f.verdict, gate.number, gate.threshold, int(gate.matters)]
    row += ["", "", ""] if change is None else [change.outputs, change.deformation, change.absolute]
    row.append("" if f.control is None else f.control)
    beside = f.company
    row += ["", "", ""] if beside is None else [beside.change.outputs, beside.control, " ".join(beside.partners)]
    if cost is None:
        row += [""] * 9
    else:
        row += [cost.assembly, cost.setup, cost.step, cost.step_relative, cost.step_low, cost.step_high]
        row += [cost.flops, cost.memory, cost.memory_relative]
    return [*row, "" if f.proof is None else int(f.proof.holds)]


def verdict_rows(study: EffectsStudy) -> list[tuple[Any, ...]]:
    """The table of verdicts with a header row. Not collective."""
    rows: list[tuple[Any, ...]] = [
        ("effect", "is", "verdict", "outputs", "deformation", "under force", "beside advised", "gate", "threshold")
    ]
    for f in study.findings:
        gate, change = f.gate.gate, f.change
        cells = (None, None) if change is None else (change.outputs, change.deformation)
        beside = None if f.company is None else f.company.change.outputs
        row = (f.name, "on" if f.on else "off", f.label, *cells, f.control, beside, gate.number, gate.threshold)
        rows.append(row)
    return rows


def _seconds(median: float, spread: tuple[float, float], share: float | None = None) -> str:
    """Added time; noise when the paired samples do not agree in sign."""
    if spread[0] <= 0 <= spread[1]:
        return "noise"
    factor, unit = (1e3, "ms") if share is None else (1e6, "us")
    return f"{factor * median:+.2f} {unit}" + ("" if share is None else f" ({share:+.1%})")


def cost_rows(study: EffectsStudy) -> list[tuple[Any, ...]]:
    """The table of costs with a header row; the last row is the scene as it is. Not collective."""
    rows: list[tuple[Any, ...]] = [("effect adds", "assembly", "factor", "step", "operations", "memory")]
    for f in study.findings:
        if f.cost is None:
            continue
        c = f.cost
        rows.append(
            (
                f.name,
                _seconds(c.assembly, c.assembly_range),
                _seconds(c.setup, c.setup_range),
                _seconds(c.step, (c.step_low, c.step_high), c.step_relative) if c.step_shows else "noise",
                f"{c.flops:+.0f} ({c.flops_relative:+.1%})",
                f"{c.memory / 1024:+.1f} KiB ({c.memory_relative:+.1%})",
            )
        )
    base = study.base
    times = [f"{1e3 * base['assembly']:.2f} ms", f"{1e3 * base['setup']:.2f} ms", f"{1e6 * base['step']:.2f} us"]
    rows.append(("the scene", *times, f"{base['flops']:.0f}", f"{base['memory'] / 1024:.0f} KiB"))
    return rows


def proof_rows(study: EffectsStudy) -> list[tuple[Any, ...]]:
    """The table of proofs with a header row. Not collective."""
    rows: list[tuple[Any, ...]] = [
        ("off", "operators", "strength 0", "without it", "objects", "memory", "operations", "step time")
    ]

    def word(value: bool | None) -> str:
        return "-" if value is None else "same" if value else "NOT the same"

    for f in study.findings:
        p = f.proof
        if p is None:
            continue
        allocations = word(p.same_allocations and p.declared)
        span = f"{p.step_ratio - 1:+.1%}, {'noise' if p.within_noise else 'NOT noise of'} {p.noise:.1%}"
        counted = (word(p.same_operators), word(p.zero_strength), word(p.absent), word(p.same_objects))
        rows.append((f.name, *counted, allocations, word(p.same_work), span))
    return rows


def _report(
    study: EffectsStudy, scene: Scene, result: dict[str, Any], path: Path, overrides: list[str], out: Path
) -> Path:
    advice: list[tuple[Any, ...]] = [
        (f"{f.name}: {f.value}" if f.on else f"{f.name}, tried: {f.value}" if f.value else f.name, f.advice)
        for f in study.findings
    ]
    advice.append(("all together", judged_again(study)))
    advice += [("look at", text) for text in study.warnings]
    how = [
        ("tolerance", f"{study.tolerance:g}: relative change of the outputs that counts"),
        ("needed", "changes the outputs of the run by more than the tolerance, alone or with others that are advised"),
        ("beside advised", "the effect switched alone, all others as advised; effects that show only so join them"),
        ("optional", "does not, but costs nothing, or the control problem feels it"),
        ("wasted", "costs work or memory and nothing shows it"),
        ("noise", "paired samples do not agree, or by less than steps of the scene differ from one another"),
        ("costs", "decided by counted operations and held memory; times are shown with their noise"),
        (
            "samples",
            f"{study.repeats} of the steps, {study.builds} of the builds, interleaved; medians of paired samples",
        ),
        ("factor", "factor of S and what the hand's equation solves before the first step"),
        ("operators", "SHA-256 of all operators after the effect was on in this process is that from before"),
        ("strength 0", "the effect named with strength zero gives the same hashes"),
        ("without it", "operators made again without the effect's term have the same bits"),
        ("objects", "PETSc's own log counts the same matrices, vectors, index sets and solvers, and none in a step"),
        ("memory", "the same matrices, vectors and arrays of the same size, and only what is declared"),
        ("operations", "PETSc counts as many in a step"),
    ]
    about = [*made_with(result), ("time", f"{result['time']['total']:.1f} s")]
    sections = [_table("Relative change, gate and verdict", verdict_rows(study)), Section("Advice", rows=advice)]
    sections.append(_table("Costs", cost_rows(study)))
    text = "Objects that PETSc's own log counts as created more with the effect, up to the first step:"
    objects = [(f.name, in_words(f.cost.objects)) for f in study.findings if f.cost is not None]
    sections.append(Section("", text, rows=objects))
    proofs = proof_rows(study)
    if len(proofs) > 1:
        sections.append(_table("Effects that are off cost nothing", proofs))
    sections += [Section("How it is judged", rows=how), Section("Size", rows=list(study.sizes.items()))]
    sections.append(Section("Made with", rows=about))
    return write_report(
        out / "report.html",
        title=f"{scene.name}: effects",
        subtitle=scene.description,
        sections=[Section("", figures=[(out / "effects.png", CAPTION)]), *sections],
        scene=resolved_toml(scene),
        reproduce=command_line("effects", path, overrides, result["ranks"]),
    )


def _table(title: str, rows: list[tuple[Any, ...]]) -> Section:
    return Section(title, header=rows[0], rows=rows[1:])
