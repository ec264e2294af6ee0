"""``softgrasp reduce``: reduced models of a scene, their errors and their times beside the full model's."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Unpack

from rich.console import Console

from softgrasp.fem import Scene, SceneError
from softgrasp.study.reduce.linear import measure
from softgrasp.study.reduce.linear.run import run_linear
from softgrasp.study.shell import Flags, Session, folder_lock


def check_scene(scene: Scene) -> tuple[str, ...]:
    """Methods of the scene. Raises SceneError: it keeps no snapshots for a basis. BasisError: a method is unknown."""
    if scene.output.snapshots not in ("auto", "memory"):
        raise SceneError(
            f"output.snapshots is '{scene.output.snapshots}'; it must be 'memory' for a reduction, which builds its "
            "bases from the states in memory"
        )
    if scene.effects.obstacles:
        from softgrasp.study.reduce.contact.run import check_contact  # models of another kind

        check_contact(scene)
        return ()
    if scene.effects.frame is not None:
        if scene.reduction.certify != "off" or scene.reduction.train == "greedy":
            scene.refuse_frame("a certified model")
        if scene.effects.finite_strain is not None:
            return ()
        from softgrasp.study.reduce.turning.measure import turning_methods  # models of another kind

        return turning_methods(scene)
    return measure.chosen_methods(scene)


@folder_lock()
def run_reduce(
    path: Path,
    out: Path,
    overrides: list[str],
    console: Console,
    *,
    tolerance: float | None = None,
    **flags: Unpack[Flags],
) -> dict[str, Any]:
    """Reduce a scene file by all its methods, or build one certified model, and write the results. Collective."""
    if tolerance is not None:
        overrides = [*overrides, f"reduction.tolerance={tolerance}", 'reduction.train="greedy"']
    session = Session("reduce", path, overrides, out, console, **flags)
    scene = session.scene()
    names = check_scene(scene)
    if scene.effects.obstacles:
        from softgrasp.study.reduce.contact.run import run_contact

        return run_contact(session, scene)
    if scene.reduction.certify != "off" or scene.reduction.train == "greedy":
        from softgrasp.study.reduce.certified.run import run_certify  # only certified models pay for it

        return run_certify(session, scene)
    if scene.effects.frame is not None and scene.effects.finite_strain is None:
        from softgrasp.study.reduce.turning.run import run_turning

        return run_turning(session, scene, names)
    if scene.effects.finite_strain is not None:
        from softgrasp.study.reduce.strain.run import run_strain  # models of another kind

        return run_strain(session, scene)
    return run_linear(session, scene, names)
