"""Numbers of a run as files: result.json, trajectories as CSV, the resolved scene."""

from __future__ import annotations

import csv
import json
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp import package_version
from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.model.build import Model
from softgrasp.fem.model.outputs import hand_axes, make_outputs, unit
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.trajectory import Trajectory
from softgrasp.fem.scene.file import resolved_toml
from softgrasp.study.report.origin import peak_memory_mb


def simulate_result(model: Model, run: Trajectory) -> dict[str, Any]:
    """The keys of ``result.json``. Collective."""
    layout, comm = model.system.layout, model.system.layout.comm
    steps = model.scene.time.steps
    seconds = run.seconds
    mesh = model.space.mesh.mesh
    cells = mesh.topology.index_map(model.space.mesh.dimension).size_global
    axes = hand_axes(layout.n_s, layout.dimension)
    return {
        "command": "simulate",
        "scene": model.scene.name,
        "scene_hash": scene_hash(model.scene),
        "version": package_version(),
        "ranks": comm.size,
        "machine": f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}",
        "n_s": layout.n_s,
        "n_e": layout.n_e,
        "states": layout.states,
        "cells": int(cells),
        "steps": steps,
        "dt": model.scene.time_end / steps,
        "solver": {"name": run.solver[0], "reason": run.solver[1]},
        "residual_first": run.residuals[0],
        "residual_last": run.residuals[1],
        "hand_final": run.q_s[-1].tolist(),
        "output_names": list(run.output_names),
        "output_final": run.outputs[-1].tolist(),
        "output_places": {o.name: o.place for o in make_outputs(model.scene, model.system) if o.place},
        "energy_drift": run.energy_drift,
        **({} if run.force is None else {"force_peak": dict(zip(axes, _peaks(run.force), strict=True))}),
        "time": {
            **{key: value for key, value in seconds.items() if key not in ("steps", "per_step")},
            "steps_timed": run.steps_timed,
            "steps": seconds["steps"],
            "per_step": seconds["per_step"],
        },
        "memory_peak_mb": peak_memory_mb(comm),
        "forms": len(model.inventory.forms),
        "operators": model.inventory.operators,
    }


def _peaks(force: Array) -> list[float]:
    return [float(x) for x in np.abs(force).max(axis=0)]


def trajectory_header(
    n_s: int, dimension: int, outputs: Sequence[str], velocity: bool, force: bool = False
) -> list[str]:
    """Columns of trajectory.csv with their units: time, hand, velocity on request, outputs, force on request.

    Not collective.
    """
    hand = [f"hand_{axis}" for axis in hand_axes(n_s, dimension)]
    columns = ["t [s]", *(f"{name} [{unit(name)}]" for name in hand)]
    if velocity:
        rates = [f"hand_velocity_{axis}" for axis in hand_axes(n_s, dimension)]
        columns += [f"{name} [{unit(name, rate=True)}]" for name in rates]
    for name in outputs:
        column = f"{name} [{unit(name)}]"
        columns.append(column if column not in columns else f"output_{column}")
    if force:
        columns += [f"force_{axis} [{force_unit(axis)}]" for axis in hand_axes(n_s, dimension)]
    return columns


def force_unit(axis: str) -> str:
    """Unit of the load on a hand degree of freedom: N, or N m on a rotation. Not collective."""
    return "N m" if axis.startswith("r") else "N"


def write_results(directory: Path, model: Model, run: Trajectory, result: dict[str, Any]) -> list[Path]:
    """Write result.json, trajectory.csv and scene.toml. Rank 0 only.

    A row of the table has the state at its time, and the force in the step that ends there, nan in the first row.
    """
    directory.mkdir(parents=True, exist_ok=True)
    table = directory / "trajectory.csv"
    n_s = run.q_s.shape[1]
    header = trajectory_header(
        n_s, model.system.layout.dimension, run.output_names, velocity=True, force=run.force is not None
    )
    parts = [run.times, run.q_s, run.v_s, run.outputs]
    if run.force is not None:
        parts.append(np.vstack([np.full(n_s, np.nan), run.force]))
    rows = np.column_stack(parts)
    with table.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([f"{x:.17g}" for x in row] for row in rows)
    scene = directory / "scene.toml"
    scene.write_text(resolved_toml(model.scene))
    path = directory / "result.json"
    path.write_text(json.dumps(result, indent=2) + "\n")
    return [path, table, scene]
