"""What ``softgrasp simulate`` returns: sizes, trajectory and warnings, as result.json, table and text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from softgrasp.fem import (
    Columns,
    Model,
    PETSc,
    Scene,
    Trajectory,
    counted,
    hand_columns,
    length_unit,
    make_outputs,
    placed,
)
from softgrasp.study.report import Table
from softgrasp.study.report.origin import origin, peak_memory_mb

if TYPE_CHECKING:
    from softgrasp.fem.run.contact.record import ContactRecord
    from softgrasp.fem.strain.newton import NewtonFigures


@dataclass(frozen=True)
class ModelSizes:
    """Numbers of unknowns and entities; ``states`` is 2n of the first-order system."""

    n_s: int  # number of unknowns of the hand
    n_e: int  # number of unknowns of the tissue
    states: int  # number of states of the first-order system, 2n
    cells: int  # number of cells
    nodes: int  # number of nodes
    nonzeros: int  # number of entries of K_ee
    ranks: int  # number of ranks


def model_sizes(model: Model) -> ModelSizes:
    """Sizes of a built model. Collective."""
    layout, space = model.system.layout, model.space
    return ModelSizes(
        n_s=layout.n_s,
        n_e=layout.n_e,
        states=layout.states,
        cells=int(space.mesh.mesh.topology.index_map(layout.dimension).size_global),
        nodes=space.V.dofmap.index_map.size_global,
        nonzeros=int(model.system.K_ee.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"]),
        ranks=layout.comm.size,
    )


def output_places(model: Model) -> dict[str, str]:
    """The node that is taken for each output, or the nodes of its mean, in words. Collective."""
    return {o.name: o.place for o in make_outputs(model.scene, model.system) if o.place}


@dataclass(frozen=True)
class Simulation:
    """A run of the full model."""

    scene: Scene  # as it was run
    sizes: ModelSizes  # unknowns and entities
    dimension: int  # 2 or 3
    run: Trajectory  # the trajectory
    places: dict[str, str]  # where each output is taken, in words
    warnings: tuple[str, ...]  # one sentence each
    memory_peak_mb: float  # largest memory, over all ranks [MiB]
    forms: int  # number of compiled forms
    operators: Sequence[str]  # names of the assembled operators

    @property
    def force_peak(self) -> dict[str, float]:
        """Largest force on the hand along each axis [N, N m]."""
        return {c.axis: float(x) for c, x in zip(self.hand(), np.abs(self.run.force).max(axis=0), strict=True)}

    def hand(self, name: str = "hand") -> Columns:
        """The hand's degrees of freedom."""
        return hand_columns(self.sizes.n_s, self.dimension, name)

    def to_json(self) -> dict[str, Any]:
        """The keys of ``result.json``."""
        scene, sizes, run = self.scene, self.sizes, self.run
        stages = {key: value for key, value in run.seconds.items() if key not in ("steps", "per_step")}
        return {
            "command": "simulate",
            **origin(scene, sizes.ranks),
            "n_s": sizes.n_s,
            "n_e": sizes.n_e,
            "states": sizes.states,
            "cells": sizes.cells,
            "steps": scene.time.steps,
            "dt": scene.time_end / scene.time.steps,
            "solver": run.solver._asdict(),
            "residual_first": run.residuals[0],
            "residual_last": run.residuals[1],
            "hand_final": run.q_s[-1].tolist(),
            "output_names": list(run.output_names),
            "output_final": run.outputs[-1].tolist(),
            "output_places": self.places,
            "energy_drift": run.energy_drift,
            **({} if run.newton is None else {"newton": newton_keys(run.newton)}),
            **({} if run.contact is None else {"contact": contact_keys(run.contact)}),
            "force_peak": self.force_peak,
            "time": {
                **stages,
                "steps_timed": run.steps_timed,
                "steps": run.seconds["steps"],
                "per_step": run.seconds["per_step"],
            },
            "memory_peak_mb": self.memory_peak_mb,
            "forms": self.forms,
            "operators": list(self.operators),
            "warnings": list(self.warnings),
        }

    def rows(self) -> list[tuple[str, str]]:
        """The short table of a run as label and text."""
        run, seconds, steps = self.run, self.run.seconds, self.scene.time.steps
        loads = [f"{c.axis} {self.force_peak[c.axis]:.4g} {c.load_unit}" for c in self.hand()]
        step = seconds["per_step"]
        each = f"{1e6 * step:.4g} us" if step < 1e-3 else f"{1e3 * step:.4g} ms"
        timed = f"{steps}" if run.steps_timed == steps else f"{run.steps_timed} of {steps}, since the run was resumed,"
        return [
            ("hand at the end", placed(run.q_s[-1], self.hand(), 6)),
            *((c.label, f"{y:.6g} {c.unit}") for c, y in zip(run.columns, run.outputs[-1], strict=True)),
            *self.places.items(),
            ("largest force on the hand", ", ".join(loads)),
            *([] if run.contact is None else contact_rows(run.contact)),
            ("energy drift", f"{run.energy_drift:.1e}"),
            *([("iterations", newton_text(run.newton))] if run.newton else []),
            ("residual, first and last", f"{run.residuals[0]:.1e}, {run.residuals[1]:.1e}"),
            ("solver", f"{run.solver.name}, by {run.solver.package}"),
            ("", run.solver.reason),
            ("mesh, assembly, factor", ", ".join(f"{seconds[key]:.3g} s" for key in ("mesh", "assembly", "factor"))),
            ("steps", f"{timed} in {seconds['steps']:.3g} s, {each} each"),
            ("peak memory, all ranks", f"{self.memory_peak_mb:.0f} MiB"),
        ]

    def summary(self) -> list[str]:
        """What came out, in three sentences."""
        run, sizes = self.run, self.sizes
        lag = np.abs(run.outputs - run.outputs_rigid).max(axis=0, initial=0.0)
        texts = [f"At t = {run.times[-1]:.4g} s the hand is at {placed(run.q_s[-1], self.hand(), 4)}."]
        if len(lag):
            i = int(lag.argmax())
            unit = run.columns[i].unit
            factor, unit = length_unit(lag[i]) if unit == "m" else (1.0, unit)
            last = abs(run.outputs[-1, i] - run.outputs_rigid[-1, i])
            texts.append(
                f"The output {run.columns[i].label} deviates from the rigid motion of the hand by up to "
                f"{factor * lag[i]:.3g} {unit} and by {factor * last:.3g} {unit} at the end."
            )
        texts.append(
            f"The {run.steps_timed} steps of {sizes.n_e} unknowns took {run.seconds['steps']:.3g} s; the energy "
            f"drifted by {run.energy_drift:.1e} of its largest value."
        )
        return texts

    def trajectory(self) -> Table:
        """State and energies at each time t, mean force of the step that ends there; nan in the first row."""
        run, n_s = self.run, self.sizes.n_s
        header = trajectory_header(n_s, self.dimension, run.columns, velocity=True)
        header += [f"{c.label} [{c.load_unit}]" for c in self.hand("force")]
        header += ["energy [J]", "dissipated [J]"]
        parts = [run.times, run.q_s, run.v_s, run.outputs, np.vstack([np.full(n_s, np.nan), run.force])]
        parts += [run.energy, run.dissipated]
        if run.contact is not None:
            more, values = contact_columns(run.contact)
            header, parts = header + more, [*parts, values]
        return Table(tuple(header), np.column_stack(parts).tolist())


def contact_keys(contact: ContactRecord) -> dict[str, Any]:
    """What obstacles did, for result.json: forces [N], gaps [m], energies [J]."""
    return {
        "penetration": contact.penetration,
        "chatter": contact.chatter,
        "chatter_end": contact.chatter_end,
        "work": contact.work,
        "taken_by_touch": contact.touch,
        "taken_by_impulses": contact.stopped,
        "taken_by_friction": contact.rubbed,
        "rounds": contact.rounds,
        "columns": contact.columns,
        "boundary_nodes": contact.nodes,
        "force_end": contact.force_end.sum(axis=0).tolist(),
        "force_max": float(np.linalg.norm(contact.force.sum(axis=1), axis=1).max()),
        "obstacles": {
            name: {
                "gap_min": float(contact.gap[:, o].min()),
                "touch_share": float((contact.touching[:, o] > 0).mean()),
                "force_max": float(np.linalg.norm(contact.force[:, o], axis=1).max()),
                "force_end": contact.force_end[o].tolist(),
                "impulse": contact.impulse[:, o].sum(axis=0).tolist(),
                "nodes_max": int(contact.touching[:, o].max()),
            }
            for o, name in enumerate(contact.names)
        },
    }


def contact_columns(contact: ContactRecord) -> tuple[list[str], Any]:
    """Header, and force, gap and touching nodes of each obstacle at each time, (times, columns); no force at first."""
    header, parts, d = [], [], contact.force.shape[2]
    for o, name in enumerate(contact.names):
        header += [f"{name}_force_{axis} [N]" for axis in "xyz"[:d]] + [f"{name}_gap [m]", f"{name}_touching [1]"]
        steps = np.column_stack([contact.force[:, o], contact.gap[1:, o], contact.touching[:, o]])
        parts.append(np.vstack([[*[np.nan] * d, contact.gap[0, o], 0.0], steps]))
    return header, np.hstack(parts)


def contact_rows(contact: ContactRecord) -> list[tuple[str, str]]:
    """What obstacles did, in words: one row each, and the energy that they dissipated."""
    rows = []
    without = "it" if contact.touching.any() else "the effect"
    for o, name in enumerate(contact.names):
        count, gap = int(contact.touching[:, o].max()), float(contact.gap[:, o].min())
        force = ", ".join(f"{x:.4g}" for x in contact.force_end[o])
        touched = (
            f"force ({force}) N at the end, at most {counted(count, 'node')} touching"
            if count
            else f"never touched, least gap {gap:.3g} m: without {without} the run is the same"
        )
        rows.append((f"obstacle {name}", touched))
    if len(contact.names) > 1 and contact.touching.any():
        force = ", ".join(f"{x:.4g}" for x in contact.force_end.sum(axis=0))
        rows.append(("all obstacles", f"force ({force}) N at the end"))
    taken = f"{contact.touch:.3g} J at first touch, {contact.stopped:.3g} J by impulses"
    taken += f", {contact.rubbed:.3g} J by friction" if contact.rubbed else ""
    last = f", the last in step {contact.chatter_end} of {len(contact.force)}" if contact.chatter else ""
    kept = f"{contact.penetration:.1e} m, {contact.chatter}{last}"
    return [*rows, ("dissipated by contact", taken), ("deepest penetration, chatter", kept)]


def newton_keys(newton: NewtonFigures) -> dict[str, float]:
    """How the steps of finite strain converged, for result.json."""
    keys = {"mean": newton.mean, "max": newton.max, "factors": newton.factors, "divided": newton.substepped}
    return keys | ({"min_J": newton.min_det} if np.isfinite(newton.min_det) else {})


def newton_text(newton: NewtonFigures) -> str:
    """How the steps of finite strain, or in a turning frame, converged, in words."""
    substeps = f", {counted(newton.substepped, 'step')} by substeps" if newton.substepped else ""
    if not np.isfinite(newton.min_det):  # the linear law has no det F
        return f"{newton.mean:.3g} a step, at most {newton.max}"
    return (
        f"{newton.mean:.3g} a step, at most {newton.max}, {counted(newton.factors, 'new tangent')}{substeps}; "
        f"smallest det F {newton.min_det:.3g}"
    )


def simulate_result(model: Model, run: Trajectory, warnings: Sequence[str] = ()) -> Simulation:
    """A run with the sizes of its model. Collective."""
    return Simulation(
        scene=model.scene,
        sizes=model_sizes(model),
        dimension=model.system.layout.dimension,
        run=run,
        places=output_places(model),
        warnings=(*model.space.mesh.notes, *warnings),
        memory_peak_mb=peak_memory_mb(model.system.layout.comm),
        forms=len(model.inventory.forms),
        operators=model.inventory.operators,
    )


def trajectory_header(n_s: int, dimension: int, outputs: Columns, velocity: bool) -> list[str]:
    """Columns of trajectory.csv with their units: time, hand, velocity on request, outputs."""
    header = ["t [s]", *(f"{c.label} [{c.unit}]" for c in hand_columns(n_s, dimension))]
    if velocity:
        header += [f"{c.label} [{c.unit}/s]" for c in hand_columns(n_s, dimension, "hand_velocity")]
    for column in outputs:
        text = f"{column.label} [{column.unit}]"
        header.append(text if text not in header else f"output_{text}")
    return header
