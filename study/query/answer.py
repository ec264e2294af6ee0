"""The answers to a query and their tables: one run in full, or one line a parameter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem import Array, Trajectory, hand_columns, placed
from softgrasp.fem.columns import hand_of, label_unit
from softgrasp.reduction import Certificate, CertifiedModel, Materials, ReducedTrajectory
from softgrasp.study.report import Share, Table, percent


@dataclass(frozen=True)
class CertifiedAnswer:
    """What is known at one parameter."""

    materials: Materials  # one per layer
    certificate: Certificate  # of the reduced run
    # the reduced run, the full one instead of it, or None when the error is above the tolerance
    run: ReducedTrajectory | Trajectory | None
    C_s: Array  # outputs of the hand per displacement q_s, (p, n_s)

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
        assert c.tolerance is not None  # else it passes
        ending = (
            "--fallback full runs the full model, --allow prints the answer nevertheless" if self.run is None
            else "the full model ran instead" if self.full else "it is shown because --allow was given"
        )  # fmt: skip
        return (
            f"The error {c.claim(percent(c.reduction))}, which is above the tolerance {percent(c.tolerance)}; {ending}."
        )

    @property
    def warnings(self) -> list[str]:
        """What a user should know of the answer, in sentences."""
        return [text for text in (self.refusal, *(() if self.full else self.certificate.reasons)) if text]

    @property
    def parameters(self) -> str:
        """Numbers of the first layer in words."""
        first = self.materials[0]
        return f"lambda = {first.lam:g} Pa, mu = {first.mu:g} Pa, rho = {first.rho:g} kg/m3"

    @property
    def shown(self) -> ReducedTrajectory | Trajectory:
        """The run of an answer that is not refused."""
        assert self.run is not None
        return self.run

    def deformation(self) -> Array:
        """Outputs against the hand, at every step, (steps + 1, p)."""
        return np.asarray(self.shown.outputs - self.shown.q_s @ self.C_s.T)

    def outputs(self) -> list[tuple[str, float, float, float | None, float | None]]:
        """Of each output its name, value at the end, largest deformation, bound and estimate of the error."""
        c, run, most = self.certificate, self.shown, np.abs(self.deformation()).max(axis=0)
        unknown = [None] * len(most)
        bounds = unknown if self.full else c.outputs.largest.tolist()
        about = unknown if self.full or c.outputs_estimate is None else c.outputs_estimate.largest.tolist()
        return list(zip(run.output_names, run.outputs[-1].tolist(), most.tolist(), bounds, about, strict=True))


@dataclass(frozen=True)
class QueryResult:
    """All answers to one query."""

    path: Path  # file of the certified model
    model: CertifiedModel  # model that answered
    each: Sequence[CertifiedAnswer]  # answers in the order of the parameters
    seconds: float  # time of the reduced model for all answers, with their errors [s]
    many: bool  # whether the parameters are rows of a table

    @property
    def counts(self) -> tuple[int, int, int]:
        """How many are refused, answered by the full model, outside the box of the training."""
        return (
            sum(a.run is None for a in self.each), sum(a.full for a in self.each),
            sum(not a.certificate.inside for a in self.each),
        )  # fmt: skip

    @property
    def worst(self) -> list[int]:
        """The answers with the largest errors, eight at most."""
        return sorted(range(len(self.each)), key=lambda i: -self.each[i].certificate.reduction)[:8]

    def parameter_table(self) -> Table:
        """One line a parameter; nothing for the outputs where the answer is refused."""
        header = ["lambda [Pa]", "mu [Pa]", "rho [kg/m^3]", "answered by", "inside the box", "error at most",
                  "kind of bound", "estimate", "time step", "mesh"]  # fmt: skip
        names = self.model.fine.outputs.names
        header += [
            f"{name} {what} [{label_unit(name)}]"
            for name in names
            for what in ("at the end", "largest deformation", "error at most")
        ]
        return Table(tuple(header), [_row(a, len(names)) for a in self.each], "Answers", best=self.worst)

    def table(self) -> Table:
        """One line a parameter, or hand, outputs and error bounds of the only run at every step."""
        if self.many:
            return self.parameter_table()
        (answer,) = self.each
        run, c, names = answer.shown, answer.certificate, answer.shown.output_names
        hand = hand_columns(run.q_s.shape[1], self.model.norms.dimension)
        header = [
            "t [s]",
            *(f"{x.label} [{x.unit}]" for x in hand),
            *(f"{name} [{label_unit(name)}]" for name in names),
        ]
        parts = [run.times, run.q_s, run.outputs]
        if not answer.full:
            header += [
                *(f"error of {name} at most [{label_unit(name)}]" for name in names),
                "energy norm of the error at most [J^0.5]",
            ]
            parts += [c.outputs.values, c.energy.values]
        return Table(tuple(header), np.column_stack(parts).tolist())


def _row(answer: CertifiedAnswer, count: int) -> list[Any]:
    first, c = answer.materials[0], answer.certificate
    estimate = None if c.estimate is None else c.estimate.relative
    mesh = None if c.mesh is None else c.mesh.largest
    reduction, *others = (None if x is None else Share(x) for x in (c.reduction, estimate, c.time_step, mesh))
    row: list[Any] = [first.lam, first.mu, first.rho, answer.source, c.inside, reduction]
    row += ["proof" if c.proved else "estimate", *others]
    return [*row, *([None] * (3 * count) if answer.run is None else (x for out in answer.outputs() for x in out[1:4]))]


def answer_rows(answer: CertifiedAnswer) -> list[tuple[str, str]]:
    """Outputs of the run of one answer and their errors, as pairs of label and text."""
    run, c = answer.shown, answer.certificate
    rows = [
        ("parameters", answer.parameters),
        ("answered by", f"{answer.source}, {len(run.times) - 1} steps of {1e3 * (run.times[1] - run.times[0]):.4g} ms"),
        ("hand at the end", placed(run.q_s[-1], hand_of(run.q_s.shape[1], run.output_names), 6)),
    ]
    for name, end, most, bound, about in answer.outputs():
        unit = label_unit(name)
        text = f"{end:.6g} {unit} at the end, deformed by {most:.4g} {unit} at most"
        text += "" if bound is None else f"; error at most {bound:.2g} {unit} ({c.how})"
        guess = f", about {about:.2g} {unit} (estimate)" if about is not None and c.proved else ""
        rows.append((name, text + guess))
    if not answer.full:
        first, *rest = c.sentence().split(" | ")
        rows += [("error", f"{first} of the {c.what}"), *(("", text) for text in rest)]
        if np.isfinite(c.effectivity_at_most):
            rows.append(("", f"the proof is at most {c.effectivity_at_most:.3g} times the true error"))
    return rows
