"""The question of the closed loop: controller x time step against the error of the trajectory, its cost and time.

The reference has no time step: with y - y_bar = C exp(F t) e(0), F = A + B K on the modes of the tissue, the optimal
loop is known at every instant up to the modes left out, and halving their number shows what those are worth. Errors are
those of the outputs against the hand, y - C_s q_s, over the largest such output on the way; beside them stand those of
y itself, over the way to go, in which the motion of the hand hides the tissue.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.columns import Columns, farthest
from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, on_root
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.loop.cost import predicted_cost
from softgrasp.lqr.loop.full import ClosedLoop, LoopTrajectory
from softgrasp.lqr.loop.small import ReducedLoop, ReducedTrajectory
from softgrasp.lqr.loop.small_plant import SmallPlant, project
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.coordinates import factor_of
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.reduced.bases import BasisFamily, make_family
from softgrasp.lqr.reduced.riccati import reduce_riccati
from softgrasp.lqr.spectrum.modal_loop import ModalLoop
from softgrasp.study.control.sweep import TITLES, fast_order, judged, orders
from softgrasp.study.precision.fit import Slope, power_law
from softgrasp.study.precision.points import LEAST_STEPS, Row, WorkPoint, number
from softgrasp.study.precision.riccati import SECOND, ControlRuns
from softgrasp.study.precision.riccati_reduced import A_PRIORI

SHARES = (16.0, 8.0, 4.0, 2.0, 1.0, 0.5, 0.25)  # of the scene's steps
LOOP_WORK = {2: 5e6, 3: 2e6}  # unknowns times steps of one run of the full plant
BURST_SECONDS = 0.02  # of the steps in each repeat after the first, which is the whole run
PAPER_BASIS, PAPER_N = "pod", 8  # of the paper's controller
CONTROLLERS = 7  # about so many on the full plant
FINEST = 2  # numbers of steps behind an order in time: longer steps do not resolve what the start excites
GONE = 10.0  # times the way to go: a run that is farther from the reference is lost


@dataclass(frozen=True)
class Feedback:
    """A gain: optimal, or of a reduced equation.

    Attributes:
        basis: key of :data:`lqr.reduced.bases.BASES`; empty for the optimal gain.
        N: order of the reduced equation.
    """

    basis: str = ""
    N: int = 0

    @property
    def label(self) -> str:
        """In words."""
        if not self.basis:
            return "optimal gain"
        return (
            f"a priori N = {self.N}"
            if self.basis == A_PRIORI
            else f"{TITLES.get(self.basis, self.basis)}, N = {self.N}"
        )


@dataclass(frozen=True)
class Controller:
    """What closes the loop.

    Attributes:
        gain: which.
        held: sampled at the start of every step and held, else inside the midpoint rule.
        reduced: on the reduced plant that the gain was made for, else on the full one.
    """

    gain: Feedback
    held: bool = False
    reduced: bool = False

    @property
    def label(self) -> str:
        """In words; also the key of its line."""
        law = "held" if self.held else "midpoint"
        return f"{self.gain.label}, {law}" + (", reduced plant" if self.reduced else "")


def step_counts(shares: Sequence[float], steps: int, n_e: int = 1, most: float = np.inf) -> list[int]:
    """Whole multiples and parts of the scene's steps that nest, most first. Not collective.

    Args:
        shares: multiples and parts, most first.
        steps: of the scene.
        n_e: unknowns.
        most: unknowns times steps that a run may have; the scene's own and fewer steps always may.
    """
    found = [round(steps * s) for s in shares if float(steps * s).is_integer()]
    return [n for n in found if n >= LEAST_STEPS and (n <= steps or n * n_e <= most)]


class LoopRuns:
    """Closed loops of one scene; gains and reference are made when the first point is not in the cache. Collective.

    Limits and delay of the scene's loop are left out: the law is linear.

    Args:
        runs: the control problem.
    """

    def __init__(self, runs: ControlRuns) -> None:
        self.runs, self.layout = runs, runs.layout
        self.scene, self.cache = runs.scene, runs.cache
        self.counts = step_counts(SHARES, self.scene.time.steps, self.layout.n_e, LOOP_WORK[self.layout.dimension])
        self._exact: dict[Feedback, Array] = {}
        self._families: dict[str, BasisFamily] = {}
        self._gains: dict[Feedback, Gain] = {}
        self._ending: Row = {}

    def gain(self, what: Feedback) -> Gain:
        """The gain as blocks."""
        if what not in self._gains:
            design, n = self.runs.design, self.layout.n_local
            if not what.basis:
                self._gains[what] = Gain.of(design.solution)
            else:
                K = reduce_riccati(self.runs.problem, self.family(what.basis).at(what.N)).gain
                self._gains[what] = Gain(np.ascontiguousarray(K.hand.T), K.tall[:n], K.tall[n:])
        return self._gains[what]

    def family(self, name: str) -> BasisFamily:
        """Bases of one method."""
        if name not in self._families:
            self._families[name] = make_family(name, self.runs.problem, factor_of(self.runs.design.solution))
        return self._families[name]

    # --- reference

    def exact(self, what: Feedback, steps: int) -> Array:
        """:func:`exact_outputs` of a gain at the instants of a grid, (steps + 1, 2 p)."""
        most = self.counts[0]
        if what not in self._exact:
            self._exact[what] = exact_outputs(self.runs, self.runs.design.judge.loop, self.gain(what), most)
        return self._exact[what][:: most // steps]

    def reference_row(self) -> Row:
        """Error estimate of the reference, cost and what is to come at the end, from the cache when they are there.

        Keys: error, modes, complete, optimal, to_come.

        Raises:
            ControlError: no output moves against the hand.
        """
        if not self.layout.comm.allreduce(bool(np.any(self.runs.problem.C_z)), MPI.LOR):
            raise ControlError("no output moves against the hand, so that there is no deformation whose error counts")

        def measure() -> Row:
            design, most, best = self.runs.design, self.counts[0], Feedback()
            true, loop, columns = self.exact(best, most), design.judge.loop, design.problem.columns
            modes, error = len(loop.plant.omega), 0.0
            if not loop.complete:
                coarse = exact_outputs(self.runs, ModalLoop(design.problem, modes // 2), self.gain(best), most)
                error = errors_of(coarse, true, columns)[0]
            run = self._full(Controller(best), most)[0]
            rest = predicted_cost(design.problem, design.solution, run.final - design.target.state)
            return {"error": error, "modes": modes, "complete": loop.complete, "optimal": design.judge.optimal,
                    "to_come": rest}  # fmt: skip

        if not self._ending:
            self.runs.guard.next("closed loop, reference", self.runs.work + SECOND)
            self._ending = self.cache.get("loop", {"reference": self.counts}, measure)
        return self._ending

    # --- controllers

    def gains(self) -> list[Feedback]:
        """Reduced gains: a priori with the hand alone, with a little and with more tissue; the paper's. Cached."""

        def measure() -> Row:
            wanted = orders(self.runs.model, self.runs.design)[0]
            there = self.family(A_PRIORI).orders(wanted)
            small = [N for N in there if fast_order(self.layout.n_s) >= N]
            rows = [[A_PRIORI, N] for N in dict.fromkeys([*small[:2], *small[-1:]])]
            try:
                paper = self.family(PAPER_BASIS).orders(wanted)
            except ControlError:
                paper = []
            rows += [[PAPER_BASIS, N] for N in sorted(paper, key=lambda N: abs(N - PAPER_N))[:1]]
            return {"gains": rows}

        key = {"gains": list(self.scene.control.N) if self.scene.control else []}
        return [Feedback(name, N) for name, N in self.cache.get("loop", key, measure)["gains"]]

    def controllers(self) -> list[Controller]:
        """The optimal and the reduced gains on the full plant; a-priori gains with tissue on their own plant."""
        gains = self.gains()
        small = [g for g in gains if g.basis == A_PRIORI and self.layout.n_s < g.N / 2]
        found = [Controller(g) for g in (Feedback(), *gains)]
        found += [Controller(g, held=True) for g in (Feedback(), *small[:1])]
        found += [Controller(g, reduced=True) for g in small]
        return found + [Controller(g, held=True, reduced=True) for g in small[:1]]

    # --- runs

    def _law(self, held: bool, steps: int) -> Actuation:
        return Actuation(steps / self.scene.time_end) if held else Actuation()

    def _full(self, what: Controller, steps: int) -> tuple[LoopTrajectory, list[float]]:
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

    def _small(self, what: Feedback) -> tuple[SmallPlant, Array]:
        """The reduced plant of an a-priori gain, and the gain on it."""
        problem, n_s, n = self.runs.problem, self.layout.n_s, self.layout.n_local
        V = self.family(what.basis).at(what.N).U.tall[n:, -((what.N - 2 * n_s) // 2) :]
        plant, shapes = project(problem, V)
        return plant, shapes.reduce_gain(problem, self.gain(what))

    def _reduced(self, what: Controller, steps: int) -> tuple[ReducedTrajectory, list[float]]:
        """Runs of the reduced plant on rank 0."""
        plant, K = self._small(what.gain)
        design, problem, n_s = self.runs.design, self.runs.problem, self.layout.n_s
        start = plant.rest_at(np.zeros(n_s))[0]
        if self.scene.time.start != "equilibrium":
            start[2 * n_s :] = 0.0
        rest, law = plant.rest_at(design.target.state.q_s), self._law(what.held, steps)

        def run() -> tuple[ReducedTrajectory, list[float]]:
            loop = ReducedLoop(plant, self.scene.time_end / steps)
            found = [loop.run(K, rest, steps, (problem.Q, problem.R), law, start) for _ in range(self.runs.repeats)]
            return found[0], [r.seconds["steps"] / steps for r in found]

        return on_root(self.layout.comm, run)

    def rows(self, what: Controller) -> Row:
        """All steps of one controller, and whether its gain is certified to stabilise the full plant."""

        def measure() -> Row:
            gain, stable = what.gain, True
            if gain.basis:
                stable = judged(self.runs.design, self.family(gain.basis), gain.N).stable
            return {"rows": [self._row(what, steps) for steps in self.counts], "stable": stable}

        key = {"controller": what.label, "counts": self.counts, "repeats": self.runs.repeats}
        return self.cache.get("loop", key, measure)

    def _row(self, what: Controller, steps: int) -> Row:
        """Errors, cost and seconds of one controller and step.

        Keys: error of the deformation and error_displacement against the optimal loop, error_time of the deformation
        against the same gain without time step, cost_error.
        """
        ending = self.reference_row()
        row: Row = {"steps": steps, "dt": self.scene.time_end / steps, "basis": what.gain.basis, "N": what.gain.N,
                    "held": what.held, "reduced_plant": what.reduced, "reason": "", "error": None, "seconds": None,
                    "per_step": None, "error_displacement": None, "error_time": None, "cost_error": None}  # fmt: skip
        run: Any
        try:
            run, means = self._reduced(what, steps) if what.reduced else self._full(what, steps)
        except (SolverError, ControlError) as failed:
            return row | {"reason": str(failed)}
        problem, target = self.runs.problem, self.runs.design.target
        columns, y = problem.columns, run.outputs - target.y
        both = np.hstack([y - (run.q_s - target.state.q_s) @ problem.C_s.T, y])
        error, displacement = errors_of(both, self.exact(Feedback(), steps), columns)
        if not displacement <= GONE:
            return row | {"reason": "far from the reference"}
        per_step = statistics.median(means)
        setup = run.seconds["prepare" if what.reduced else "factor"]
        due = ending["optimal"] - ending["to_come"]
        return row | {
            "error": error, "error_displacement": displacement, "per_step": per_step,
            "seconds": setup + steps * per_step, "setup": setup,
            "error_time": errors_of(both, self.exact(what.gain, steps), columns)[0],
            "cost": float(run.cost[-1]), "cost_error": abs(float(run.cost[-1]) - due) / ending["optimal"],
        }  # fmt: skip


def largest(values: Array, columns: Columns) -> float:
    """Largest distance of any output at any instant [m]; values (m, p). Not collective."""
    return float(farthest(values, np.zeros(values.shape[1]), columns).max())


def errors_of(values: Array, true: Array, columns: Columns) -> tuple[float, float]:
    """Largest error over the largest value, of each half of the columns (m, 2 p). Not collective."""
    p = true.shape[1] // 2
    halves = (slice(0, p), slice(p, 2 * p))
    return tuple(largest(values[:, h] - true[:, h], columns) / largest(true[:, h], columns) for h in halves)  # type: ignore[return-value]


def exact_outputs(runs: ControlRuns, modal: ModalLoop, gain: Gain, steps: int) -> Array:
    """C exp(F t_n) e(0), F = A + B K: y - y_bar without the part C_s of the hand, and with it, (steps + 1, 2 p).

    Collective.
    """
    K = modal.gain(Block(gain.K_s.T, np.concatenate([gain.K_z, gain.K_v])))
    e = modal.state(runs.design.error)[:, 0]
    whole, dt = modal.plant.space.C, runs.scene.time_end / steps
    own = whole.copy()
    own[:, : runs.layout.n_s] = 0.0
    C = np.vstack([own, whole])

    def march() -> Array:
        step = scipy.linalg.expm(dt * (modal.A + modal.B @ K))
        found, x = np.empty((steps + 1, len(C))), e
        found[0] = C @ x
        with np.errstate(over="ignore", invalid="ignore"):  # of a gain that does not stabilise
            for n in range(steps):
                x = step @ x
                found[n + 1] = C @ x
        return found

    return on_root(runs.layout.comm, march)


def sweep_loop(loops: LoopRuns) -> list[WorkPoint]:
    """All controllers at all steps. Collective.

    A loop that is lost, or whose gain is not certified, stays as a point that is not ok.

    Raises:
        SolverError: the optimal loop cannot be made.
        Interrupted: somebody asked to stop.
    """
    points = []
    for what in loops.controllers():
        loops.runs.guard.next(f"closed loop, {what.label}", controller_work(loops, what))
        found = loops.rows(what)
        for row in found["rows"]:
            ok = found["stable"] and not row["reason"]
            details = {k: v for k, v in row.items() if k not in ("error", "seconds")}
            label = f"{what.label}, {row['steps']} steps"
            points.append(
                WorkPoint("loop", what.label, label, number(row["seconds"]), number(row["error"]), ok, details)
            )
    return points


def controller_work(loops: LoopRuns, what: Controller) -> float:
    """Expected work of one controller at all steps, in the unit of the guard. Not collective."""
    return float(sum(loops.counts) * (50 if what.reduced else loops.layout.n_e + 200))


def loop_slopes(points: Sequence[WorkPoint]) -> list[Slope]:
    """Order in time of every controller on the full plant, against the same gain without time step. Not collective."""
    found = []
    for name in dict.fromkeys(p.series for p in points):
        mine = [p for p in points if p.series == name and p.ok and not p.details["reduced_plant"]]
        mine = sorted(mine, key=lambda p: -p.details["steps"])[:FINEST]
        power = power_law([p.details["steps"] for p in mine], [p.details["error_time"] for p in mine])
        if power is not None:
            found.append(Slope("loop", name, "error in time against steps", power, len(mine)))
    return found
