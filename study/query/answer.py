"""The answer to a query as rows of the terminal and as tables: one run in full, or one line a parameter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softgrasp.fem.columns import hand_columns
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.trajectory import Trajectory
from softgrasp.reduction.certified.certificate import Certificate
from softgrasp.reduction.certified.motion import Materials
from softgrasp.reduction.online import ReducedTrajectory
from softgrasp.study.report.tables import Table


@dataclass(frozen=True)
class Answer:
    """What is known at one parameter."""

    materials: Materials  # one per layer
    certificate: Certificate  # of the reduced run
    # the reduced run, the full one instead of it, or None when the error is above the tolerance
    run: ReducedTrajectory | Trajectory | None

    @property
    def full(self) -> bool:
        """Whether the full model ran."""
        return isinstance(self.run, Trajectory)

    @property
    def source(self) -> str:
        """Which model answers, in words."""
        return "refused" if self.run is None else "full model" if self.full else "reduced model"

    @property
    def refusal(self) -> str:
        """Why the reduced model does not answer, and what comes instead; empty when its error is small enough."""
        c = self.certificate
        if c.passed:
            return ""
        ending = (
            "--fallback full runs the full model, --allow shows the answer all the same" if self.run is None
            else "the full model ran instead" if self.full else "it is shown because --allow was given"
        )  # fmt: skip
        claim = c.claim(f"{c.reduction:.2g}")
        return f"The error {claim}, which is above the tolerance {c.tolerance:g}; {ending}."

    @property
    def warnings(self) -> list[str]:
        """What a user should know of the answer, in sentences."""
        return [text for text in (self.refusal, *(() if self.full else self.certificate.reasons)) if text]

    def deformation(self, C_s: Array) -> Array:
        """Outputs against the hand, at every step; C_s are those of the hand, (p, n_s)."""
        assert self.run is not None
        return np.asarray(self.run.outputs - self.run.q_s @ C_s.T)


def parameters(materials: Materials) -> str:
    """Numbers of the first layer in words."""
    first = materials[0]
    return f"lambda = {first.lam:g} Pa, mu = {first.mu:g} Pa, rho = {first.rho:g} kg/m^3"


def answer_rows(answer: Answer, C_s: Array) -> list[tuple[str, str]]:
    """The run of one parameter as label and text.

    Args:
        answer: with a run.
        C_s: outputs of the hand, (p, n_s).
    """
    run, c = answer.run, answer.certificate
    assert run is not None
    times, deformation = run.times, np.abs(answer.deformation(C_s)).max(axis=0)
    rows = [
        ("parameters", parameters(answer.materials)),
        ("answered by", f"{answer.source}, {len(times) - 1} steps of {1e3 * (times[1] - times[0]):.4g} ms"),
        ("hand at the end", "(" + ", ".join(f"{x:.6g}" for x in run.q_s[-1]) + ")"),
    ]
    for i, name in enumerate(run.output_names):
        text = f"{run.outputs[-1, i]:.6g} at the end, deformed by {deformation[i]:.4g} at most"
        if not answer.full:
            text += f"; error at most {c.outputs.largest[i]:.2g} ({c.how})"
            if c.outputs_estimate is not None and c.proved:
                text += f", about {c.outputs_estimate.largest[i]:.2g} (estimate)"
        rows.append((name, text))
    if not answer.full:
        first, _, rest = c.sentence().partition(" | ")
        where = f"of the {c.what}"
        rows.append(("error", f"{first} {where}"))
        rows += [("", text) for text in rest.split(" | ")]
        if np.isfinite(c.effectivity_at_most):
            rows.append(("", f"the proof is at most {c.effectivity_at_most:.3g} times the true error"))
    return rows


def trajectory_table(answer: Answer, dimension: int) -> Table:
    """Hand, outputs and error bounds at every step; nothing for the bounds where the full model answers."""
    run, c = answer.run, answer.certificate
    assert run is not None
    names = run.output_names
    header = ["t [s]", *(f"{x.label} [{x.unit}]" for x in hand_columns(run.q_s.shape[1], dimension)), *names]
    parts = [run.times, run.q_s, run.outputs]
    if not answer.full:
        header += [*(f"error of {name} at most" for name in names), "energy norm of the error at most [J^0.5]"]
        parts += [c.outputs.values, c.energy.values]
    return Table(tuple(header), np.column_stack(parts).tolist())


def batch_table(answers: Sequence[Answer], names: Sequence[str], C_s: Array) -> Table:
    """One line a parameter; nothing for the outputs where the answer is refused."""
    header = ["lambda [Pa]", "mu [Pa]", "rho [kg/m^3]", "answered by", "inside the box", "error at most",
              "kind of bound", "estimate", "time step", "mesh"]  # fmt: skip
    header += [f"{name} {what}" for name in names for what in ("at the end", "largest deformation", "error at most")]
    return Table(tuple(header), [_batch_row(a, len(names), C_s) for a in answers])


def _batch_row(answer: Answer, count: int, C_s: Array) -> list[Any]:
    first, c, run = answer.materials[0], answer.certificate, answer.run
    estimate = None if c.estimate is None else c.estimate.relative
    mesh = None if c.mesh is None else c.mesh.largest
    row: list[Any] = [first.lam, first.mu, first.rho, answer.source, c.inside, c.reduction]
    row += ["proof" if c.proved else "estimate", estimate, c.time_step, mesh]
    if run is None:
        return [*row, *[None] * (3 * count)]
    deformation = np.abs(answer.deformation(C_s)).max(axis=0)
    for i in range(count):
        bound = None if answer.full else float(c.outputs.largest[i])
        row += [float(run.outputs[-1, i]), float(deformation[i]), bound]
    return row
