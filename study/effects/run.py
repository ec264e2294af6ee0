"""``softgrasp effects``: which effects a scene calls for, what each costs, and proof that the others cost nothing."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from mpi4py import MPI
from rich.console import Console
from rich.markup import escape
from rich.padding import Padding
from rich.progress import MofNCompleteColumn
from rich.table import Table

from softgrasp.fem.effects import EFFECTS
from softgrasp.fem.errors import ResourceError
from softgrasp.fem.fields.scales import rigid_inertia
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.effects.change import Change, Company, Experiments, Names, Together, judge_together
from softgrasp.study.effects.elements import Elements, judge_elements
from softgrasp.study.effects.judge import TIMER, Cost, OffProof, cost_of, judge, prove_off, quartiles
from softgrasp.study.effects.measure import Case, bare_output, count_objects, measure_builds, measure_steps
from softgrasp.study.effects.page import judged_again, listed, write_effects
from softgrasp.study.effects.switch import Switch, scales_of, switches
from softgrasp.study.forward.explain import EffectReport, Explanation, explain_model
from softgrasp.study.shell.session import list_files, open_scene, progress_bar

SCENE, AGAIN = "scene", "scene again"


@dataclass(frozen=True)
class Finding:
    """What the study found about one effect.

    Attributes:
        name: the effect.
        on: the scene has it on.
        value: in the scene, or the trial value.
        gate: number, threshold and sentence of its gate, with what explain says.
        verdict: needed, optional, wasted, or not tried.
        advice: one sentence.
        change: of the outputs of the run; None when not tried.
        control: change of the outputs when a force moves the hand; None when that is no question, or not needed to
            judge.
        company: the same judged again beside all other advised effects; None when not tried.
        cost: None when not tried.
        proof: for an effect that is off.
    """

    name: str
    on: bool
    value: str
    gate: EffectReport
    verdict: str
    advice: str
    change: Change | None
    control: float | None
    company: Company | None
    cost: Cost | None
    proof: OffProof | None

    @property
    def label(self) -> str:
        """The verdict as a reader takes it: an effect that is off is not, but would be wasted."""
        return "would be wasted" if self.verdict == "wasted" and not self.on else self.verdict


@dataclass(frozen=True)
class EffectsStudy:
    """All findings of a scene.

    Attributes:
        findings: in the order of `fem.effects.EFFECTS`.
        advised: effects that are on when every advice is followed, for control alone included.
        explanation: of the scene as it is; its warnings are repeated in the report.
        tolerance: relative change that counts [1].
        repeats: samples behind each median of a step; builds may have fewer.
        builds: samples behind each median of assembly and factor.
        noise: step times of the scene against itself, smallest and largest paired ratio less 1 [1].
        noise_quartiles: the middle half of them [1].
        base: medians of the scene as it is: assembly, setup, step [s], and memory [byte].
        sizes: n_s, n_e, states, steps and cells of the scene.
        elements: what P2 changes; None unless P1 may lock.
    """

    findings: tuple[Finding, ...]
    advised: tuple[str, ...]
    explanation: Explanation
    tolerance: float
    repeats: int
    builds: int
    noise: tuple[float, float]
    noise_quartiles: tuple[float, float]
    base: dict[str, float]
    sizes: dict[str, int]
    elements: Elements | None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What explain warns of, and what was measured about it."""
        return (*self.explanation.warnings, *([self.elements.advice] if self.elements else []))

    def to_dict(self) -> dict[str, Any]:
        """Plain tables for JSON. Not collective."""
        effects = {}
        for f in self.findings:
            entry = asdict(f)
            entry["gate"] = asdict(f.gate.gate)
            if f.cost is not None:
                entry["cost"]["any"] = f.cost.any
            if f.proof is not None:
                entry["proof"]["holds"] = f.proof.holds
            effects[entry.pop("name")] = entry
        return {
            "tolerance": self.tolerance,
            "repeats": self.repeats,
            "builds": self.builds,
            "noise": list(self.noise),
            "base": self.base,
            "effects": effects,
            "advised": list(self.advised),
            "off_is_free": all(f.proof.holds for f in self.findings if f.proof is not None),
            "missing": list(self.explanation.missing),
            "idle": list(self.explanation.idle),
            "warnings": list(self.warnings),
            "elements": None if self.elements is None else asdict(self.elements),
            "sizes": self.sizes,
        }


def study_effects(
    scene: Scene, comm: MPI.Intracomm, progress: Callable[[int, int], None] | None = None
) -> EffectsStudy:
    """Measure every effect of a scene on and off. Collective.

    Args:
        scene: the scene; tolerance and repeats are those of its section study.
        comm: ranks.
        progress: called with steps of work done and in all.

    Raises:
        SceneError, MeshError: the scene cannot be built.
        SolverError: a solve failed.
        ResourceError: the factors of all variants would not fit in memory at once.
    """
    scene = bare_output(scene)
    model = build(scene, comm=comm)  # also compiles the forms
    explanation = explain_model(model)
    scales = scales_of(model.system.layout, rigid_inertia(model), explanation.time.omega)
    found = switches(scene, scales)
    scenes = {SCENE: scene} | {s.name: s.other for s in found if s.other is not None} | {AGAIN: scene}
    _fits(comm, explanation, len(scenes))
    repeats, done = scene.study.repeats, 0
    work = len(scenes) * (3 * repeats)

    def tick(weight: int = 1) -> None:
        nonlocal done
        done += weight
        if progress is not None:
            progress(min(done, work), work)

    cases = measure_builds(comm, scenes, repeats, tick)
    on = frozenset(s.name for s in found if s.on)
    runs = Experiments(scene, scales, {on: cases[SCENE].model, **_switched(on, found, cases)})
    changes = _changes(runs, found, tick)
    needed = (s.name for s in found if s.other is not None and _counts(s, changes[s.name], explanation, scene))
    together = judge_together(runs, tuple(changes), frozenset(needed), scene.study.tolerance)
    elements = judge_elements(runs.models[on], runs.first, scene.study.tolerance)
    done = 2 * repeats * len(scenes)
    measure_steps(comm, cases, repeats, tick)
    count_objects(comm, cases, scenes)
    base, again = cases[SCENE], cases[AGAIN]
    ratio = np.array(again.seconds["step"]) / np.array(base.seconds["step"]) - 1
    noise = max(TIMER, float(np.abs(ratio).max()))
    layout, mesh = model.system.layout, explanation.sizes
    return EffectsStudy(
        findings=tuple(_finding(s, explanation, cases, changes, together, noise) for s in found),
        advised=together.on,
        explanation=explanation,
        tolerance=scene.study.tolerance,
        repeats=repeats,
        builds=len(base.seconds["setup"]),
        noise=(float(ratio.min()), float(ratio.max())),
        noise_quartiles=quartiles(ratio),
        base={stage: float(np.median(base.seconds[stage])) for stage in ("mesh", "assembly", "setup", "step")}
        | {"memory": sum(base.bytes.values()), "flops": base.flops},
        sizes={
            "n_s": layout.n_s,
            "n_e": layout.n_e,
            "states": layout.states,
            "steps": scene.time.steps,
            "cells": mesh.cells,
        },
        elements=elements,
    )


def _fits(comm: MPI.Intracomm, explanation: Explanation, count: int) -> None:
    free = comm.bcast(psutil.virtual_memory().available)
    # matrices and vectors need about as much as the factor
    needed = 2 * count * explanation.solver.factor_bytes
    if needed > 0.8 * free:
        raise ResourceError(
            f"effects: {count} variants of the scene need about {needed:.3g} bytes at once and {free:.3g} are free; "
            "judge the effects on a coarser mesh, e.g. --set tissue.cells"
        )


Changes = dict[str, tuple[Change, float | None]]


def _switched(on: Names, found: tuple[Switch, ...], cases: dict[str, Case]) -> dict[Names, Model]:
    """The models that differ from the scene in one effect. Not collective."""
    return {on ^ {s.name}: cases[s.name].model for s in found if s.other is not None}


def _changes(runs: Experiments, found: tuple[Switch, ...], tick: Callable[[], None]) -> Changes:
    """Change by each effect alone, and under a force for those that do not show in the run. Collective."""
    result: Changes = {}
    for s in found:
        tick()
        if s.other is None:
            continue
        other = runs.on ^ {s.name}
        change = runs.change(runs.on, other)
        hidden = change.outputs <= runs.scene.study.tolerance
        result[s.name] = (change, runs.control(runs.on, other) if hidden else None)
    return result


def _counts(s: Switch, changes: tuple[Change, float | None], explanation: Explanation, scene: Scene) -> bool:
    """Whether the effect shows in the scene as it is, or its control problem needs it. Not collective."""
    change, control = changes
    return change.outputs > scene.study.tolerance or bool(_felt(s, control, explanation.effects[s.name], scene))


def _finding(
    s: Switch, explanation: Explanation, cases: dict[str, Case], changes: Changes, together: Together, noise: float
) -> Finding:
    scene = cases[SCENE].model.scene
    gate, tolerance = explanation.effects[s.name], scene.study.tolerance
    proof = None if s.on else prove_off(s.name, cases[SCENE], cases[AGAIN])
    if s.other is None:
        advice = f"Not tried: {s.reason}."
        return Finding(s.name, s.on, s.value, gate, "not tried", advice, None, None, None, None, proof)
    (change, control), company = changes[s.name], together.company[s.name]
    pair = (cases[SCENE], cases[s.name]) if s.on else (cases[s.name], cases[SCENE])
    cost = cost_of(*pair, noise)
    felt = _felt(s, control, gate, scene)
    shows = max(change.outputs, 0.0 if company.forced else company.together)
    verdict = judge(shows, bool(felt) or company.forced, cost.any, tolerance)
    if company.partners:
        advice = _advice_together(s, change.outputs, company, cases, tolerance)
    else:
        advice = _advice(s, verdict, change.outputs, felt, cost, tolerance)
        if verdict == "needed" and company.change.outputs <= tolerance:
            advice += f" Beside the other advised effects it changes them by {company.change.outputs:.1e} only."
    return Finding(s.name, s.on, s.value, gate, verdict, advice, change, control, company, cost, proof)


def _felt(s: Switch, control: float | None, gate: EffectReport, scene: Scene) -> str:
    """Why the control problem needs an effect that does not show in the run; empty if it does not."""
    if control is not None and control > scene.study.tolerance:
        return f"when a force moves the hand, as in the control problem, it changes them by {control:.2g}"
    if s.name == "damping" and scene.control is not None and gate.gate.matters:
        return "without damping no feedback stabilises the high modes in the control problem"
    return ""


def _advice(s: Switch, verdict: str, change: float, felt: str, cost: Cost, tolerance: float) -> str:
    if verdict == "needed":
        text = "Keep it: it changes" if s.on else "Switch it on if it acts: it would change"
        text += f" the outputs by {change:.2g}, tolerance {tolerance:g}"
        if s.strength is not None and change < 0.1:  # where the change still grows with the strength
            text += f"; below about {s.strength * tolerance / change:.2g} {s.unit} it would not show"
        return text + "."
    small = _small(change)
    if felt:
        return f"{'Keep' if s.on else 'Switch'} it{'' if s.on else ' on'} for control alone: it {small}, but {felt}."
    if verdict == "wasted":
        text = "Switch it off: it" if s.on else "Rightly off: it would cost and not show: it"
        return f"{text} {small} and adds {_extra(cost)}."
    return f"{'Keep or drop it' if s.on else 'Rightly off'}: it {small} and costs nothing in this run."


def _advice_together(s: Switch, change: float, company: Company, cases: dict[str, Case], tolerance: float) -> str:
    """For an effect that shows only when others are switched too."""
    partners = listed(company.partners)
    force = " when a force moves the hand, as in the control problem" if company.forced else ""
    number = f"the outputs by {company.together:.2g}{force}, tolerance {tolerance:g}"
    if company.either:
        return f"Keep it, or {partners}: each can go alone, but leaving out both changes {number}."
    begin = f"{'Keep it' if s.on else 'Switch it on'}{' for control' if force else ''}"
    switched = [name for name in company.partners if EFFECTS[name].active(cases[SCENE].model.scene)]
    state = f"without {partners}" if switched else f"with {partners} on"
    return f"{begin}, {state}: alone it {_small(change)}, but {state} it changes {number}."


def _small(change: float) -> str:
    return "changes nothing" if change == 0 else f"changes the outputs by {change:.1e} only"


def _extra(cost: Cost) -> str:
    parts = []
    if cost.flops_relative > 0:
        parts.append(f"{cost.flops_relative:.2g} of the operations of a step")
    if cost.memory_relative > 0:
        parts.append(f"{cost.memory_relative:.2g} of the memory")
    return " and ".join(parts)


def run_effects(
    path: Path, out: Path, overrides: list[str], console: Console, *, quiet: bool = False
) -> dict[str, Any]:
    """Judge the effects of a scene file and write result.json, tables, picture and report. Collective.

    Args:
        path: the scene file.
        out: folder of the results.
        overrides: as of ``--set``.
        console: writes on rank 0.
        quiet: no progress bar.

    Raises:
        SoftgraspError: with one sentence.
    """
    comm, begin = MPI.COMM_WORLD, time.perf_counter()
    scene = open_scene(path, overrides, console)
    console.print(f"effects at the tolerance {scene.study.tolerance:g}")
    with progress_bar(console, MofNCompleteColumn(), quiet=quiet) as bar:
        task = bar.add_task("runs", total=None)
        study = study_effects(scene, comm, lambda done, work: bar.update(task, completed=done, total=work))
    result, files = write_effects(study, scene, comm, path, out, overrides, begin)
    if comm.rank == 0:
        show(study, console)
        list_files(console, files)
    return result


def show(study: EffectsStudy, console: Console) -> None:
    """The table of verdicts, the advice and the proof, for a terminal. Not collective: call on one rank."""
    table = Table(
        "effect", "change", "deform.", "gate", "step", "memory", "verdict",
        box=None, pad_edge=False, collapse_padding=True, caption_justify="left",
        caption="change: of the outputs; deform.: relative to the hand; gate: number against threshold; "
        "step, memory: added; noise: as the scene against itself",
    )  # fmt: skip
    for f in study.findings:
        gate, cells = f.gate.gate, ["-"] * 4
        if f.change is not None and f.cost is not None:
            step = f"{f.cost.step_relative:+.1%}" if f.cost.step_shows else "noise"
            cells = [f"{f.change.outputs:.1e}", f"{f.change.deformation:.1e}", step, f"{f.cost.memory_relative:+.1%}"]
        number = f"{gate.number:.2g} {'>' if gate.number > gate.threshold else '<'} {gate.threshold:.2g}"
        table.add_row(f"{f.name} {'on' if f.on else 'off'}", *cells[:2], number, *cells[2:], f.label)
    console.print(table)
    for f in study.findings:
        value = f" ({f.value})" if f.value and f.on else f" (tried {f.value})" if f.value else ""
        console.print(Padding.indent(escape(f"{f.name}{value}: {f.advice}"), 2), highlight=False)
    console.print(Padding.indent(escape(judged_again(study)), 2), highlight=False)
    for text in study.warnings:
        console.print(Padding.indent(escape(f"look at: {text}"), 2), highlight=False)
    off = [f for f in study.findings if f.proof is not None]
    free = [f.name for f in off if f.proof is not None and f.proof.holds]
    if off:
        shown = f"without cost, by hashes, PETSc's objects, memory, operations and time: {', '.join(free) or 'none'}"
        console.print(f"off and {shown}")
        console.print(f"step time of the scene against itself: {study.noise[0]:+.1%} to {study.noise[1]:+.1%}")
    for f in off:
        if f.proof is not None and not f.proof.holds:
            console.print(Padding.indent(escape(f"{f.name}: {failed(f.proof)}"), 2), highlight=False)


def failed(proof: OffProof) -> str:
    """Which parts of a proof do not hold. Not collective."""
    names = ("same_operators", "zero_strength", "absent", "same_objects", "same_allocations", "declared", "same_work")
    lost = [name.replace("_", " ") for name in (*names, "within_noise") if getattr(proof, name) is False]
    return f"not shown: {', '.join(lost)} (step time {proof.step_ratio - 1:+.1%}, noise {proof.noise:.1%})"
