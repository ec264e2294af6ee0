"""From a scene to its optimal gain: diagnosis, the solver by size, and a check of the closed loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.model.build import Model, Stopwatch, checked_model
from softgrasp.fem.shown import Card, Shown, amount, listed
from softgrasp.lqr.design.scene import actuation, control_of, problem, sampling, scene_target
from softgrasp.lqr.diagnosis import Diagnosis, diagnose
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.gain import Gain, PlantState
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.plant.target import Target, hand_target, rest
from softgrasp.lqr.reduced.riccati import GainCheck
from softgrasp.lqr.riccati import Spelling, choose, modal_lqr, solve
from softgrasp.lqr.spectrum.modal_loop import LoopQuality
from softgrasp.lqr.spectrum.sampled import Sampling

Progress = Callable[[dict[str, float]], None]
MODAL_MODES = 10  # that method = "modal" controls at most
MODAL_CANDIDATES = 40  # lowest modes of which it chooses them
ROUNDING = 1e-8  # of an eigenvalue on the unit circle


@dataclass(frozen=True, repr=False)
class Design(Shown):
    """The optimal feedback of a scene."""

    model: Model
    """The built scene."""
    problem: RiccatiProblem
    """Plant, outputs and weights."""
    solution: RiccatiSolution
    """Factor of the Riccati solution, and the optimal gain."""
    target: Target
    """State, input and outputs at which the loop comes to rest."""
    start: PlantState
    """State at t = 0."""
    error: Block
    """Start minus target, hand (2 n_s, 1), local rows (2 n_local, 1)."""
    diagnosis: Diagnosis
    """Warnings and estimated poles from before the solve."""
    gain_check: GainCheck
    """Comparison of any gain with the optimal one on the full plant."""
    modal: bool
    """Whether the gain controls the lowest modes only."""

    def card(self) -> Card:
        """Plant, solver and the closed loop of the full plant."""
        solution = self.solution
        rows = (
            ("plant", f"{self.model.states} states, outputs {listed(self.problem.names)}"),
            ("solver", f"{solution.method}, rank {solution.rank}"),
            ("residual", amount(solution.residual)),
            ("abscissa", amount(self.quality.abscissa, "1/s")),
            ("warnings", str(len(self.diagnosis.findings))),
        )
        return Card(f"Design {self.model.scene.name}", rows)

    @property
    def quality(self) -> LoopQuality:
        """Closed loop of the full plant under the optimal gain. Collective at the first request."""
        return self.gain_check.best

    @property
    def gain(self) -> Gain:
        """The optimal gain."""
        return self.solution.gain

    @property
    def actuation(self) -> Actuation:
        """Sampling, delay and limits of the scene's loop."""
        return actuation(self.model)

    @property
    def largest_radius(self) -> float:
        """Bound on the radius of a controller; modal feedback leaves undamped modes on the circle."""
        return 1 + ROUNDING if self.modal else 1.0


def check(model: Model) -> tuple[RiccatiProblem, Diagnosis, bool]:
    """The problem and what is known before the solve; whether only some modes are to be controlled. Collective.

    Raises SoftgraspError: the scene has no solution, in one sentence.
    """
    scene_target(model)
    actuation(model)
    plant = problem(model)
    diagnosis = diagnose(plant)
    modal = control_of(model).method == "modal"
    diagnosis.require(but=("damping",) if modal else ())
    return plant, diagnosis, modal


def design(
    model: Model,
    watch: Stopwatch | None = None,
    progress: Progress | None = None,
    checkpoint: Path | None = None,
    *,
    judged: bool = True,
) -> Design:
    """Optimal feedback u = u_bar + K (x - x_bar), K = -R^-1 B'XE, of a scene, checked on the full plant. Collective.

    Args:
        watch: records the seconds of "diagnosis", "are" and "judge".
        progress: called after every step of the solver with its history entry.
        checkpoint: folder for the solver's restart files.
        judged: check the closed loop; a caller that does so with other gains calls :func:`judge` itself.

    Raises:
        SceneError: the scene names no target, or Q or R has the wrong size.
        ControlError: no gain exists, in one sentence.
        SolverError: not converged, or a gain that does not stabilise the full plant at the scene's own step, rate and
            delay.

    >>> import softgrasp as sg
    >>> sg.design(sg.build("paper_lqr", ["tissue.cells=[2, 4]"])).quality.stable
    True
    """
    watch = watch or Stopwatch(checked_model(model).system.layout.comm)
    with watch.stage("diagnosis"):
        plant, diagnosis, modal = check(model)
        target = hand_target(plant, scene_target(model))
        start = rest(plant.system, deformed=model.scene.time.start == "equilibrium")
    with watch.stage("are"):
        solution = _modal(plant, diagnosis) if modal else _solve(model, plant, progress, checkpoint)
    with watch.stage("judge"):
        error = (start - target.state).block
        gain_check = GainCheck(plant, solution, error, law=sampling(model))
    result = Design(model, plant, solution, target, start, error, diagnosis, gain_check, modal)
    if judged:
        with watch.stage("judge"):
            judge(result)
    return result


def judge(design: Design) -> None:
    """Refuse a gain that does not stabilise the full plant at the scene's own step, rate and delay. Collective.

    Raises SolverError: it does not.
    """
    quality = design.quality
    if quality.certified and not quality.abscissa < 0 and not design.modal:
        raise SolverError(
            f"the gain leaves the closed loop with the spectral abscissa {quality.abscissa:.1e}/s, which must be "
            "negative; add damping, or try another control.method"
        )
    _require_sampled(design)


def _modal(plant: RiccatiProblem, diagnosis: Diagnosis) -> RiccatiSolution:
    """As many of the lowest modes as feedback can stabilise, at most :data:`MODAL_MODES`."""
    rates = diagnosis.rates
    good = MODAL_MODES if rates is None else int((rates.lost[:MODAL_CANDIDATES] == 0).sum())
    return modal_lqr(plant, min(MODAL_MODES, good), MODAL_CANDIDATES)


def _solve(model: Model, plant: RiccatiProblem, progress: Progress | None, checkpoint: Path | None) -> RiccatiSolution:
    control = control_of(model)
    method = cast(Spelling, control.method)
    tol = None
    # galerkin measures the change of its gain, not the residual
    if "tolerance" in control.model_fields_set and choose(plant, method).method != "galerkin":
        tol = control.tolerance
    return solve(plant, method, tol, progress, checkpoint)


def loop_words(law: Sampling) -> str:
    """Rate and delay of a held loop."""
    late = {0: "", 1: " and one tick late"}.get(law.delay, f" and {law.delay} ticks late")
    return f"sampled at {1 / (law.dt * law.every):.6g} Hz{late}"


def running_words(design: Design) -> str:
    """Which loop runs: its law, rate, delay and limits, behind "the loop"."""
    law = design.gain_check.law
    held = law is not None and law.every
    words = f"{loop_words(law)}, and held" if held and law is not None else "with the continuous law"
    bound = design.actuation.bound(design.problem.layout.n_s)
    if bound is None:
        return words
    limits = ", ".join("none" if np.isinf(x) else f"{x:.4g}" for x in bound)
    return f"{words}, the loads limited to {limits}"


def _require_sampled(design: Design) -> None:
    """Refuse a held loop that is unstable, with a rate that is not. Collective."""
    gain_check, radius, time = design.gain_check, design.quality.sampled, design.model.scene.time
    law, largest = gain_check.law, design.largest_radius
    if law is None or not law.every or radius is None or radius.value < largest:
        return
    good = gain_check.ticks.stable_rate(gain_check.K, law, design.model.scene.time_end, largest)
    advice = "no rate makes it stable"
    if good is not None:
        steps = "" if good.steps == time.steps else f" with time.steps = {good.steps}"
        advice = (
            f"it begins to be stable at control.loop.rate = {good.rate:.9g}{steps} (radius {good.radius:.6g}), so set "
            "a higher one"
        )
    raise SolverError(
        f"the loop {loop_words(law)} is unstable: its spectral radius from tick to tick is {radius.value:.4g}, which "
        f"must be below 1; {advice}, or lower control.Q for a slower move"
    )
