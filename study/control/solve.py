"""From a scene to its optimal gain: target and start, diagnosis, the solver by size, what the gain is worth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from softgrasp.fem.errors import SceneError, SolverError
from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import motion_table
from softgrasp.lqr.design import make_problem
from softgrasp.lqr.diagnosis import Diagnosis, diagnose
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.modal_feedback import modal_lqr
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.coordinates import gain_of
from softgrasp.lqr.plant.gain import PlantState
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.plant.target import Target, hand_target, rest
from softgrasp.lqr.reduced.riccati import GainJudge
from softgrasp.lqr.riccati import Method, choose, solve
from softgrasp.lqr.spectrum.modal_loop import DENSE_LIMIT, SOME_MODES, LoopQuality, ModalLoop, SampledRadius
from softgrasp.lqr.spectrum.sampled import Sampling

Progress = Callable[[dict[str, float]], None]
NAMES: dict[str, Method] = {
    "auto": "auto",
    "newton-adi": "newton_adi",
    "radi": "radi",
    "galerkin": "galerkin",
    "dense": "dense",
}
MODAL_MODES, MODAL_CANDIDATES = 10, 40
ROUNDING = 1e-8  # of an eigenvalue on the unit circle
WHOLE_SPECTRUM = 500  # n_e up to which the Schur form of all modes, about a second, may judge every gain


@dataclass(frozen=True)
class Design:
    """The optimal feedback of a scene.

    Attributes:
        problem: plant, outputs and weights.
        solution: Riccati solution and gain.
        target, start: where the loop goes and where it begins.
        error: start minus target, one column.
        diagnosis: what was known before the solve.
        judge: compares gains with the optimal one.
        quality: closed loop of the full plant under the optimal gain.
        modal: the gain controls some modes only.
    """

    problem: RiccatiProblem
    solution: RiccatiSolution
    target: Target
    start: PlantState
    error: Block
    diagnosis: Diagnosis
    judge: GainJudge
    quality: LoopQuality
    modal: bool


def scene_words(sentence: str) -> str:
    """A solver's advice in the keys of a scene."""
    return sentence.replace("the method modal_lqr, which", "control.method = 'modal', which").replace(
        "the method modal_lqr", "control.method = 'modal'"
    )


def scene_target(model: Model) -> Array:
    """Where the closed loop takes the hand: motion.target, or the end of the table. Not collective.

    Raises:
        SceneError: the scene names no target, or it is the start.
    """
    scene, n_s = model.scene, model.system.layout.n_s
    target = scene.motion.target
    if target is None and scene.motion.profile == "csv" and scene.motion.drive == "motion":
        target = motion_table(scene, n_s).q[-1].tolist()
    if target is None:
        raise SceneError("motion.target is missing; `softgrasp control` moves the hand there, so give its displacement")
    if not np.any(target):
        raise SceneError(f"motion.target is {target}, where the hand starts; give another place to go to")
    return np.asarray(target, dtype=np.float64)


def actuation(model: Model) -> Actuation:
    """How the feedback of the scene reaches the hand; checked against the time step. Not collective.

    Raises:
        ControlError: rate, delay or limit do not fit.
    """
    scene = model.scene
    if scene.control is None:
        return Actuation()
    loop, layout = scene.control.loop, model.system.layout
    turns = layout.n_s - layout.dimension
    if loop.limit_torque is not None and turns == 0:
        raise ControlError(
            "control.loop.limit_torque limits a hand that does not turn; set effects.rotation = true, or leave it out"
        )
    limits = None
    if loop.limit is not None or loop.limit_torque is not None:
        limits = (loop.limit or np.inf,) * layout.dimension + (loop.limit_torque or np.inf,) * turns
    law = Actuation(loop.rate if loop.sampling == "held" else None, loop.delay, limits)
    law.ticks(scene.time_end / scene.time.steps)
    return law


def sampling(model: Model) -> Sampling:
    """The instants of the scene's loop. Not collective.

    Raises:
        ControlError: the tick is no multiple of the time step.
    """
    return Sampling.of(actuation(model), model.scene.time_end / model.scene.time.steps)


def difference(start: PlantState, target: PlantState) -> Block:
    """Start minus target as one column. Not collective."""
    e = start - target
    return Block(np.concatenate([e.q_s, e.v_s])[:, None], np.concatenate([e.z, e.v_z])[:, None])


def check(model: Model) -> tuple[RiccatiProblem, Diagnosis, bool]:
    """The problem and what is known before the solve; whether only some modes are to be controlled. Collective.

    Raises:
        SoftgraspError: the scene has no solution, in one sentence.
    """
    scene_target(model)
    actuation(model)
    problem = make_problem(model)
    diagnosis = diagnose(problem)
    modal = model.scene.control is not None and model.scene.control.method == "modal"
    for finding in diagnosis.findings:
        if finding.kind == "error" and not (modal and finding.topic == "damping"):
            raise ControlError(scene_words(finding.sentence))
    return problem, diagnosis, modal


def design(model: Model, watch: Stopwatch, progress: Progress | None = None, checkpoint: Path | None = None) -> Design:
    """Solve the Riccati equation of a scene and judge the gain. Collective.

    Args:
        model: the built scene.
        watch: takes the seconds of "diagnosis", "are" and "judge".
        progress: called after every step of the solver with its history entry.
        checkpoint: folder for the solver's restart files.

    Raises:
        SoftgraspError: no solution, not converged, or a gain that does not stabilise the full plant at the scene's own
            step, rate and delay.
    """
    with watch.stage("diagnosis"):
        problem, diagnosis, modal = check(model)
        target = hand_target(problem, scene_target(model))
        start = rest(problem.system, deformed=model.scene.time.start == "equilibrium")
    with watch.stage("are"):
        solution = _modal(problem, diagnosis) if modal else _solve(model, problem, progress, checkpoint)
    with watch.stage("judge"):
        error = difference(start, target.state)
        judge, quality = _judge(problem, solution, error, sampling(model))
    if quality.certified and not quality.abscissa < 0 and not modal:
        raise SolverError(
            f"the gain leaves the closed loop with the spectral abscissa {quality.abscissa:.1e}/s, which must be "
            "negative; add damping, or try another control.method"
        )
    with watch.stage("judge"):
        _require_sampled(model, judge, gain_of(solution), quality.sampled, modal)
    return Design(problem, solution, target, start, error, diagnosis, judge, quality, modal)


def _modal(problem: RiccatiProblem, diagnosis: Diagnosis) -> RiccatiSolution:
    """As many of the lowest modes as feedback can stabilise, at most :data:`MODAL_MODES`."""
    rates = diagnosis.rates
    good = MODAL_MODES if rates is None else int((rates.lost[:MODAL_CANDIDATES] == 0).sum())
    return modal_lqr(problem, min(MODAL_MODES, good), MODAL_CANDIDATES)


def _solve(
    model: Model, problem: RiccatiProblem, progress: Progress | None, checkpoint: Path | None
) -> RiccatiSolution:
    control = model.scene.control
    wanted = NAMES["auto" if control is None else control.method]
    tol = None
    # galerkin measures the change of its gain, not the residual
    if control is not None and "tolerance" in control.model_fields_set and choose(problem, wanted).method != "galerkin":
        tol = control.tolerance
    try:
        return solve(problem, wanted, tol, progress, checkpoint)
    except (ControlError, SolverError) as error:
        raise type(error)(scene_words(str(error))) from error


def every_mode(problem: RiccatiProblem) -> ModalLoop:
    """The closed loop of a small scene with its whole spectrum. Collective."""
    return ModalLoop(problem, problem.layout.n_e)


def _judge(
    problem: RiccatiProblem, solution: RiccatiSolution, error: Block, law: Sampling
) -> tuple[GainJudge, LoopQuality]:
    """The lowest modes and shift-and-invert; all modes where that does not converge, as far as they fit."""
    judge = GainJudge(problem, solution, error, ModalLoop(problem, min(SOME_MODES, problem.layout.n_e)), law)
    try:
        return judge, worth(judge, gain_of(solution), DENSE_LIMIT)
    except SolverError:
        if problem.layout.n_e > DENSE_LIMIT:
            raise
    judge = GainJudge(problem, solution, error, every_mode(problem), law)
    return judge, judge.quality(gain_of(solution))


def loop_words(law: Sampling) -> str:
    """Rate and delay of a held loop. Not collective."""
    return f"sampled at {1 / (law.dt * law.every):.6g} Hz" + (" and one tick late" if law.delay else "")


def largest_radius(modal: bool) -> float:
    """Below it a controller is written; modal feedback leaves undamped modes on the circle. Not collective."""
    return 1 + ROUNDING if modal else 1.0


def _require_sampled(model: Model, judge: GainJudge, gain: Block, radius: SampledRadius | None, modal: bool) -> None:
    """Refuse a held loop that is unstable, with a rate that is not. Collective."""
    law, most = judge.law, largest_radius(modal)
    if law is None or not law.every or radius is None or radius.value < most:
        return
    good = judge.ticks.stable_rate(gain, law, model.scene.time_end, most)
    advice = "no rate makes it stable"
    if good is not None:
        steps = "" if good.steps == model.scene.time.steps else f" with time.steps = {good.steps}"
        advice = (
            f"it begins to be stable at control.loop.rate = {good.rate:.9g}{steps} (radius {good.radius:.6g}), so take "
            "a higher one"
        )
    raise SolverError(
        f"the loop {loop_words(law)} is unstable: its spectral radius from tick to tick is {radius.value:.4g}, which "
        f"must be below 1; {advice}, or lower control.Q for a slower move"
    )


def worth(judge: GainJudge, gain: Block, whole: int = WHOLE_SPECTRUM) -> LoopQuality:
    """Abscissa, cost, radius; all modes of a small scene where shift-and-invert gives no certificate. Collective.

    Args:
        judge: with the lowest modes.
        gain: transposed, hand-relative.
        whole: n_e up to which all modes may be taken.
    """
    found = judge.quality(gain)
    if found.certified or judge.problem.layout.n_e > whole:
        return found
    return judge.by_all_modes(gain)
