"""Whether linear elasticity is within its range where a fit ends, and what finite strain would change there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from softgrasp.fem.effects.finite_strain import linear_error
from softgrasp.fem.model.scales import gradient
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.shown import percent
from softgrasp.fem.strain.laws import LawName
from softgrasp.reduction.identify.fit import Linearisation, Misfit
from softgrasp.reduction.identify.near import moved_as, same_motion
from softgrasp.reduction.identify.parts import OutputErrors
from softgrasp.reduction.identify.result import Identified
from softgrasp.reduction.identify.strained import check_strained, strained_model
from softgrasp.reduction.identify.unknowns import Unknown
from softgrasp.reduction.identify.verdict import CHANCE, OUTLIER, unseen

LOOKED_AT = 20  # instants of a run where its strain is looked at
SURE = 2.5  # error of linear elasticity over its estimate, at most, as far as it was measured
DEFAULT: LawName = "neo-hooke"
LINEAR = "linear elasticity"  # name of its part


@dataclass(frozen=True)
class LinearRange:
    """How far linear elasticity carries at the values of a fit."""

    error: float  # estimated error of the deformation [1]
    most: float  # most that this may change a value, over the noise of the value [1]

    @property
    def left(self) -> bool:
        """Whether finite strain may change a value by more than the noise does."""
        return self.most > 1

    def sentence(self, hint: str) -> str:
        """That it may be beyond its range."""
        return (
            f"Linear elasticity has an error of about {percent(self.error)} of the deformation here, which may change "
            f"the values by more than the noise: {hint}."
        )


def linear_range(misfit: Misfit, p: Array) -> LinearRange:
    """Estimate from the gradient of the largest displacement of the reduced runs. Collective.

    An error delta y of the outputs changes a value by J+ delta y, at most by its noise times |delta y / sigma|.
    """
    theta, model = np.exp(p[: misfit.k]), misfit.near.model
    d, comm, worst, square = model.system.layout.dimension, model.system.layout.comm, 0.0, 0.0
    C_s = np.vstack([o.C_s for o in model.outputs])
    for i, answer in enumerate(misfit.answers(p)[1]):
        Z = misfit.near.displacements(theta, answer, LOOKED_AT)
        if Z is None:
            return LinearRange(0.0, 0.0)
        sizes = total(comm, np.einsum("ij,ij->j", Z, Z))
        error = linear_error(gradient(model, Z[:, int(np.argmax(sizes))]).rms, d)
        deformation = misfit.measured(i, answer.outputs - answer.q_s @ C_s.T, p)
        worst, square = max(worst, error), square + float((error * deformation) @ (error * deformation))
    return LinearRange(worst, SURE * square**0.5)


def strain_part(
    misfit: Misfit, line: Linearisation, p: Array, errors: OutputErrors, unknowns: Sequence[Unknown], law: LawName
) -> Array:
    """J+ (y at finite strain - y) by full runs at the values, (k,). Collective.

    Raises SceneError, SolverError: there is no such run.
    """
    theta, experiments = np.exp(p[: misfit.k]), misfit.experiments
    check_strained(misfit.near.model, unknowns, experiments)
    strained = strained_model(misfit.near.full(theta), law)
    runs: dict[int, Array] = {}
    delta = []
    for i, (e, answer) in enumerate(zip(experiments, misfit.answers(p)[1], strict=True)):
        same = same_motion(i, e)
        if same not in runs:
            runs[same] = simulate(replace(strained, scene=moved_as(strained.scene, e))).outputs
        lost = errors.signed["reduction"]
        delta.append(runs[same] - answer.outputs - (0.0 if lost is None else lost[i]))
    return np.asarray(line.inverse @ misfit.together(delta, p))


def not_yet(answer: Identified) -> bool:
    """Whether an answer lacks what no other law gives: a finer mesh or step, or more data."""
    parts = [answer.parts[name] for name in ("mesh", "time step", "reduction")]
    fine = all(part is not None and (np.abs(part) <= answer.noise).all() for part in parts)
    return not fine or bool(unseen(answer.unknowns, answer.sensitivities, answer.directions))


def with_part(answer: Identified, part: Array) -> Identified:
    """The answer with what finite strain changes."""
    kinds = answer.kinds | {LINEAR: f"by a full run with the law {DEFAULT}"}
    return replace(answer, parts=answer.parts | {LINEAR: part}, kinds=kinds)


def refused(answer: Identified, part: Array, why: str) -> Identified:
    """The answer, refused where finite strain changes it by more than the noise and cannot be fitted."""
    i = int(np.argmax(np.abs(part) / answer.noise))
    reason = f"{_beyond(answer, part, i)}, and the fit at finite strain fails: {why}"
    return replace(answer, reasons=(*answer.reasons, reason))


def chosen(linear: Identified, strained: Identified, part: Array, failed: str = "") -> Identified:
    """The answer of the law that fits the data better, with the reason. In a tie linear, with both fits' difference.

    S is the sum of squares of a fit, D^2 = |y - y'|^2 / sigma^2 the distance of two fits. If the first law is true,
    S - S' is normal with mean -D^2 and deviation 2 D [C62]; it exceeds c^2 where a standard normal number exceeds
    (c^2 + D^2) / (2 D) >= c. So the law with the larger S is refuted by ``CHANCE`` deviations, whatever D is, where the
    sums differ by more than ``CHANCE``^2; where they do not, either may be true.

    ``failed``: why it has no reduced model at finite strain, but full runs and slopes of linear elasticity.
    """
    misfits = f"misfit {strained.residuals.misfit:.3g} sigma against {linear.residuals.misfit:.3g}"
    more = _squares(strained) - _squares(linear)
    runs = linear.runs + strained.runs
    if more > CHANCE**2:
        sentence = (
            f"Finite strain ({strained.law}) matters at these strains, and fits worse ({misfits}): the values are "
            "those of linear elasticity."
        )
        return replace(linear, warnings=(*linear.warnings, sentence), runs=runs)
    if more >= -(CHANCE**2):
        change = np.log(linear.values / strained.values)
        i = int(np.argmax(np.abs(change) / linear.noise))
        sentence = (
            f"Finite strain ({strained.law}) changes {linear.unknowns[i].name} by about {percent(abs(change[i]))}, and "
            f"the data do not decide between it and linear elasticity ({misfits}; the sums of squares differ by "
            f"{abs(more):.2g}, by chance up to {CHANCE**2:g}): the values are those of linear elasticity, and the "
            "change is a part of their errors."
        )
        kinds = linear.kinds | {LINEAR: f"difference to the fit with the law {strained.law}"}
        answer = replace(linear, parts=linear.parts | {LINEAR: change}, kinds=kinds)
        return replace(answer, warnings=(*linear.warnings, sentence), runs=runs)
    i = int(np.argmax(np.abs(part) / linear.noise))
    sentence = (
        f"{_beyond(linear, part, i)}: the values are those of finite strain with the law {strained.law} ({misfits}); "
        "another law has others."
    )
    if failed:
        sentence += (
            f" They come from full runs and slopes of linear elasticity, for no reduced model runs there: {failed}"
        )
    history = (*linear.history, *strained.history[1:])
    return replace(strained, warnings=(sentence, *strained.warnings), runs=runs, history=history)


def _beyond(answer: Identified, part: Array, i: int) -> str:
    return (
        f"Linear elasticity is beyond its range: it changes {answer.unknowns[i].name} by about "
        f"{percent(abs(part[i]))}, with a noise of {percent(answer.noise[i])}, and has a misfit of "
        f"{answer.residuals.misfit:.3g} sigma"
    )


def _squares(answer: Identified) -> float:
    """Sum of squares of the residuals [sigma], outliers cut."""
    tables = [(f - d.values) / answer.sigma for f, d in zip(answer.fitted, answer.data, strict=True)]
    return float(sum(np.minimum(t[np.isfinite(t)] ** 2, OUTLIER**2).sum() for t in tables))
