"""What ``softgrasp effects`` shows: tables, picture and page of a study, and the same in a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter
from rich.console import Console
from rich.markup import escape
from rich.padding import Padding

from softgrasp.fem.scene.scene import Scene
from softgrasp.study.effects.result import Change, Cost, EffectResult, EffectsStudy
from softgrasp.study.forward.accuracy import percent
from softgrasp.study.pictures.style import BLUE, GREEN, HAND, ORANGE, OUTLINE, STEPS, WIDTH, paper_style, save
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

    def cells(f: EffectResult) -> list[Any]:
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


# --- change against cost, in one picture

MANY = 1.0  # added share of a cost from which the axis is logarithmic beyond 10 %
COLOURS = {"needed": GREEN, "optional": BLUE, "wasted": ORANGE}
BAND = "#e4e4e4"
ROUNDING = 1e-15  # a smaller change is drawn as none
ROW, BELOW = 0.34, 0.8  # [inch]


Tried = tuple[EffectResult, Change, Cost]


def figure_effects(
    findings: Sequence[EffectResult], tolerance: float, noise: tuple[float, float], out_png: Path
) -> tuple[Path, ...]:
    """Each effect in a row: what it changes on the left, what it costs on the right; PNG and PDF."""
    marks = [(f, f.change, f.cost) for f in findings if f.change is not None and f.cost is not None]
    with paper_style():
        height = ROW * len(marks)
        size = (WIDTH, height + BELOW + 0.25)
        figure = plt.figure(figsize=size)
        axes = [
            figure.add_axes((x / size[0], BELOW / size[1], w / size[0], height / size[1]))
            for x, w in ((1.1, 2.6), (3.95, 1.85))
        ]
        axes[1].tick_params(labelleft=False)
        rows = np.arange(len(marks))[::-1]
        _changes(axes[0], marks, rows, tolerance)
        _costs(axes[1], marks, rows, noise)
        axes[0].set_yticks(rows, [f"{f.name} ({'on' if f.on else 'off'})" for f, _, _ in marks])
        for ax in axes:
            ax.set_ylim(-0.6, len(marks) - 0.4)
            ax.tick_params(axis="y", length=0)
            ax.spines["left"].set_visible(False)
            for row in rows:
                ax.axhline(row, color="#eeeeee", lw=0.8, zorder=0)
        return save(figure, out_png)


def _changes(ax: Any, marks: Sequence[Tried], rows: Any, tolerance: float) -> None:
    values = [v for f, c, _ in marks for v in (c.outputs, f.control, f.together) if v is not None and v > ROUNDING]
    low, high = min([*values, tolerance]), max([*values, tolerance])
    left = 10.0 ** (np.floor(np.log10(low)) - 1)  # a decade for those that change nothing
    nothing = 1.5 * left
    for (mark, change, _), row in zip(marks, rows, strict=True):
        colour = COLOURS[mark.verdict]
        look: dict[str, Any] = {"color": colour, "mfc": colour if mark.on else "white", "mew": 1.3, "ls": "none"}
        if mark.control is not None and mark.control > ROUNDING:
            ax.plot(mark.control, row, marker="D", ms=4.5, zorder=2, **look)
        if mark.together is not None:
            ax.plot(mark.together, row, marker="^", ms=6, zorder=2, **look)
        if change.outputs > ROUNDING:
            ax.plot(change.outputs, row, marker="o", ms=7, zorder=3, **look)
        else:
            ax.plot(nothing, row, marker="<", ms=6.5, zorder=3, **look)
            ax.annotate("none", (nothing, row), (7, 0), textcoords="offset points", va="center", color=OUTLINE)
    ax.axvline(tolerance, color=HAND, lw=0.9, ls=(0, (4, 3)), zorder=1)
    ax.annotate(
        f"tolerance {tolerance:g}", (tolerance, 1.0), (0, 2), xycoords=("data", "axes fraction"),
        textcoords="offset points", ha="center", va="bottom", color=HAND,
    )  # fmt: skip
    ax.set_xscale("log")
    ax.set_xlim(left, 3 * high)
    ax.xaxis.set_major_locator(LogLocator(numticks=6))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_xlabel("relative change of the outputs")
    entries = [_grey("this run", "o", 6)]
    if any(f.control is not None and f.control > ROUNDING for f, _, _ in marks):
        entries.append(_grey("under a force", "D", 4.5))
    if any(f.together is not None for f, _, _ in marks):
        entries.append(_grey("with a partner", "^", 6))
    if not all(f.on for f, _, _ in marks):
        entries.append(_grey("off, tried", "o", 6, mfc="white"))
    _legend(ax, entries)


def _costs(ax: Any, marks: Sequence[Tried], rows: Any, noise: tuple[float, float]) -> None:
    ax.axvspan(100 * min(noise[0], 0.0), 100 * max(noise[1], 0.0), color=BAND, lw=0, zorder=0)
    for (mark, _, cost), row in zip(marks, rows, strict=True):
        colour = COLOURS[mark.verdict]
        face = colour if mark.on else "white"
        low, high = cost.step_quartiles
        error = 100 * np.array([[cost.step_relative - low], [high - cost.step_relative]])
        ax.errorbar(
            100 * cost.step_relative, row + 0.13, xerr=error, fmt="o", ms=5.5, color=colour, mfc=face,
            mew=1.3, elinewidth=0.8,
            capsize=2, zorder=3,
        )  # fmt: skip
        ax.plot(100 * cost.memory_relative, row - 0.17, marker="s", ms=4.5, color=colour, mfc=face, mew=1.3, zorder=3)
        ax.annotate(
            mark.label, (1.02, row), xycoords=("axes fraction", "data"), va="center", color=colour, weight="bold"
        )
    ax.axvline(0.0, color=HAND, lw=0.7, zorder=1)
    if max(max(cost.step_relative, cost.memory_relative) for _, _, cost in marks) > MANY:
        ax.set_xscale("symlog", linthresh=10.0)
        ax.xaxis.set_major_formatter("{x:g}")
        ax.tick_params(axis="x", labelsize=6)
    else:
        ax.xaxis.set_major_locator(MaxNLocator(6, steps=STEPS))
    ax.margins(x=0.08)
    ax.set_xlabel("added cost [%]")
    entries = [_grey("time of a step", "o", 5.5), _grey("memory", "s", 4.5)]
    _legend(ax, [*entries, Patch(color=BAND, label="noise of the time")])


def _grey(label: str, marker: str, size: float, **look: Any) -> Any:
    return Line2D([], [], marker=marker, ms=size, label=label, color=OUTLINE, ls="none", mew=1.3, **look)


def _legend(ax: Any, entries: list[Any]) -> None:
    below = -0.52 / (ax.get_position().height * ax.figure.get_figheight())
    ax.legend(
        handles=entries, loc="upper left", bbox_to_anchor=(-0.1, below),
        ncols=len(entries) if len(entries) < 4 else 2, handlelength=1.2, columnspacing=1.2, borderaxespad=0.0,
    )  # fmt: skip
