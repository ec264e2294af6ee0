"""The question of the closed loop: controller x time step against the error of the trajectory, its cost and time.

The reference has no time step: with y - y_bar = C exp(F t) e(0), F = A + B K on the modes of the tissue, the optimal
loop is known at every instant up to the modes left out, and halving their number shows how much they matter. Errors are
those of the outputs against the hand, y - C_s q_s, over the largest such output on the way; beside them stand those of
y itself, over the way to go, in which the motion of the hand hides the tissue.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from mpi4py import MPI

from softgrasp.fem.columns import Columns, farthest
from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, on_root
from softgrasp.lqr.design.orders import fast_order, orders
from softgrasp.lqr.design.scene import control_of
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.loop.cost import predicted_cost
from softgrasp.lqr.loop.full import ClosedLoop, LoopTrajectory
from softgrasp.lqr.loop.small import ReducedLoop, ReducedLoopTrajectory, galerkin
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.reduced.bases import A_PRIORI
from softgrasp.lqr.spectrum.modal_loop import ModalLoop
from softgrasp.study.control.result import TITLES
from softgrasp.study.precision.fit import Slope, series_of, slope
from softgrasp.study.precision.points import LoopPoint
from softgrasp.study.precision.result import LoopReference, Question
from softgrasp.study.precision.riccati import ControlRuns
from softgrasp.study.precision.settings import LEAST_STEPS

SHARES = (16.0, 8.0, 4.0, 2.0, 1.0, 0.5, 0.25)  # of the scene's steps
LOOP_WORK = {2: 5e6, 3: 2e6}  # unknowns times steps of one run of the full plant
BURST_SECONDS = 0.02  # of the steps in each repeat after the first, which is the whole run
PAPER_BASIS, PAPER_N = "pod", 8  # of the paper's controller
CONTROLLERS = 7  # about so many
FINEST = 2  # numbers of steps behind an order in time: longer steps do not resolve what the start excites
GONE = 10.0  # times the way to go: a run that is farther from the reference is lost


@dataclass(frozen=True)
class Feedback:
    """A gain: optimal, or of a reduced equation."""

    basis: str = ""  # key of softgrasp.lqr.reduced.bases.BASES; empty for the optimal gain
    N: int = 0  # order of the reduced equation

    @property
    def label(self) -> str:
        """In words."""
        if not self.basis:
            return "optimal gain"
        return f"a priori N = {self.N}" if self.basis == A_PRIORI else f"{TITLES[self.basis]}, N = {self.N}"


@dataclass(frozen=True)
class LoopSetting:
    """What closes the loop."""

    gain: Feedback  # which
    held: bool = False  # sampled at the start of every step and held, else inside the midpoint rule
    reduced: bool = False  # on the reduced plant that the gain was made for, else on the full one

    @property
    def label(self) -> str:
        """In words; also the key of its line."""
        law = "held" if self.held else "midpoint"
        return f"{self.gain.label}, {law}" + (", reduced plant" if self.reduced else "")


def nested_counts(shares: Sequence[float], steps: int, n_e: int, most: float) -> list[int]:
    """Whole multiples and parts of the scene's steps that nest, most first, as the shares are.

    Only the scene's own and fewer steps may have more unknowns n_e times steps than ``most``.
    """
    whole = [round(steps * s) for s in shares if float(steps * s).is_integer()]
    return [n for n in whole if n >= LEAST_STEPS and (n <= steps or n * n_e <= most)]


class LoopSweep:
    """Closed loops of one scene; gains and reference are made when the first point is not in the cache. Collective.

    Limits and delay of the scene's loop are left out: the law is linear.
    """

    def __init__(self, runs: ControlRuns) -> None:
        self.runs, self.layout = runs, runs.layout
        self.scene, self.cache = runs.scene, runs.cache
        self.counts = nested_counts(SHARES, self.scene.time.steps, self.layout.n_e, LOOP_WORK[self.layout.dimension])
        self._finest = cache(self._exact)

    def gain(self, what: Feedback) -> Gain:
        """The optimal gain, or a reduced one. Raises ControlError: its equation has no solution."""
        if not what.basis:
            return self.runs.design.gain
        report = self.runs.report(what.basis, what.N)
        if report.gain is None:
            raise ControlError(report.reason)
        return report.gain

    def _exact(self, what: Feedback, modal: ModalLoop | None = None) -> Array:
        """Outputs less y_bar without the part C_s of the hand, and with it, at the instants of most steps, (m, 2 p)."""
        modal, steps = modal or self.runs.design.gain_check.loop, self.counts[0]
        C, dt = modal.plant.space.C, self.scene.time_end / steps
        tissue = np.arange(C.shape[1]) >= self.layout.n_s
        return modal.exact(self.gain(what).block, self.runs.design.error, np.vstack([C * tissue, C]), dt, steps)

    # --- reference

    def exact(self, what: Feedback, steps: int) -> Array:
        """:meth:`_exact` of a gain at the instants of a coarser grid, (steps + 1, 2 p)."""
        return self._finest(what)[:: self.counts[0] // steps]

    @cached_property
    def reference(self) -> LoopReference:
        """Error estimate of the reference, cost and what is to come at the end, from the cache when they are there.

        Raises:
            ControlError: no output moves against the hand.
        """
        if not self.layout.comm.allreduce(bool(np.any(self.runs.problem.C_z)), MPI.LOR):
            raise ControlError("no output moves against the hand, so that there is no deformation whose error counts")

        def measure() -> list[LoopReference]:
            design, most, best = self.runs.design, self.counts[0], Feedback()
            true, loop, columns = self.exact(best, most), design.gain_check.loop, design.problem.columns
            modes, error = len(loop.plant.omega), 0.0
            if not loop.complete:
                error = relative_errors(self._exact(best, ModalLoop(design.problem, modes // 2)), true, columns)[0]
            run = self._full(LoopSetting(best), most)[0]
            rest = predicted_cost(design.problem, design.solution, run.final - design.target.state)
            return [LoopReference(error, modes, loop.complete, design.gain_check.optimal, rest)]

        return self.cache.point("closed loop, reference", "loop", {"reference": self.counts}, LoopReference, measure)[0]

    # --- controllers

    def gains(self) -> list[Feedback]:
        """Reduced gains: a priori with the hand alone, with a little and with more tissue; the paper's. Cached."""

        def measure() -> list[Feedback]:
            sizes = orders(self.runs.design)[0]
            fast = [N for N in self.runs.family(A_PRIORI).orders(sizes) if fast_order(self.layout.n_s) >= N]
            try:
                paper = self.runs.family(PAPER_BASIS).orders(sizes)
            except ControlError:
                paper = []
            nearest = sorted(paper, key=lambda N: abs(N - PAPER_N))[:1]
            own = [Feedback(A_PRIORI, N) for N in dict.fromkeys([*fast[:2], *fast[-1:]])]
            return own + [Feedback(PAPER_BASIS, N) for N in nearest]

        return self.cache.get("loop", {"gains": control_of(self.runs.model).N}, Feedback, measure)

    def controllers(self) -> list[LoopSetting]:
        """The optimal and the reduced gains on the full plant; a-priori gains with tissue on their own plant."""
        gains = self.gains()
        tissue = [g for g in gains if g.basis == A_PRIORI and self.layout.n_s < g.N / 2]
        settings = [LoopSetting(g) for g in (Feedback(), *gains)]
        settings += [LoopSetting(g, held=True) for g in (Feedback(), *tissue[:1])]
        settings += [LoopSetting(g, reduced=True) for g in tissue]
        return settings + [LoopSetting(g, held=True, reduced=True) for g in tissue[:1]]

    # --- runs

    def _law(self, held: bool, steps: int) -> Actuation:
        return Actuation(steps / self.scene.time_end) if held else Actuation()

    def _full(self, what: LoopSetting, steps: int) -> tuple[LoopTrajectory, list[float]]:
        """One run of the full plant and the mean seconds of its steps, by repeats."""
        design, comm, gain = self.runs.design, self.layout.comm, self.gain(what.gain)
        loop = ClosedLoop(self.runs.problem, self.scene.time_end / steps, self.scene.time.solver, self.scene.time.rtol)
        try:
            law = self._law(what.held, steps)
            first = loop.run(gain, design.target, steps, law, design.start)
            means = [first.seconds["steps"] / steps]
            burst = int(np.clip(comm.bcast(BURST_SECONDS / max(means[0], 1e-9)), 2, steps))
            for _ in range(self.runs.repeats - 1):
                again = loop.run(gain, design.target, burst, law, design.start)
                means.append(again.seconds["steps"] / burst)
        finally:
            loop.destroy()
        return first, means

    def _reduced(self, what: LoopSetting, steps: int) -> tuple[ReducedLoopTrajectory, list[float]]:
        """Runs of the reduced plant of an a-priori gain on rank 0."""
        design, problem, n_s = self.runs.design, self.runs.problem, self.layout.n_s
        plant, shapes = galerkin(problem, self.runs.family(what.gain.basis).at(what.gain.N).modes)
        K = shapes.reduce_gain(problem, self.gain(what.gain))
        start = plant.rest_at(np.zeros(n_s))[0]
        if self.scene.time.start != "equilibrium":
            start[2 * n_s :] = 0.0
        rest, law = plant.rest_at(design.target.state.q_s), self._law(what.held, steps)

        def run() -> tuple[ReducedLoopTrajectory, list[float]]:
            loop = ReducedLoop(plant, self.scene.time_end / steps)
            runs = [loop.run(K, rest, steps, (problem.Q, problem.R), law, start) for _ in range(self.runs.repeats)]
            return runs[0], [r.seconds["steps"] / steps for r in runs]

        return on_root(self.layout.comm, run)

    def points(self, what: LoopSetting) -> list[LoopPoint]:
        """All steps of one controller; not ok unless its gain is certified to stabilise the full plant."""

        def measure() -> list[LoopPoint]:
            stable = not what.gain.basis or self.runs.report(what.gain.basis, what.gain.N).stable
            return [self._point(what, steps, stable) for steps in self.counts]

        key = {"controller": what.label, "counts": self.counts, "repeats": self.runs.repeats}
        return self.cache.point(f"closed loop, {what.label}", "loop", key, LoopPoint, measure)

    def _point(self, what: LoopSetting, steps: int, stable: bool) -> LoopPoint:
        """Errors, cost and seconds of one controller and step."""
        reference, infinite = self.reference, float("inf")
        lost = LoopPoint(
            what.label, f"{what.label}, {steps} steps", infinite, infinite, False, steps=steps,
            dt=self.scene.time_end / steps, basis=what.gain.basis, N=what.gain.N, held=what.held,
            reduced_plant=what.reduced,
            per_step=infinite, error_displacement=infinite, error_time=infinite, cost_error=infinite,
        )  # fmt: skip
        run: LoopTrajectory | ReducedLoopTrajectory
        try:
            run, means = self._reduced(what, steps) if what.reduced else self._full(what, steps)
        except (SolverError, ControlError) as failed:
            return replace(lost, reason=str(failed))
        problem, target = self.runs.problem, self.runs.design.target
        columns, y = problem.columns, run.outputs - target.y
        both = np.hstack([y - (run.q_s - target.state.q_s) @ problem.C_s.T, y])
        error, displacement = relative_errors(both, self.exact(Feedback(), steps), columns)
        if not displacement <= GONE:
            return replace(lost, reason="far from the reference")
        per_step, cost = statistics.median(means), float(run.cost[-1])
        setup = run.seconds["prepare" if what.reduced else "factor"]
        due = reference.optimal - reference.to_come
        return replace(
            lost, seconds=setup + steps * per_step, error=error, ok=stable, per_step=per_step, setup=setup,
            error_displacement=displacement, error_time=relative_errors(both, self.exact(what.gain, steps), columns)[0],
            cost=cost, cost_error=abs(cost - due) / reference.optimal,
        )  # fmt: skip


def relative_errors(values: Array, true: Array, columns: Columns) -> tuple[float, float]:
    """Largest error of any output at any instant over the largest value, of each half of the columns (m, 2 p)."""
    still = np.zeros(true.shape[1] // 2)
    gaps, sizes = ([farthest(half, still, columns).max() for half in np.hsplit(v, 2)] for v in (values - true, true))
    return float(gaps[0] / sizes[0]), float(gaps[1] / sizes[1])


def ask_loop(runs: ControlRuns) -> Question:
    """All controllers at all steps. Collective.

    A loop that is lost, or whose gain is not certified, stays as a point that is not ok.

    Raises:
        SolverError: the optimal loop cannot be made.
        ControlError: no output moves against the hand.
    """
    loops = LoopSweep(runs)
    reference = loops.reference
    points = [p for what in loops.controllers() for p in loops.points(what)]
    return Question(tuple(points), tuple(loop_slopes(points)), reference)


def loop_slopes(points: Sequence[LoopPoint]) -> list[Slope]:
    """Order in time of every controller on the full plant, against the same gain without time step."""
    slopes: list[Slope] = []
    for line in series_of([p for p in points if p.ok and not p.reduced_plant]).values():
        last = sorted(line, key=lambda p: -p.steps)[:FINEST]
        slopes += slope(last, "error in time against steps", "steps", "error_time")
    return slopes
