"""What ``softgrasp effects`` shows: one page, parts of which a terminal shows too, its table and its picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullFormatter

from softgrasp.fem import Scene, size_text
from softgrasp.study.effects.result import EffectResult, EffectsStudy
from softgrasp.study.forward.explain_page import error_lines
from softgrasp.study.pictures import BLUE, GREEN, HAND, ORANGE, OUTLINE, WIDTH, paper_style, save
from softgrasp.study.report import Columns, Page, Section, Table, in_words, percent, seconds_text, table_of
from softgrasp.study.shell import Session

CAPTION = (
    "Each effect switched on against off, the rest of the scene as it is. Left: largest change of the outputs over the "
    "run, relative to their largest displacement; under a force, the same with the hand driven by the force that would "
    "carry it along the motion without tissue, for effects that do not change the run itself; with a partner, the "
    "change by an effect that changes something only when another one is switched too. Right: what the effect adds to "
    "the time of a step (median and quartiles of paired samples) and to the memory of the run. "
    "Grey: quartiles of the scene's step time against itself. Open marks: the effect is off in the scene and was tried."
)
HOW = (
    ("needed", "the effect changes the outputs by more than the tolerance, alone or with others that are advised"),
    ("beside advised", "the change when this effect alone is switched and all others are as advised"),
    ("optional", "the effect changes the outputs by less, but it costs nothing or the control problem needs it"),
    ("wasted", "the effect costs work or memory and changes no output"),
    ("noise", "paired samples disagree, or differ by no more than the scene does from itself"),
    ("costs", "counted operations and allocated memory decide; times are shown with their noise"),
    ("factor", "the time to factor S and to solve for the hand's equation before the first step"),
)
PROOFS = {
    "operators": "all operators have the same SHA-256 before the effect was on in this process, after it, and with the "
    "effect named at strength zero",
    "objects": "PETSc's own log counts the same matrices, vectors, index sets and solvers, and none in a step",
    "work": "PETSc counts as many operations in a step as before",
}
VERDICTS: Columns = {
    "effect": lambda f: f"{f.name} {'on' if f.on else 'off'}",
    "verdict": "label",
    "outputs": "change.outputs %",
    "deform.": "change.deformation %",
    "force": "control %",
    "advised": "company.change.outputs %",
    "gate": "gate.gate.number 3",
    "limit": "gate.gate.threshold 3",
}
NOTE = (
    "Relative change of the outputs; deform.: against the hand; force: when a force moves the hand; advised: beside "
    "all advised effects. The gate is the number that decides before a run, above its limit."
)
COSTS: Columns = {
    "effect adds": "name",
    "assembly": lambda f: _seconds(f.cost.assembly, f.cost.assembly_range, f.cost.assembly_noise),
    "factor": lambda f: _seconds(f.cost.setup, f.cost.setup_range, f.cost.setup_noise),
    "a step": lambda f: _more(f.cost.step, seconds_text, f.cost.step_relative) if f.cost.step_shows else "noise",
    "its operations": lambda f: percent(f.cost.flops_relative, "+") if f.cost.flops else "none",
    "memory": lambda f: _more(f.cost.memory, size_text, f.cost.memory_relative),
    "PETSc objects": lambda f: ", ".join(f"{n:+d} {kind.lower()}" for kind, n in f.cost.objects.items()) or "none",
}
CSV: Columns = {
    "effect": "name", "on": lambda f: int(f.on), "value": "value", "verdict": "verdict", "gate": "gate.gate.number",
    "gate_threshold": "gate.gate.threshold", "gate_matters": lambda f: int(f.gate.gate.matters),
    "change_outputs": "change.outputs", "change_deformation": "change.deformation",
    "change_absolute [m]": "change.absolute", "change_under_force": "control",
    "change_advised": "company.change.outputs", "change_advised_under_force": "company.control",
    "partners": lambda f: f.company and " ".join(f.company.partners),
    "assembly [s]": "cost.assembly", "setup [s]": "cost.setup", "step [s]": "cost.step",
    "step_relative": "cost.step_relative", "step_low": "cost.step_low", "step_high": "cost.step_high",
    "flops": "cost.flops", "memory [byte]": "cost.memory", "memory_relative": "cost.memory_relative",
    "off_is_free": lambda f: f.proof and int(f.proof.holds),
}  # fmt: skip


def compose(study: EffectsStudy, scene: Scene, session: Session) -> Page:
    """Draw the picture and compose the page."""
    files = figure_effects(study.tried, study.tolerance, study.noise_quartiles, session.out / "effects.png")
    sections = [Section("", figures=[(files[0], CAPTION)]), *parts(study)]
    return Page(
        f"{scene.name}: effects", summary(study), sections, {"effects.csv": table_of(study.findings, CSV)}, files,
        errors=error_lines(study.explanation.mesh, scene.effects.frame is not None), warnings=study.warnings,
    )  # fmt: skip


def parts(study: EffectsStudy) -> list[Section]:
    """Verdicts, advice, costs and proofs."""
    advice = [
        (f"{f.name}{'' if f.on else ', tried'}: {f.value}" if f.value else f.name, f.advice) for f in study.findings
    ]
    advice.append(("all together", joint_changes(study)))
    base = study.base
    times = [seconds_text(base[stage]) for stage in ("assembly", "setup", "step")]
    scene = ("the scene", *times, _count(base["flops"]), size_text(base["memory"]), "")
    proofs = [
        (f.name, *("same" if same else "NOT the same" for same in astuple(f.proof))) for f in study.off if f.proof
    ]
    free = Table(("off", *PROOFS), proofs, "Effects that are off cost nothing")
    low, high = study.noise
    how = (
        ("tolerance", f"{percent(study.tolerance)} of their largest displacement, by study.tolerance: a larger change "
         "of the outputs counts"), *HOW,
        ("samples", f"{study.repeats} of the steps, {study.builds} of the builds, interleaved; medians of pairs"),
        *PROOFS.items(),
    )  # fmt: skip
    note = NOTE
    if study.coarser:
        note += f" Changes are those of the scene on coarser cells, n_e = {study.coarser}; all else is the scene's own."
    return [
        table_of(study.findings, VERDICTS, "Relative change, gate and verdict").section(note, terminal=True),
        Section("Advice", rows=advice, terminal=True),
        Table(tuple(COSTS), [*table_of(study.tried, COSTS).rows, scene], "Costs").section(
            f"The step time of the scene differs from itself by {percent(low, '+')} to {percent(high, '+')}.",
            terminal=True,
        ),
        *([free.section(terminal=True)] if free.rows else []),
        Section("How an effect is tested", rows=how),
    ]


def summary(study: EffectsStudy) -> list[str]:
    """What came out, in three sentences."""
    labels = dict.fromkeys(f.label for f in study.findings)
    named = [(label, [f.name for f in study.findings if f.label == label]) for label in labels]
    verdicts = [f"{label} {'is' if len(names) == 1 else 'are'} {in_words(names)}" for label, names in named]
    change, name = max((f.change.outputs, f.name) for f in study.tried if f.change is not None)
    free = sum(f.proof.holds for f in study.off if f.proof is not None)
    return [
        f"{'; '.join(verdicts).capitalize()}.",
        f"{name.capitalize()} changes the outputs most, by {percent(change)}; what changes them by less than "
        f"{percent(study.tolerance)} does not count.",
        f"{free} of the {len(study.off)} effects that are off are shown to cost nothing.",
    ]


def joint_changes(study: EffectsStudy) -> str:
    """What each effect changes beside all that are advised, one sentence."""
    parts = [
        f"{f.name} {percent(c.change.outputs)}"
        + ("" if c.control is None else f" ({percent(c.control)} under a force)")
        for f in study.findings
        if (c := f.company) is not None
    ]
    return f"With {in_words(study.beside)} on, switching one effect alone changes the outputs by: {', '.join(parts)}."


def _more(value: float, text: Callable[[float], str], share: float) -> str:
    """A cost beside the share by which it is larger."""
    return f"{_signed(value, text)} ({percent(share, '+')})" if value else "none"


def _seconds(median: float, spread: tuple[float, float], noise: float) -> str:
    """Added time; noise when the paired samples do not agree in sign, or the scene differs from itself by as much."""
    return "noise" if spread[0] <= 0 <= spread[1] or abs(median) <= noise else _signed(median, seconds_text)


def _signed(value: float, text: Callable[[float], str]) -> str:
    return f"{'-' if value < 0 else '+'}{text(abs(value))}"


def _count(operations: float) -> str:
    unit, factor = ("million", 1e-6) if operations > 0.9995e6 else ("thousand", 1e-3)
    return f"{factor * operations:.3g} {unit}"


# --- change against cost, in one picture

COLOURS = {"needed": GREEN, "optional": BLUE, "wasted": ORANGE}
BAND = "#e4e4e4"
ROUNDING = 1e-15  # a smaller change is drawn as none


def figure_effects(
    tried: Sequence[EffectResult], tolerance: float, noise: tuple[float, float], out_png: Path
) -> tuple[Path, ...]:
    """Each effect in a row: what it changes on the left, what it costs on the right; PNG and PDF."""
    with paper_style():
        figure, (changes, costs) = plt.subplots(
            1, 2, sharey=True, figsize=(WIDTH, 0.34 * len(tried) + 1.1), layout="constrained", width_ratios=(3, 2)
        )
        names = [f"{f.name} ({'on' if f.on else 'off'})" for f in tried]
        changes.set_yticks(range(len(tried)), names)
        changes.set_ylim(len(tried) - 0.4, -0.6)
        for row, f in enumerate(tried):
            look = {
                "color": COLOURS[f.verdict],
                "mfc": COLOURS[f.verdict] if f.on else "white",
                "mew": 1.3,
                "ls": "none",
            }
            _draw_changes(changes, row, f, look)
            _draw_costs(costs, row, f, look)
        changes.set(xscale="log", xlabel="change of the outputs")
        changes.xaxis.set_major_formatter(lambda x, _: percent(x))
        changes.xaxis.set_minor_formatter(NullFormatter())
        changes.axvline(tolerance, color=HAND, lw=0.9, ls=(0, (4, 3)), zorder=1)
        costs.axvline(0.0, color=HAND, lw=0.7, zorder=1)
        costs.axvspan(100 * min(noise[0], 0.0), 100 * max(noise[1], 0.0), color=BAND, lw=0, zorder=0)
        costs.set_xscale("symlog", linthresh=10.0)
        costs.set_xlabel("added cost")
        costs.xaxis.set_major_formatter("{x:g} %")
        for ax in (changes, costs):
            ax.tick_params(axis="y", length=0)
            ax.grid(axis="y", color="#eeeeee", lw=0.8)
        marks = {"o": "this run", "D": "under a force", "^": "with a partner", "<": "changes nothing"}
        drawn = {line.get_marker() for line in changes.lines}
        entries: list[Any] = [_grey(text, marker) for marker, text in marks.items() if marker in drawn]
        entries += [
            _grey("off, tried", "o", mfc="white"),
            Line2D([], [], color=HAND, ls="--", label=f"tolerance {percent(tolerance)}"),
        ]
        entries += [_grey("time of a step", "h"), _grey("memory", "s"), Patch(color=BAND, label="noise of the time")]
        figure.legend(handles=entries, loc="outside lower center", ncols=5)
        return save(figure, out_png)


def _draw_changes(ax: Any, row: int, f: EffectResult, look: dict[str, Any]) -> None:
    if f.control is not None and f.control > ROUNDING:
        ax.plot(f.control, row, marker="D", ms=4.5, **look)
    if f.together is not None:
        ax.plot(f.together, row, marker="^", ms=6, **look)
    if f.change is not None and f.change.outputs > ROUNDING:
        ax.plot(f.change.outputs, row, marker="o", ms=7, **look)
    else:
        ax.plot(0.02, row, marker="<", ms=6.5, transform=ax.get_yaxis_transform(), **look)


def _draw_costs(ax: Any, row: int, f: EffectResult, look: dict[str, Any]) -> None:
    if (c := f.cost) is None:
        return
    low, high = c.step_quartiles
    error = [[100 * (c.step_relative - low)], [100 * (high - c.step_relative)]]
    ax.errorbar(100 * c.step_relative, row - 0.13, xerr=error, fmt="h", ms=5.5, elinewidth=0.8, capsize=2, **look)
    ax.plot(100 * c.memory_relative, row + 0.17, marker="s", ms=4.5, **look)
    text = {"xycoords": ("axes fraction", "data"), "va": "center", "weight": "bold"}
    ax.annotate(f.label, (1.02, row), color=look["color"], **text)


def _grey(label: str, marker: str, **look: Any) -> Line2D:
    return Line2D([], [], marker=marker, ms=5.5, label=label, color=OUTLINE, ls="none", mew=1.3, **look)
