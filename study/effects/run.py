"""``softgrasp effects``: which effects a scene calls for, what each costs, and proof that the others cost nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from rich.console import Console
from rich.progress import MofNCompleteColumn

from softgrasp.fem import Model, ResourceError, Scene, SolverError, adapt, free_bytes, rigid_inertia, size_text
from softgrasp.fem.errors import MeshError, SceneError
from softgrasp.study.effects.experiments import SwitchRuns, check_elements
from softgrasp.study.effects.measure import (
    AGAIN,
    SCENE,
    MeasuredScene,
    bare_output,
    ends,
    gaps,
    measure_builds,
    measure_steps,
    objects_of,
)
from softgrasp.study.effects.page import compose
from softgrasp.study.effects.result import EffectsStudy
from softgrasp.study.effects.switch import Scales, switches
from softgrasp.study.effects.together import Changes, advised
from softgrasp.study.effects.verdict import assess, shows
from softgrasp.study.forward.copies import fewer_cells
from softgrasp.study.forward.explain import Explanation, explain_model
from softgrasp.study.report import percent
from softgrasp.study.report.origin import origin, peak_memory_mb
from softgrasp.study.shell import Session, folder_lock

# Unknowns of the runs that changes of the outputs are measured on, by dimension. On 8 000 instead of 26 000 the changes
# of paper_forward differ by up to 1.7 %, that by finite strain alone by 17 %: 2.6 % for 3.1 % of the outputs.
MOST_TRIED = {2: 8_000, 3: 6_000}
TIMER = 0.03  # relative difference of two equal runs that cache and page placement can leave in every sample


def study_effects(
    scene: Scene, comm: MPI.Intracomm, progress: Callable[[int, int], None] | None = None
) -> EffectsStudy:
    """Measure every effect of a scene on and off, as its section study asks. Collective.

    ``progress`` is called with steps of work done and in all.

    Raises:
        SceneError, MeshError: the scene cannot be built.
        SolverError: a solve failed.
        ResourceError: the factors of all variants would not fit in memory at once.
    """
    scene = bare_output(scene)
    model = adapt.build(scene, comm=comm)  # also compiles the forms
    mesh = adapt.adapted_mesh(model)
    explanation = explain_model(model)
    scales = scales_of(model, explanation)
    effects = switches(scene, scales)
    tried = [s for s in effects if s.other is not None]
    scenes = {SCENE: scene} | {s.name: s.other for s in tried if s.other is not None} | {AGAIN: scene}
    check_variants(scene, comm, explanation, len(scenes))
    repeats, steps = scene.study.repeats, count(1)

    def tick() -> None:
        if progress is not None:
            progress(next(steps), (2 * repeats + 1) * len(scenes))

    cases = measure_builds(comm, scenes, repeats, tick, mesh)
    on = frozenset(s.name for s in effects if s.on)
    models = {on: cases[SCENE].model} | {on ^ {s.name}: cases[s.name].model for s in tried}
    copy = coarser_model(model)
    runs = SwitchRuns(scene, scales, models, mesh) if copy is None else SwitchRuns(copy.scene, scales, {on: copy})
    changes: Changes = {}
    for s in tried:
        try:
            changes[s.name] = runs.alone(s.name)
        except SolverError as error:
            if s.on or s.name != "finite_strain":
                raise
            # on trial it may leave what its law describes: then there is nothing to compare
            failed = replace(s, other=None, reason=f"the run with it fails ({error})")
            effects = tuple(failed if e is s else e for e in effects)
            del cases[s.name]
        tick()
    needed = frozenset(
        s.name for s in tried if s.name in changes and shows(s, changes[s.name], explanation.effects[s.name], scene)
    )
    together = advised(runs, needed, changes)
    elements = check_elements(models[on], runs.first if copy is None else None, scene.study.tolerance, mesh)
    measure_steps(comm, cases, repeats, tick)
    for name, case in cases.items():
        case.objects, case.objects_in_steps = objects_of(comm, scenes[name], mesh)
    base, again = cases[SCENE], cases[AGAIN]
    ratio = np.array(again.seconds["step"]) / np.array(base.seconds["step"]) - 1
    noise = {stage: float(np.abs(gaps(again, base, stage)).max()) for stage in ("assembly", "setup")}
    noise["step"] = max(TIMER, float(np.abs(ratio).max()))
    return EffectsStudy(
        findings=tuple(assess(s, explanation, cases, changes, together, noise) for s in effects),
        advised=together.on,
        beside=together.beside,
        explanation=explanation,
        tolerance=scene.study.tolerance,
        repeats=repeats,
        builds=len(base.seconds["setup"]),
        noise=ends(ratio),
        noise_quartiles=ends(ratio, 0.25),
        base=_cost_of(base, None if mesh is None else model.watch.seconds["mesh"]),
        sizes={name: getattr(model.system.layout, name) for name in ("n_s", "n_e", "states")}
        | {"steps": scene.time.steps, "cells": explanation.sizes.cells},
        elements=elements,
        coarser=0 if copy is None else copy.system.layout.n_e,
    )


def scales_of(model: Model, explanation: Explanation) -> Scales:
    """What the trial values of a scene rest on. Collective."""
    omega = explanation.time.omega
    return Scales(model.system.layout.dimension, *rigid_inertia(model), float(omega[0]) if len(omega) else None)


def coarser_model(model: Model) -> Model | None:
    """The scene of a large box on fewer cells, which changes are measured on; None of any other scene. Collective."""
    scene = fewer_cells(model, MOST_TRIED)
    try:
        return None if scene is None else adapt.build(scene, comm=model.system.layout.comm)
    except (MeshError, SceneError):  # these cells miss the zone or a layer
        return None


def _cost_of(case: MeasuredScene, mesh: float | None) -> dict[str, float]:
    """Median times by stage [s], "memory" [byte] and "flops" of a step.

    ``mesh``: time of a mesh that all variants share [s]; None where the scene has its own.
    """
    times = {stage: float(np.median(case.seconds[stage])) for stage in ("mesh", "assembly", "setup", "step")}
    if mesh is not None:
        times["mesh"] = mesh
    return times | {"memory": sum(case.bytes.values()), "flops": case.flops}


def check_variants(scene: Scene, comm: MPI.Intracomm, explanation: Explanation, variants: int) -> None:
    """Refuse so many variants of the scene where they would not fit in memory at once. Collective."""
    free = comm.bcast(free_bytes(scene))
    # matrices and vectors need about as much as the factor
    needed = 2 * variants * explanation.solver.factor_bytes
    if needed > 0.8 * free:
        raise ResourceError(
            f"effects: {variants} variants of the scene need about {size_text(needed)} at once, where "
            f"{size_text(0.8 * free)} are available; judge the effects on a coarser mesh, e.g. --set tissue.cells, "
            "or allow more with --set output.memory=GIB"
        )


@folder_lock()
def run_effects(
    path: Path, out: Path, overrides: list[str], console: Console, *, quiet: bool = False, empty: bool = False
) -> dict[str, Any]:
    """Test the effects of a scene file and write result.json, table, picture and page. Collective.

    Args:
        path: scene file or name of a scene that ships.
        out: folder of the results.
        overrides: ``KEY=VALUE`` of ``--set``.
        console: terminal.
        quiet: no progress bars.
        empty: remove what an earlier run has left in the folder.

    Returns the content of result.json.
    """
    session = Session("effects", path, overrides, out, console, quiet, empty=empty)
    comm, scene = session.comm, session.scene()
    console.print(f"effects count where they change the outputs by more than {percent(scene.study.tolerance)}")
    with session.progress(MofNCompleteColumn()) as bar:
        task = bar.add_task("runs", total=None)
        study = study_effects(scene, comm, lambda done, work: bar.update(task, completed=done, total=work))
    result = {"command": "effects", **origin(scene, comm.size), **study.to_dict()}
    result |= {"memory_peak_mb": peak_memory_mb(comm), "time": {}}
    session.write(scene, result, lambda: compose(study, scene, session))
    return result
