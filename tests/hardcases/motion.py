"""Hard cases of the time loop, linear and of finite strain: any step, damping and hand, compression, restarts."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse.linalg

from softgrasp.fem.errors import Interrupted
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array, to_scipy
from softgrasp.fem.run.make import make_midpoint
from softgrasp.fem.run.midpoint import midpoint_matrix, state_on
from softgrasp.fem.run.simulate import Run, RunOptions, simulate
from softgrasp.fem.run.states.trajectory import Trajectory
from softgrasp.fem.run.stepping import make_ts
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.fem.solve.statics import equilibrium
from softgrasp.fem.strain.body import HyperelasticBody
from softgrasp.fem.system import BlockSystem, Damping
from tests.hardcases.cases import EPS, Family, HardCase, here, make, scaled_condition, textbook, thin
from tests.hardcases.textbook import implicit_and_explicit, staggered, textbook_midpoint

SMALL = ("tissue.cells=[3, 6]", "control=false")


def period(system: BlockSystem) -> float:
    """First period 2 pi / omega_1 [s] at small strain."""
    return float(2 * math.pi / lowest_modes(replace(system, points=None), 1)[0][0])


def free_body() -> tuple[BlockSystem, Array, float, Any, Any]:
    """A held body, a displacement in which every mode takes part, its first period [s], and M, K in SciPy."""
    system = make("paper_forward", *SMALL, "motion={profile='hold'}").system
    z = 0.05 * np.random.default_rng(3).standard_normal(system.layout.n_e)
    return system, z, period(system), to_scipy(system.M_ee), to_scipy(system.K_ee)


def let_go(system: BlockSystem, z: Array, dt: float, steps: int, peaks: bool = False) -> float:
    """Free vibration from rest; |E_N + lost - E_0| / E_0.

    With ``peaks`` at least what the energy exceeds the first one by, which is as wrong.
    """
    midpoint = make_midpoint(system, dt, "cholesky")
    state, nothing = state_on(np.concatenate([z, np.zeros_like(z)]), system), np.zeros(system.layout.n_s)
    try:
        midpoint.start(state)
        start, highest = midpoint.energy(state), 1.0
        for n in range(steps):
            midpoint.solve_midpoint(nothing)
            if n == steps - 1:
                midpoint.residual()
            midpoint.advance(state, state)
            if n % 50 == 0:
                highest = max(highest, midpoint.energy(state) / start)
        lost = midpoint.over_ranks(midpoint.dissipated)
        midpoint.start(state)  # so that the last energy comes from M v and K z, as the first one did
        end = midpoint.energy(state)
    finally:
        midpoint.destroy()
    defect, excess = abs(end + lost - start) / start, max(highest, end / start) - 1
    return max(defect, excess) if peaks else defect


def solve_rounding(system: BlockSystem, dt: float) -> float:
    """What one solve of a step may change the energy by, relatively: 2 p eps kappa(S).

    kappa is the condition with the diagonal scaled to one [VDS69], p the most entries in a row, the constant of a
    factor's backward error [H02]; the energy is quadratic, hence 2.
    """
    S = midpoint_matrix(system, dt)
    result = 2 * int(np.diff(S.getValuesCSR()[0]).max()) * EPS * scaled_condition(S)
    S.destroy()
    return result


def drift_bound(system: BlockSystem, ratio: float, dt: float, steps: int) -> tuple[float, str]:
    """Bound on the relative energy drift and its reason."""
    one = solve_rounding(system, dt)
    if ratio < 1:
        return math.sqrt(steps) * one, "the rounding of one solve, 2 p eps cond(S), times sqrt(steps): a random walk"
    return steps * one, (
        "the rounding of one solve, 2 p eps cond(S), times the steps: from the period on K z outweighs the momentum "
        "carried beside it, so roundings may all add up"
    )


def step_rows(quick: bool) -> Iterator[HardCase]:
    """Energy of a free vibration for steps from a thousandth to a thousand first periods."""
    (system, z, first, M, K), steps = free_body(), 400 if quick else 2000
    for ratio in thin([1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0, 1e3], quick):
        dt = ratio * first
        drift = here(let_go, system, z, dt, steps)
        newmark = textbook(implicit_and_explicit, M, K, 0 * K, z, dt, steps)
        bound = drift_bound(system, ratio, dt, steps)
        yield HardCase(f"dt = {ratio:g} T1, {steps} steps", ratio, drift, newmark, *bound)


def long_rows(quick: bool) -> Iterator[HardCase]:
    """Energy after 1e5 steps of free vibration."""
    (system, z, first, M, K), steps = free_body(), 3000 if quick else 100_000
    for ratio in [1e-3] if quick else [1e-3, 1e-2, 1.0, 100.0]:
        dt = ratio * first
        drift = here(let_go, system, z, dt, steps)
        loop = textbook(textbook_midpoint, M, K, z, dt, steps)
        yield HardCase(f"{steps} steps of {ratio:g} T1", ratio, drift, loop, *drift_bound(system, ratio, dt, steps))


def damping_rows(quick: bool) -> Iterator[HardCase]:
    """Energy balance of a let-go body for damping from none to a million times critical."""
    (system, z, first, M, K), steps = free_body(), 200 if quick else 1000
    omega, dt = 2 * math.pi / first, first / 500
    for zeta in thin([0.0, 1e-14, 1e-8, 1e-2, 1.0, 1e3, 1e6], quick):
        beta = 2 * zeta / omega
        damped = replace(system, damping=Damping(beta=beta))
        newmark = textbook(implicit_and_explicit, M, K, beta * K, z, dt, steps)
        name = "undamped" if zeta == 0 else f"{zeta:g} of critical in the first mode"
        reason = "what is lost must be what damping took, up to 2 p eps cond(S) sqrt(steps), a random walk of roundings"
        bound = math.sqrt(steps) * solve_rounding(damped, dt)
        yield HardCase(name, zeta, here(let_go, damped, z, dt, steps, True), newmark, bound, reason)


def _momentum_error(model: Model, push: Array) -> float:
    """Momentum of hand and tissue at the end of a run, pushed in the first step only, against the push."""
    system, dt = model.system, model.scene.time_end / model.scene.time.steps
    still = np.zeros_like(push)
    run = simulate(model, force=lambda n, t, q, v: push / dt if n == 0 else still)
    v_z = run.final[system.layout.n_local :]
    momentum = (system.M_hand + system.M_rigid) @ run.v_s[-1] + system.G.T @ v_z
    return float(np.abs(momentum - push).max() / push.max())


def mass_rows(quick: bool) -> Iterator[HardCase]:
    """Momentum of hand and tissue after a short push, for hands from a thousandth to a million tissue masses."""
    tissue, push, dt, steps = 2.0, np.array([1.0, 0.5]), 0.005, 200 if quick else 1000
    for ratio in thin([1e-3, 1e-2, 0.1, 1.0, 10.0, 1e3, 1e6], quick):
        scene = (f"hand.mass={tissue * ratio!r}", "effects={reaction=true}", "motion={profile='hold', drive='force'}")
        model = make("paper_forward", *SMALL, *scene, f"time={{steps={steps}, end={dt * steps!r}}}")
        system = model.system
        operators = to_scipy(system.M_ee), to_scipy(system.K_ee), system.G, system.M_rigid, system.M_hand
        turns = textbook(staggered, *operators, push, dt, steps)
        reason = "without outer force the momentum is constant: ten sums and products a step, each rounded once"
        bound = 10 * steps * EPS
        yield HardCase(f"hand / tissue = {ratio:g}", ratio, here(_momentum_error, model, push), turns, bound, reason)


RESTARTS = {
    "undamped": (),
    "Rayleigh damping": ("effects={damping={kind='rayleigh', alpha=0.4, beta=0.01}}",),
    "two-way, driven by force": ("effects={reaction=true}", "motion.drive='force'"),
    "snapshots in HDF5": ("output={snapshots='hdf5', every=3}",),
    "gravity, turning hand, P2": (
        "effects={gravity={g=[1.0, -9.0]}, rotation=true}", "hand={mass=20.0, inertia=3.0}", "tissue.order=2",
        "motion.target=[5.0, 3.0, 0.3]",
    ),
}  # fmt: skip


def different_bits(a: Array, b: Array) -> int:
    """Number of doubles whose bits differ."""
    return int((a.view(np.int64) != b.view(np.int64)).sum())


def differing(a: Trajectory, b: Trajectory) -> int:
    """Number of doubles whose bits differ between two runs."""
    pairs = [(a.q_s, b.q_s), (a.v_s, b.v_s), (a.outputs, b.outputs), (a.final, b.final)]
    pairs.append((np.array([a.energy_drift]), np.array([b.energy_drift])))
    if a.snapshots is not None and b.snapshots is not None:
        pairs.append((a.snapshots.Z, b.snapshots.Z))
    return sum(different_bits(x, y) for x, y in pairs)


def interrupted(model: Model, stop: int) -> tuple[Trajectory, Trajectory]:
    """An unbroken run, and one that was stopped and resumed."""
    with tempfile.TemporaryDirectory() as name:
        whole, part = Path(name) / "whole", Path(name) / "part"
        unbroken = simulate(model, RunOptions(whole))
        with suppress(Interrupted):
            simulate(model, RunOptions(part, until=stop))
        return unbroken, simulate(model, RunOptions(part, resume=True))


def from_state_only(model: Model, stop: int) -> tuple[Array, Array]:
    """Last states of an unbroken run, and of one that goes on from the exact q_s, v_s, z, v of a step alone."""
    with tempfile.TemporaryDirectory() as name:
        whole = simulate(model, RunOptions(Path(name) / "whole"))
        run = Run(model, RunOptions(Path(name) / "part"))
        ts = make_ts(run)
        run.start()
        run.advance_to(ts, stop)
        run.midpoint.start(run.state)  # M v and K z anew from the state
        run.advance_to(ts, run.steps)
        ts.destroy()
    return whole.final, run.state.array


def restart_rows(quick: bool) -> Iterator[HardCase]:
    """Stop in the middle, go on from the restart file, and count the doubles that differ from an unbroken run.

    One row for all kinds of run: a zero says the same of each.
    """
    names = list(RESTARTS)[: 2 if quick else None]
    models = [make("paper_forward", "tissue.cells=[4, 8]", "time.steps=60", *RESTARTS[name]) for name in names]
    resumed = here(lambda: sum(differing(*interrupted(model, 23)) for model in models))
    lost = textbook(lambda: min(different_bits(*from_state_only(model, 23)) for model in models))
    yield HardCase("; ".join(names), 1, resumed, lost, 0.0, "the same bits, not nearly the same")


# --- finite strain

LAW = "effects.finite_strain.law='neo-hooke'"
STRIP = (
    LAW, "control=false", "tissue.size=[0.4, 2.0]", "tissue.cells=[2, 10]", "contact.sides=['top']",
    "contact.box=[[0.0, 0.0], [0.4, 2.0]]", "motion={profile='hold'}",
)  # fmt: skip
SMALL_STRAIN = (LAW, *SMALL)
STRAIN_STEPS = 60


def squeezed(model: Model, J: float) -> Array:
    """The strip pressed evenly against the hand, det F = J in every cell but those that the hand bends."""
    y = model.system.layout.nodes[:, 1]
    return np.column_stack([0 * y, (1 - J) * (2.0 - y)]).ravel()


def newton_midpoint(system: BlockSystem, z: Array, dt: float) -> float:
    """The same by the midpoint rule, s^2 M w + f(z + w) = s M v, with Newton's method from w = 0 as it comes."""
    assert system.points is not None
    body, M, s = HyperelasticBody(system.points, system.materials), to_scipy(system.M_ee), 2 / dt
    x, f = system.K_ee.createVecs()

    def at(u: Array) -> tuple[Array, float]:
        x.array_w[:] = u
        body.force(x, f)
        return f.array_r.copy(), body.energy(x)

    v = np.zeros_like(z)
    first = at(z)[1]
    for _ in range(STRAIN_STEPS):
        w = np.zeros_like(z)
        for _ in range(12):
            R = s * s * (M @ w) + at(z + w)[0] - s * (M @ v)
            x.array_w[:] = z + w
            K = to_scipy(body.tangent(x))
            w = w - scipy.sparse.linalg.spsolve((K + s * s * M).tocsc(), R)
            if np.linalg.norm(R) <= 1e-9 * np.linalg.norm(s * (M @ v) + at(z)[0]):
                break
        z, v = z + 2 * w, 2 * s * w - v
    return float(abs(at(z)[1] + v @ (M @ v) / 2 - first) / first)


def released(case: str, x: float, model: Model, z: Array, dt: float, group: str) -> HardCase:
    """One body let go: energy kept to the rounding of what the steps add up; cells that start inverted have none."""
    ways = here(let_go, model.system, z, dt, STRAIN_STEPS), textbook(newton_midpoint, model.system, z, dt)
    if group == "start":
        return HardCase(case, x, *ways, None, "the law has no energy there", group=group)
    reason = f"the asked defect of {STRAIN_STEPS} steps, 1e-9, at the default tolerance"
    return HardCase(case, x, *ways, 1e-9, reason, group=group)


def strain_rows(quick: bool) -> Iterator[HardCase]:
    """Bodies let go from far outside the range of linear elasticity."""
    strip = make("paper_forward", *STRIP)
    T = period(strip.system)
    for J in thin((0.5, 0.3, 0.1), quick):
        yield released(f"squeezed to det F = {J:g}", J, strip, squeezed(strip, J), T / 200, "compression")
    for name, overrides in (
        ("nu = 0.499, P2", (
            "tissue.cells=[1, 5]", "tissue.order=2", "tissue.material={young=130.0, poisson=0.499, rho=1.0}")),
        ("layers 1 : 1e4", (
            "tissue.layers={low={box=[[0.0, 0.0], [0.4, 1.0]], material={lambda=5e5, mu=5e5, rho=1.0}}}",)),
    ):  # fmt: skip
        model = make("paper_forward", *STRIP, *overrides)
        y = model.system.layout.nodes[:, 1]
        sheared = np.column_stack([0.4 * np.minimum(2.0 - y, 1.0), 0 * y]).ravel()  # the lower half as it is
        yield released(name, 0.3 if "nu" in name else 0.4, model, sheared, period(model.system) / 100, "material")
    small = make("paper_forward", *SMALL_STRAIN)
    T, z = period(small.system), 0.03 * np.sin(np.arange(small.system.layout.n_e))
    for share in thin((1e-3, 1e-2, 0.1, 1.0, 10.0), quick):
        yield released(f"dt = {share:g} of the first period", share, small, z, share * T, "time step")
    yield released("start with inverted cells", -0.2, strip, squeezed(strip, -0.2), T / 200, "start")


def sag_error(model: Model, newton: bool) -> float:
    """|f(z) - G g| / |G g| of the equilibrium, and that it sags by more than its length.

    ``newton``: by Newton's method from rest under the whole load instead, wherever it ends.
    """
    system = model.system
    assert system.points is not None
    assert system.gravity is not None
    body, load = HyperelasticBody(system.points, system.materials), system.G @ system.gravity
    z, f = system.K_ee.createVecs()
    if not newton:
        z.array_w[:] = equilibrium(system)
    for _ in range(12 if newton else 0):
        body.force(z, f)
        z.array_w[:] = z.array_r - scipy.sparse.linalg.spsolve(to_scipy(body.tangent(z)).tocsc(), f.array_r - load)
    body.force(z, f)
    right = newton or np.abs(z.array_r).max() > 2.0
    return float(np.linalg.norm(f.array_r - load) / np.linalg.norm(load)) if right else np.inf


def strain_state_rows(quick: bool) -> Iterator[HardCase]:
    """A strip that sags by more than its length, and a run that is stopped."""
    for g in thin((50.0, 150.0, 250.0), quick)[1:]:
        model = make("paper_forward", *STRIP, f"effects.gravity.g=[0.0, {-g}]", "time.start='equilibrium'")
        ways = here(sag_error, model, False), textbook(sag_error, model, True)
        yield HardCase(f"strip under {g:g} m/s2", g, *ways, 1e-10, "ten times the tolerance of the equilibrium")
    model = make("paper_forward", *SMALL_STRAIN, "time.steps=60")

    def difference(whole: Array, end: Array) -> float:
        return float(np.abs(end - whole).max())

    resumed = here(lambda: difference(*(run.final for run in interrupted(model, 30))))
    ways = resumed, textbook(lambda: difference(*from_state_only(model, 30)))
    yield HardCase("stopped at half and gone on", 1.0, *ways, 0.0, "the same bits")


FAMILIES = (
    Family("step", "Time steps from tiny to huge", "time step / first period", "relative energy drift",
           "Newmark's rule",
           "Both implicit rules keep the energy, this one with up to three digits more at huge steps; explicit "
           "leapfrog blows up beyond the period of the smallest cell.",
           step_rows),
    Family("long", "Very many steps", "time step / first period", "relative energy drift",
           "midpoint rule with M v computed anew",
           "Up to the period, carrying the momentum is up to a thousand times better than M v computed anew; far "
           "beyond it, where no motion is resolved, M v anew rounds less.",
           long_rows),
    Family("damping", "None, almost none, far too much damping", "share of critical damping",
           "relative defect of the energy balance", "Newmark's rule",
           "The balance of both implicit rules closes from none to overdamped; viscosity makes leapfrog explode.",
           damping_rows),
    Family("mass", "Light and heavy hands", "mass of the hand / mass of the tissue", "relative error of the momentum",
           "in turn until both agree",
           "Solved in turn once a step, a hand lighter than the tissue blows up (added mass). Repeated until both "
           "agree the momentum is kept at the price of several solves a step; solved together it takes one.",
           mass_rows),
    Family("restart", "Stopped and gone on", "case", "doubles that differ", "restart from displacement and velocity",
           "Displacement and velocity alone lose the last bits of the carried momentum.", restart_rows, axis="listed"),
    Family("finite_strain", "Finite strain", "det F, share of a period, or measure of the material",
           "relative defect of the energy", "midpoint rule and Newton's method without safeguards",
           "The discrete gradient keeps the energy whatever the step and however strong the compression, and inverted "
           "cells are refused; Newton's method as it comes leaves the energy to chance or stops with no number.",
           strain_rows, axis="listed"),
    Family("finite_state", "Equilibrium and restart of finite strain", "gravity [m/s2]",
           "residual of the equilibrium, difference after a restart", "one load step; restart from z and v",
           "Load steps reach an equilibrium several times the body's length away, and a restart keeps every bit, "
           "because tangent, pairs and last steps are stored.",
           strain_state_rows, axis="listed"),
)  # fmt: skip
