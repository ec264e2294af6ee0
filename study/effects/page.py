"""What ``softgrasp effects`` shows: tables, picture and page of a study, and the same in a terminal."""

from __future__ import annotations

from dataclasses import astuple
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.padding import Padding

from softgrasp.fem.scene.scene import Scene
from softgrasp.study.effects.plots import figure_effects
from softgrasp.study.effects.result import EffectsStudy, Finding
from softgrasp.study.forward.accuracy import percent
from softgrasp.study.report.page import Section
from softgrasp.study.report.tables import Table, listed
from softgrasp.study.shell.session import Page, Session

CAPTION = (
    "Each effect switched on against off, the rest of the scene as it is. Left: largest change of the outputs over the "
    "run, relative to their largest displacement; under a force, the same with the hand driven by the force that would "
    "carry it along the motion without tissue, for effects that the run itself does not show; with a partner, the "
    "change by an effect that shows only when another one is switched too. Right: what the effect adds to "
    "the time of a step (median and quartiles of paired samples) and to the memory that the run holds. "
    "Grey: quartiles of the scene's step time against itself. Open marks: the effect is off in the scene and was tried."
)


PROOFS = {
    "operators": "all operators have the same SHA-256 before the effect was on in this process, after it, and with the "
    "effect named at strength zero",
    "objects": "PETSc's own log counts the same matrices, vectors, index sets and solvers, and none in a step",
    "work": "PETSc counts as many operations in a step as before",
}


def compose(study: EffectsStudy, scene: Scene, session: Session) -> Page:
    """Draw the picture and compose the page."""
    advice = [
        (f"{f.name}: {f.value}" if f.on else f"{f.name}, tried: {f.value}" if f.value else f.name, f.advice)
        for f in study.findings
    ]
    advice += [("all together", in_company(study)), *(("warning", text) for text in study.warnings)]
    how = [
        ("tolerance", f"{study.tolerance:g}: relative change of the outputs that counts"),
        ("needed", "the effect changes the outputs by more than the tolerance, alone or with others that are advised"),
        ("beside advised", "the change when this effect alone is switched and all others are as advised"),
        ("optional", "the effect does not show, but it costs nothing or the control problem needs it"),
        ("wasted", "the effect costs work or memory, and no output shows it"),
        ("noise", "paired samples disagree, or differ by less than two steps of the same scene do"),
        ("costs", "counted operations and held memory decide; times are shown with their noise"),
        (
            "samples",
            f"{study.repeats} of the steps, {study.builds} of the builds, interleaved; medians of paired samples",
        ),
        ("factor", "the time to factor S and to solve for the hand's equation before the first step"),
        *PROOFS.items(),
    ]
    text = "PETSc's own log counts these objects more with the effect, up to the first step:"
    objects = [
        (f.name, ", ".join(f"{n:+d} {name.lower()}" for name, n in f.cost.objects.items()) or "none")
        for f in study.findings
        if f.cost is not None
    ]
    files = figure_effects(study.findings, study.tolerance, study.noise_quartiles, session.out / "effects.png")
    proofs = proof_table(study)
    sections = [
        Section("", figures=[(files[0], CAPTION)]),
        verdict_table(study).section(),
        Section("Advice", rows=advice),
        cost_table(study).section(),
        Section("", text, rows=objects),
        *([proofs.section()] if proofs.rows else []),
        Section("How an effect is tested", rows=how),
    ]
    return Page(f"{scene.name}: effects", summary(study), sections, {"effects.csv": csv_table(study)}, files)


def summary(study: EffectsStudy) -> list[str]:
    """What came out, in three sentences."""
    groups: dict[str, list[str]] = {}
    for f in study.findings:
        groups.setdefault(f.label, []).append(f.name)
    verdicts = [f"{label}: {listed(names)}" for label, names in groups.items()]
    change, name = max((f.change.outputs, f.name) for f in study.findings if f.change is not None)
    off = [f.proof.holds for f in study.findings if f.proof is not None]
    return [
        f"The verdicts on the effects are {'; '.join(verdicts)}.",
        f"{name.capitalize()} changes the outputs most, by {percent(change)}; what changes them by less than "
        f"{percent(study.tolerance)} does not count.",
        f"{sum(off)} of the {len(off)} effects that are off are shown to cost nothing.",
    ]


def in_company(study: EffectsStudy) -> str:
    """What each effect changes beside all that are advised, one sentence."""
    parts = [
        f"{f.name} {percent(f.company.change.outputs)}"
        + (f" ({percent(f.company.control)} under a force)" if f.company.control is not None else "")
        for f in study.findings
        if f.company is not None
    ]
    return f"With {listed(study.advised)} on, switching one effect alone changes the outputs by: {', '.join(parts)}."


def csv_table(study: EffectsStudy) -> Table:
    """One row an effect, numbers in full; empty where nothing was tried."""
    costs = (
        "assembly [s]", "setup [s]", "step [s]", "step_relative", "step_low", "step_high", "flops", "memory [byte]",
        "memory_relative",
    )  # fmt: skip
    header = (
        "effect", "on", "value", "verdict", "gate", "gate_threshold", "gate_matters", "change_outputs",
        "change_deformation", "change_absolute [m]", "change_under_force", "change_advised",
        "change_advised_under_force", "partners", *costs, "off_is_free",
    )  # fmt: skip

    def cells(f: Finding) -> list[Any]:
        gate, beside = f.gate.gate, f.company
        return [
            f.name, int(f.on), f.value, f.verdict, gate.number, gate.threshold, int(gate.matters),
            *(astuple(f.change) if f.change else [None] * 3), f.control,
            *([beside.change.outputs, beside.control, " ".join(beside.partners)] if beside else [None] * 3),
            *(getattr(f.cost, name.split()[0], None) for name in costs),
            None if f.proof is None else int(f.proof.holds),
        ]  # fmt: skip

    return Table(header, [cells(f) for f in study.findings])


def verdict_table(study: EffectsStudy) -> Table:
    """Change, gate and verdict of each effect."""
    header = ("effect", "is", "verdict", "outputs", "deformation", "under force", "beside advised", "gate", "threshold")
    rows = []
    for f in study.findings:
        gate, change = f.gate.gate, f.change
        changes = (None, None) if change is None else (change.outputs, change.deformation)
        beside = None if f.company is None else f.company.change.outputs
        state = "on" if f.on else "off"
        rows.append((f.name, state, f.label, *changes, f.control, beside, gate.number, gate.threshold))
    return Table(header, rows, "Relative change, gate and verdict")


def _seconds(median: float, spread: tuple[float, float], share: float | None = None) -> str:
    """Added time; noise when the paired samples do not agree in sign."""
    if spread[0] <= 0 <= spread[1]:
        return "noise"
    factor, unit = (1e3, "ms") if share is None else (1e6, "us")
    return f"{factor * median:+.2f} {unit}" + ("" if share is None else f" ({share:+.1%})")


def cost_table(study: EffectsStudy) -> Table:
    """What each effect adds; the last row is the scene as it is."""
    rows: list[tuple[Any, ...]] = [
        (
            f.name,
            _seconds(c.assembly, c.assembly_range),
            _seconds(c.setup, c.setup_range),
            _seconds(c.step, (c.step_low, c.step_high), c.step_relative) if c.step_shows else "noise",
            f"{c.flops:+.0f} ({c.flops_relative:+.1%})",
            f"{c.memory / 1024:+.1f} KiB ({c.memory_relative:+.1%})",
        )
        for f in study.findings
        if (c := f.cost) is not None
    ]
    base = study.base
    times = [f"{1e3 * base['assembly']:.2f} ms", f"{1e3 * base['setup']:.2f} ms", f"{1e6 * base['step']:.2f} us"]
    rows.append(("the scene", *times, f"{base['flops']:.0f}", f"{base['memory'] / 1024:.0f} KiB"))
    return Table(("effect adds", "assembly", "factor", "step", "operations", "memory"), rows, "Costs")


def proof_table(study: EffectsStudy) -> Table:
    """What is the same with and without each effect that is off."""
    rows = [
        (f.name, *("same" if same else "NOT the same" for same in astuple(f.proof)))
        for f in study.findings
        if f.proof is not None
    ]
    return Table(("off", *PROOFS), rows, "Effects that are off cost nothing")


def show(study: EffectsStudy, console: Console) -> None:
    """The table of verdicts, the advice and the proof, for a terminal. Not collective: call on one rank."""
    rows = []
    for f in study.findings:
        gate, cells = f.gate.gate, ["-"] * 4
        if f.change is not None and f.cost is not None:
            step = f"{f.cost.step_relative:+.1%}" if f.cost.step_shows else "noise"
            cells = [f"{f.change.outputs:.1e}", f"{f.change.deformation:.1e}", step, f"{f.cost.memory_relative:+.1%}"]
        number = f"{gate.number:.2g} {'>' if gate.number > gate.threshold else '<'} {gate.threshold:.2g}"
        rows.append((f"{f.name} {'on' if f.on else 'off'}", *cells[:2], number, *cells[2:], f.label))
    table = Table(("effect", "change", "deform.", "gate", "step", "memory", "verdict"), rows).terminal()
    table.collapse_padding = True
    console.print(table)
    console.print(
        "change: of the outputs; deform.: relative to the hand; gate: number against threshold; "
        "step, memory: added; noise: as the scene against itself",
        style="dim",
    )

    def say(text: str) -> None:
        console.print(Padding.indent(escape(text), 2), highlight=False)

    for f in study.findings:
        value = f" ({f.value})" if f.value and f.on else f" (tried {f.value})" if f.value else ""
        say(f"{f.name}{value}: {f.advice}")
    say(in_company(study))
    for text in study.warnings:
        say(f"warning: {text}")
    proofs = {f.name: f.proof for f in study.findings if f.proof is not None}
    if proofs:
        free = [name for name, proof in proofs.items() if proof.holds]
        console.print(
            f"off, and shown to cost nothing by hashes, PETSc's objects and operations: {', '.join(free) or 'none'}"
        )
        console.print(f"step time of the scene against itself: {study.noise[0]:+.1%} to {study.noise[1]:+.1%}")
    for name, proof in proofs.items():
        if not proof.holds:
            lost = [key for key, same in zip(PROOFS, astuple(proof), strict=True) if not same]
            say(f"{name} is not shown to cost nothing: {', '.join(lost)} not the same.")
