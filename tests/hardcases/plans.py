"""Hard cases of plans past obstacles and of observers: no room, no damping, few markers, late samples, stiff loops."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np

from softgrasp.fem.model.build import Stopwatch
from softgrasp.lqr.constrained.tissue import modal_tissue
from softgrasp.lqr.design.constrained import PlannedControl, plan_control
from softgrasp.lqr.design.feedback import design
from softgrasp.lqr.design.observer import ObservedControl, observe
from softgrasp.lqr.observer.judge import loop_map, make_ticks
from softgrasp.lqr.observer.reduced import reduced_filter
from softgrasp.lqr.observer.sensors import Noise, make_disturbance, make_sensors
from softgrasp.lqr.observer.tube import node_rows, run_tube
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.program.least_distance import nearest
from softgrasp.lqr.spectrum.modal_loop import DENSE_LIMIT, ModalLoop
from tests.hardcases.cases import Family, HardCase, Outcome, here, make, textbook

BODY = ("tissue.cells=[2, 4]", "control.constraints.N=14", "control.constraints.parts=4")
NO_SPEED = "control.constraints={force=8.0, N=14, parts=4}"
WALL = "{kind='halfspace', normal=[-1, 0], offset=-6.05}"
DISC = "{kind='disc', center=[3.4, 1.2], radius=0.7}"


@cache
def planned(*changes: str) -> PlannedControl:
    """The plan of the paper's scene past other obstacles, on a coarse mesh."""
    model = make("paper_obstacle", *BODY, *changes)
    return plan_control(design(model), Stopwatch(model.system.layout.comm), online=False)


def depth(*changes: str) -> float:
    """How deep the body of the full plant goes into an obstacle under the plan [m]."""
    return max(0.0, -float(planned(*changes).runs.planned.gaps.min()))


def depth_free(*changes: str) -> float:
    """The same under the optimal feedback, which has no obstacles."""
    return max(0.0, -float(planned(*changes).runs.free.gaps.min()))


def one_step(*_: str) -> float:
    """A program that needs two rows with a limit of one step."""
    return float(np.abs(nearest(-np.eye(2), -np.ones(2), limit=1).x - 1).max())


@cache
def many_rows() -> tuple[np.ndarray, np.ndarray]:
    """A hundred thousand half-spaces in twenty dimensions that leave the origin out, all of which (2, 0, ..) keeps."""
    rng = np.random.default_rng(0)
    G = rng.standard_normal((100_000, 20))
    G /= np.linalg.norm(G, axis=1)[:, None]
    G[:, 0] = -np.abs(G[:, 0])
    return G, 2 * G[:, 0] + 0.1 * rng.random(len(G))


def optimality(*_: str) -> float:
    """Largest violation of the conditions of Karush, Kuhn and Tucker."""
    G, h = many_rows()
    found = nearest(G, h)
    gap = G @ found.x - h
    stationary = np.abs(found.x + G.T @ found.multipliers).max()
    return float(max(gap.max(), stationary, np.abs(found.multipliers * gap).max(), -found.multipliers.min()))


def projected(*_: str) -> float:
    """Largest violation after a thousand projections on the half-space that is violated most."""
    G, h = many_rows()
    x = np.zeros(20)
    for _step in range(1000):
        gap = G @ x - h
        i = int(gap.argmax())
        x = x - max(gap[i], 0.0) * G[i]
    return float(max((G @ x - h).max(), np.abs(x - nearest(G, h).x).max()))


def slit(room: float) -> str:
    """Two discs beside the body at the target, so far off."""
    left, right = (f"{{kind='disc', center=[{x:.7f}, 4.0], radius=0.5}}" for x in (-0.5 - room, 1.5 + room))
    return f"obstacle=[{left}, {right}]"


SAGGING = ("motion.target=[5.0, 0.0]", "effects.gravity=[0, -0.1]", "time.start='equilibrium'")
"""Hanging tissue, 1.1 mm at most below where it would be without weight."""
UPWARDS = ("motion.target=[0.0, 3.0]", "control.constraints.margin=1e-3", "control.constraints.horizon=20")


def noisy(*_: str) -> float:
    """How deep the body goes in where place and speed of the hand are measured with noise, without an observer."""
    model = make("paper_obstacle", *BODY, "control.loop.rate=100")
    made = design(model)
    problem, found = made.problem, plan_control(made, Stopwatch(model.system.layout.comm))
    assert found.online is not None
    own, loop = found.online.controller, ModalLoop(problem, DENSE_LIMIT)
    sensors = make_sensors(problem, [], Noise(1e-4, speed=1e-3))
    ticks = make_ticks(problem, loop, sensors, make_disturbance(problem, 0.0, 0.0, None), own.period)
    rows = node_rows(modal_tissue(problem, found.surface, loop), problem.layout.n_s)
    run = run_tube(own, ticks, rows, round(len(found.plan.inputs) / own.period), 1)
    task = found.plan.task
    return max(0.0, -float(task.gaps(task.places + run.moved, run.times).min()))


FOUND = "the same with a horizon that is found"  # ten seconds, not in the quick half
PLANS: tuple[tuple[str, tuple[str, ...], float | None], ...] = (
    ("wall 5 cm behind the target", (f"obstacle=[{WALL}]",), 0.0),
    ("two equal walls", (f"obstacle=[{WALL}, {WALL}]",), 0.0),
    ("slit of 2 cm around the body at the target", (
        "obstacle=[{kind='halfspace', normal=[-1, 0], offset=-6.01}, {kind='halfspace', normal=[0, -1], offset=-5.01}]",
    ), 0.0),
    ("wall 3 mm behind the target", ("obstacle=[{kind='halfspace', normal=[-1, 0], offset=-6.003}]",), 0.0),
    ("target that touches", ("obstacle=[{kind='halfspace', normal=[-1, 0], offset=-6.0}]",), None),
    ("target inside", ("obstacle=[{kind='halfspace', normal=[-1, 0], offset=-5.9}]",), None),
    ("disc over the start, 0.1 m deep", ("obstacle=[{kind='disc', center=[-0.6, 1.0], radius=0.7}]",), 0.101),
    ("disc that moves", ("obstacle=[{kind='disc', center=[3.4, 1.2], radius=0.7, path={velocity=[0.1, 0]}}]",), 0.0),
    ("disc that moves on to the target", (
        "obstacle=[{kind='disc', center=[3.4, 1.2], radius=0.7, path={velocity=[0.01, 0.01]}}]",), None),
    ("Q = 1e6", (f"obstacle=[{WALL}]", "control.Q=1e6", "control.constraints.force=60.0",
                 "control.constraints.grid=0.1", "control.constraints.speed=20.0"), 0.0),
    ("beta = 2e-4", (f"obstacle=[{WALL}]", "effects.damping={kind='kelvin-voigt', beta=2e-4}"), 0.0),
    ("no damping", (f"obstacle=[{WALL}]", "effects.damping=false", "control.method='modal'"), None),
    ("nu = 0.4999", (f"obstacle=[{WALL}]", "tissue.material={young=125.0, poisson=0.4999, rho=1.0}"), 0.0),
    ("hand that feels the tissue", (f"obstacle=[{WALL}]", "effects.reaction=true", NO_SPEED), 0.0),
    ("light hand that feels the tissue", (f"obstacle=[{WALL}]", "effects.reaction=true", "hand.mass=0.5", NO_SPEED,
                                          "obstacle.0.offset=-6.5"), 0.0),
    ("hand that feels the tissue, of limited speed", (f"obstacle=[{WALL}]", "effects.reaction=true"), None),
    ("hand that turns", (f"obstacle=[{WALL}]", "effects.rotation=true", "hand.inertia=5.0",
                       "motion.target=[5.0, 3.0, 0.0]", "control.outputs=[{kind='hand'}]"), 0.0),
    ("hand that turns and feels the tissue", (
        f"obstacle=[{WALL}]", "effects.rotation=true", "effects.reaction=true", "hand.inertia=5.0",
        "motion.target=[5.0, 3.0, 0.0]", "control.outputs=[{kind='hand'}]", NO_SPEED), None),
    ("wall with a micrometre more than the margins", (
        "obstacle=[{kind='halfspace', normal=[-1, 0], offset=-6.001001}]", "control.constraints.margin=1e-3",
    ), 0.0),
    ("wall with a micrometre less", (
        "obstacle=[{kind='halfspace', normal=[-1, 0], offset=-6.000999}]", "control.constraints.margin=1e-3",
    ), None),
    ("body that sags by its weight", (
        f"obstacle=[{WALL}]", "effects.gravity=[0, -0.1]", "time.start='equilibrium'",
    ), 0.0),
    ("floor between the body and its sag", (
        *SAGGING, "obstacle=[{kind='halfspace', normal=[0, 1], offset=-1e-3}]",), None),
    ("floor 5 mm below its sag", (*SAGGING, "obstacle=[{kind='halfspace', normal=[0, 1], offset=-6e-3}]"), 0.0),
    ("disc that crosses the way", (
        "obstacle=[{kind='disc', center=[4.5, -1.5], radius=0.7, path={velocity=[0, 0.3]}}]",), 0.0),
    ("disc that runs through the body, faster than it", (
        "obstacle=[{kind='disc', center=[0.5, -1.5], radius=0.7, path={velocity=[0, 3]}}]",), 1.157),
    ("slit of two discs, a micrometre narrower than body and margins", (slit(0.999e-3), *UPWARDS), None),
    ("slit of two discs, a micrometre wider", (slit(1.001e-3), *UPWARDS), 0.0),
    (FOUND, (slit(1.001e-3), *UPWARDS[:2]), 0.0),
)  # fmt: skip


def plan_rows(quick: bool) -> Iterator[HardCase]:
    """Plans with little room, and scenes that have none."""
    for number, (name, changes, bound) in enumerate(PLANS):
        if quick and (number % 2 or name == FOUND):
            continue
        reason = (
            "every gap is kept at every step"
            if not bound
            else "the depth that no force within the limits avoids, and no more than 1 % of it"
        )
        if bound is None:
            reason = "there is no room, or no bound of what the reduced plant leaves out"
        yield HardCase(name, number + 1.0, here(depth, *changes), textbook(depth_free, *changes), bound, reason)
    limited = textbook(lambda: Outcome(None, "has no limit"))
    yield HardCase("one step of the active set", len(PLANS) + 1.0, here(one_step), limited, None, "it needs two")
    rows = "rounding of the conditions of optimality"
    yield HardCase("a hundred thousand rows", len(PLANS) + 2.0, here(optimality), textbook(projected), 1e-12, rows)
    name, kept = "noise of the hand without an observer", "0.1 mm and 1 mm/s of noise, and every gap is kept"
    yield HardCase(name, len(PLANS) + 3.0, here(noisy), textbook(depth_free), 0.0, kept)


MARKERS = "markers=[[0, 0], [1, 0], [0, 1], [1, 1]]"
BOTTOM = "disturbance={box=[[0, 0], [1, 0]]}"


@cache
def observed(table: str, *changes: str) -> ObservedControl:
    """The observer of the paper's control problem."""
    model = make("paper_lqr", "tissue.cells=[4, 8]", f"control.observer={{{table}, {BOTTOM}}}", *changes)
    return observe(design(model), Stopwatch(model.system.layout.comm))


def slower(table: str, *changes: str) -> float:
    """By which share the loop with observer is slower than with the state known."""
    judged = observed(table, *changes).judged
    return max(0.0, 1 - judged.abscissa / judged.abscissa_known)


def slower_naive(table: str, *changes: str) -> float:
    """The same of a filter that takes its reduced plant for the full one; 1 where the full loop is not stable."""
    found = observed(table, *changes)
    model = make("paper_lqr", "tissue.cells=[4, 8]", *changes)
    problem = design(model).problem
    acting, own = make_disturbance(problem, 0.02, 0.05, [[0, 0], [1, 0]]), found.reduced
    try:
        plant, sensors, period, late = found.loop.plant, found.sensors, found.controller.period, own.filter.delay
        naive = reduced_filter(problem, plant, sensors, acting, own.plant.N, period, late, weight=0.0)
    except ControlError:
        return 1.0
    values = np.linalg.eigvals(loop_map(found.ticks, found.controller.K, naive.filter).F)
    rate = float(np.log(np.abs(values).max())) / found.controller.period
    return min(1.0, max(0.0, 1 - rate / found.judged.abscissa_known))


def unmeasured(*, skipped: bool = True) -> float:
    """Largest share by which 3 s of the full loop change where two samples are NaN for the second of them."""
    found = observed(MARKERS)
    runs = []
    for lost in (False, True):
        own, ticks = (
            replace(found.controller, x_bar=0 * found.controller.x_bar, u_bar=0 * found.controller.u_bar),
            found.ticks,
        )
        filter_, x = own.observer, np.zeros(len(ticks.A))
        assert filter_ is not None
        x[4], estimate, way = 1.0, np.zeros(own.plant.N), []  # the slowest mode, of which the filter knows nothing
        own.reset()
        for tick in range(round(3 / own.period)):
            y = ticks.C @ x
            if lost and 1 <= tick * own.period < 2:
                y[-2:] = np.nan
            if skipped:
                u = own.step(y[:2], np.zeros(2), y[2:])
            else:
                estimate = estimate + filter_.M @ (y - filter_.C @ estimate)
                u = own.K @ estimate
                estimate = filter_.A @ estimate + filter_.B @ u
            x = ticks.A @ x + ticks.B @ u
            way.append(x[:2])
        runs.append(np.array(way))
    return float(np.abs(runs[1] - runs[0]).max() / np.abs(runs[0]).max())


OBSERVERS: tuple[tuple[str, tuple[str, ...], float | None], ...] = (
    ("four markers, Q = 1e6", (MARKERS, "control.Q=1e6"), 0.02),
    ("four markers", (MARKERS,), 0.02),
    ("one marker", ("markers=[[0, 0]]",), 0.02),
    ("force alone", ("noise={force=0.01}",), 0.02),
    ("samples one tick late", (f"{MARKERS}, delay=1",), 0.02),
    ("samples 20 ticks late", (f"{MARKERS}, delay=20",), 0.02),
    ("markers of a micrometre", (f"{MARKERS}, noise={{marker=1e-6}}",), 0.02),
    ("markers of a kilometre", (f"{MARKERS}, noise={{marker=1e3}}",), 0.2),
    ("beta = 2e-4", (MARKERS, "effects.damping={kind='kelvin-voigt', beta=2e-4}"), 0.02),
    ("no damping", (MARKERS, "effects.damping=false", "control.method='modal'"), None),
    ("nu = 0.4999", (MARKERS, "tissue.material={young=125.0, poisson=0.4999, rho=1.0}"), 0.02),
    ("hand that feels the tissue, 0.5 kg", (MARKERS, "effects.reaction=true", "hand.mass=0.5"), 0.02),
    ("two markers on one node", ("markers=[[0, 0], [0.01, 0]]",), None),
)


def observer_rows(quick: bool) -> Iterator[HardCase]:
    """Observers with few, late, fine and coarse samples."""
    for number, (name, arguments, bound) in enumerate(OBSERVERS):
        if quick and number % 2:
            continue
        reason = "there is nothing to estimate with" if bound is None else "the gain sets the pace, not the estimate"
        yield HardCase(name, number + 1.0, here(slower, *arguments), textbook(slower_naive, *arguments), bound, reason)
    naive, reason = textbook(lambda: unmeasured(skipped=False)), "the other samples, and the model, show what it would"
    name = "a marker that is NaN for 1 s"
    yield HardCase(name, len(OBSERVERS) + 1.0, here(lambda *_: unmeasured()), naive, 0.02, reason)


FAMILIES = (
    Family("obstacles", "Plans past obstacles", "case", "depth of the body in an obstacle [m]", "optimal feedback",
           "The optimal feedback has no obstacles and goes through them. The plan keeps every gap on the full plant, "
           "with millimetres of room and stiff loops; where there is no plan a sentence says so.",
           plan_rows, axis="listed"),
    Family("observers", "Observers of the tissue", "case", "share by which the loop is slower [1]",
           "filter of the reduced plant alone",
           "A filter that takes its reduced plant for the full one may slow the full loop or upset it, and nothing on "
           "its own plant shows it. Here what it leaves out is noise, and the full plant with all modes decides.",
           observer_rows, axis="listed"),
)  # fmt: skip
