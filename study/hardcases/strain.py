"""Hard cases of finite strain: compression, incompressible and layered tissue, any step, inverted cells, a long sag."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy.sparse.linalg

from softgrasp.fem.errors import Interrupted
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array, to_scipy
from softgrasp.fem.run.midpoint import make_midpoint, state_on
from softgrasp.fem.run.motion import motion_table
from softgrasp.fem.run.simulate import RunOptions, simulate
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.fem.solve.statics import equilibrium
from softgrasp.fem.strain.body import Body
from softgrasp.fem.system import BlockSystem
from softgrasp.study.hardcases.cases import Family, HardCase, here, make, textbook, thin

LAW = "effects.finite_strain.law='neo-hooke'"
STRIP = (
    LAW, "control=false", "tissue.size=[0.4, 2.0]", "tissue.cells=[2, 10]", "contact.sides=['top']",
    "contact.box=[[0.0, 0.0], [0.4, 2.0]]", "motion={profile='hold'}",
)  # fmt: skip
SMALL = (LAW, "control=false", "tissue.cells=[3, 6]")
STEPS = 60


def period(model: Model) -> float:
    """First period [s] at small strain."""
    return float(2 * np.pi / lowest_modes(replace(model.system, points=None), 1)[0][0])


def squeezed(model: Model, J: float) -> Array:
    """The strip pressed evenly against the hand, det F = J in every cell but those that the hand bends."""
    y = model.system.layout.nodes[:, 1]
    return np.column_stack([0 * y, (1 - J) * (2.0 - y)]).ravel()


def let_go(system: BlockSystem, z: Array, dt: float) -> float:
    """Free vibration of finite strain from rest; |E_N - E_0| / E_0."""
    midpoint = make_midpoint(system, dt, "cholesky")
    state = state_on(np.concatenate([z, np.zeros_like(z)]), system)
    try:
        midpoint.start(state)
        start = midpoint.energy(state)
        for _ in range(STEPS):
            midpoint.solve_midpoint(np.zeros(system.layout.n_s))
            midpoint.advance(state, state)
        return abs(midpoint.energy(state) - start) / start
    finally:
        midpoint.destroy()


def newton_midpoint(system: BlockSystem, z: Array, dt: float) -> float:
    """The same by the midpoint rule, s^2 M w + f(z + w) = s M v, with Newton's method from w = 0 as it comes."""
    assert system.points is not None
    body, M, s = Body(system.points, system.materials), to_scipy(system.M_ee), 2 / dt
    x, f = system.K_ee.createVecs()

    def at(u: Array) -> tuple[Array, float]:
        x.array_w[:] = u
        body.force(x, f)
        return f.array_r.copy(), body.energy(x)

    v = np.zeros_like(z)
    first = at(z)[1]
    for _ in range(STEPS):
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
    """One body let go: energy kept to the rounding of what the steps add up."""
    reason = f"the asked defect of {STEPS} steps, 1e-9, at the default tolerance"
    ways = here(let_go, model.system, z, dt), textbook(newton_midpoint, model.system, z, dt)
    return HardCase(case, x, *ways, 1e-9, reason, group=group)


def strain_rows(quick: bool) -> Iterator[HardCase]:
    """Bodies let go from far outside the range of linear elasticity."""
    strip = make("paper_forward", *STRIP)
    T = period(strip)
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
        yield released(name, 0.3 if "nu" in name else 0.4, model, sheared, period(model) / 100, "material")
    small = make("paper_forward", *SMALL)
    T, z = period(small), 0.03 * np.sin(np.arange(small.system.layout.n_e))
    for share in thin((1e-3, 1e-2, 0.1, 1.0, 10.0), quick):
        yield released(f"dt = {share:g} of the first period", share, small, z, share * T, "time step")
    inverted = squeezed(strip, -0.2)
    ways = here(let_go, strip.system, inverted, T / 200), textbook(newton_midpoint, strip.system, inverted, T / 200)
    yield HardCase("start with inverted cells", -0.2, *ways, None, "the law has no energy there", group="start")


def sag_error(model: Model, newton: bool) -> float:
    """|f(z) - G g| / |G g| of the equilibrium, and that it sags by more than its length.

    ``newton``: by Newton's method from rest under the whole load instead, wherever it ends.
    """
    system = model.system
    assert system.points is not None
    assert system.gravity is not None
    body, load = Body(system.points, system.materials), system.G @ system.gravity
    z, f = system.K_ee.createVecs()
    if not newton:
        z.array_w[:] = equilibrium(system)
    for _ in range(12 if newton else 0):
        body.force(z, f)
        z.array_w[:] = z.array_r - scipy.sparse.linalg.spsolve(to_scipy(body.tangent(z)).tocsc(), f.array_r - load)
    body.force(z, f)
    right = newton or np.abs(z.array_r).max() > 2.0
    return float(np.linalg.norm(f.array_r - load) / np.linalg.norm(load)) if right else np.inf


def resumed(model: Model, fresh: bool) -> float:
    """Largest difference of a run that was stopped at half and gone on with; ``fresh``: from z and v alone."""
    whole = simulate(model).final
    with tempfile.TemporaryDirectory() as folder:
        half = RunOptions(Path(folder), until=model.scene.time.steps // 2)
        kept: list[Array] = []
        with suppress(Interrupted):
            simulate(model, replace(half, keep=lambda run: kept.append(run.state.array.copy())))
        if not fresh:
            return float(np.abs(simulate(model, RunOptions(Path(folder), resume=True)).final - whole).max())
    midpoint = make_midpoint(model.system, model.scene.time_end / model.scene.time.steps, "cholesky")
    state = state_on(kept[0], model.system)
    midpoint.start(state)
    for a in motion_table(model.scene, model.system.layout.n_s).a[model.scene.time.steps // 2 :]:
        midpoint.solve_midpoint(-a)
        midpoint.advance(state, state)
    midpoint.destroy()
    return float(np.abs(state.array - whole).max())


def strain_state_rows(quick: bool) -> Iterator[HardCase]:
    """A strip that sags by more than its length, and a run that is stopped."""
    for g in thin((50.0, 150.0, 250.0), quick)[1:]:
        model = make("paper_forward", *STRIP, f"effects.gravity.g=[0.0, {-g}]", "time.start='equilibrium'")
        ways = here(sag_error, model, False), textbook(sag_error, model, True)
        yield HardCase(f"strip under {g:g} m/s2", g, *ways, 1e-10, "ten times the tolerance of the equilibrium")
    model = make("paper_forward", *SMALL, "time.steps=60")
    ways = here(resumed, model, False), textbook(resumed, model, True)
    yield HardCase("stopped at half and gone on", 1.0, *ways, 0.0, "the same bits")


FAMILIES = (
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
