"""Exact derivatives of a reduced run by its adjoint, the midpoint rule backwards.

With r_n = dJ/dy_n and x_{n+1/2} = (x_n + x_{n+1}) / 2,

    (E - h/2 A)' l_n = C' r_{n+1} + (E + h/2 A)' l_{n+1},   l_steps = 0,
    dJ/dA = h sum_n l_n x_{n+1/2}',   dJ/dE = -sum_n l_n (x_{n+1} - x_n)',   dJ/df = h sum_n l_n,   dJ/du_n = h B' l_n,

in the rows of the tissue alone where the hand is prescribed. The discrete run is differentiated, so that the
derivatives are exact to rounding, for the cost of about a run whatever their number. The way back is in coordinates of
the energy, as the run is: x = X w and l = X m, with X'E X and X'A X in place of E and A. It steps the costate itself:
to carry (E - h/2 A)' l_n and to divide at the end lost four digits (block, N = 36), in any coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from softgrasp.fem.adjoint.result import Loss, RunGradient
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array
from softgrasp.fem.reduced import MidpointSteps
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.online import ReducedTrajectory, run
from softgrasp.reduction.operators import Parameters
from softgrasp.reduction.propagator import Propagator, propagator
from softgrasp.reduction.system import EnergySystem, ModelError


def reduced_gradient(
    rom: ReducedModel,
    loss: Loss,
    dt: float,
    *,
    force: Array | None = None,
    hand: tuple[Array, Array] | None = None,
    materials: tuple[LayerMaterial, ...] | None = None,
    x0: Array | Literal["equilibrium"] | None = None,
) -> RunGradient[ReducedTrajectory]:
    """J and its derivatives, dJ/dtheta = sum_n h l_n' (A_theta x_{n+1/2} + f_theta) - l_n' E_theta (x_{n+1} - x_n).

    The adjoint l of the implicit midpoint rule [HLW06] is the rule backwards. Online; not collective.

    Args:
        rom: linear reduced model.
        loss: gives J and dJ/dy of the outputs.
        dt: step [s].
        force: u on the hand at the step midpoints, (steps, n_s) [N, N m].
        hand: q_s and v_s of a prescribed hand, (steps + 1, n_s) each, instead of a force.
        materials: one a layer; None: those of the projection.
        x0: initial state (N,), which does not depend on the materials; "equilibrium": that under gravity, A x_0 + f = 0
            in the rows of the tissue, whose change with them the derivatives contain; None is zero.

    Raises:
        ModelError: there is no such equilibrium, neither or both of force and hand are given, or shapes do not fit.
        UnstableModelError: the model has growing modes there.
    """
    materials = rom.materials if materials is None else materials
    system = rom.at(materials)
    settled = isinstance(x0, str)
    if isinstance(x0, str) and x0 != "equilibrium":
        raise ModelError(f"x0 = '{x0}': the initial state must be an array of N numbers, or 'equilibrium'")
    step = propagator(system, dt, hand is not None)
    answer = run(step, dt, force, hand, system.equilibrium() if isinstance(x0, str) else x0)
    value, r = loss(answer.outputs)
    r = np.asarray(r, dtype=float)
    if r.shape != answer.outputs.shape:
        raise ModelError(f"dJ/dy has the shape {r.shape}; it must be {answer.outputs.shape}, that of the outputs")
    rows = slice(0 if hand is None else 2 * system.n_s, system.N)
    costate = adjoint(step, r)
    x = answer.x
    slope_a, slope_e, slope_f = (
        dt / 2 * costate.T @ (x[1:] + x[:-1]),
        -costate.T @ np.diff(x, axis=0),
        dt * costate.sum(axis=0),
    )
    start, hands = _start(system, rows, r, costate, dt), 2 * system.n_s
    if settled:  # dx_0 = -A^-1 (dA x_0 + df) in the rows of the tissue
        zeta = np.linalg.solve(system.A[hands:, hands:].T, start[hands:])
        slope_a[hands - rows.start :] -= np.outer(zeta, x[0])
        slope_f[hands - rows.start :] -= zeta

    p = rom.parameters(materials)

    def along(changed: Parameters) -> float:
        """sum_ij dJ/dA_ij (A_ij at other parameters less ours), and so on."""
        E, A, f = rom.equations(changed)
        by_a, by_e = np.vdot(slope_a, (A - system.A)[rows]), np.vdot(slope_e, (E - system.E)[rows])
        return float(by_a + by_e + slope_f @ (f - system.f)[rows])

    def of(key: str) -> Array:
        """By one constant of each layer; the matrices are affine in it, so that any step is exact."""
        result = np.empty(len(materials))
        for i, m in enumerate(materials):
            step = {"lam": abs(m.lam) + m.mu, "beta": 1.0}.get(key) or getattr(m, key)
            changed = replace(m, **{key: getattr(m, key) + step})
            others = (*materials[:i], changed, *materials[i + 1 :])
            result[i] = along(replace(p, materials=others)) / step
        return result

    return RunGradient(
        run=answer,
        value=float(value),
        lam=of("lam"),
        mu=of("mu"),
        beta=of("beta") if rom.damped else None,
        rho=of("rho") if rom.coordinates == "qv" else None,
        alpha=along(replace(p, alpha=p.alpha + 1.0)) if rom.damped else None,
        start=start,
        force=dt * costate @ system.B if hand is None else None,
        hand=None if hand is None else _hand(system, rows, r, costate, dt),
    )


def adjoint(step: Propagator, r: Array) -> Array:
    """l_n of all steps in the rows of the step, (steps, rows), for r = dJ/dy (steps + 1, p)."""
    X = step.at.X
    E, A, C = X.T @ step.E, X.T @ step.A, step.model.C[:, -len(X) :] @ X
    back = MidpointSteps(step.dt, E.T, A.T, np.hstack([C.T / step.dt, np.zeros((len(X), 1))]))
    return back.march(r[:0:-1], np.zeros(len(X)))[:0:-1] @ X.T


def _start(system: EnergySystem, rows: slice, r: Array, costate: Array, dt: float) -> Array:
    result = np.zeros(system.N)
    result[rows] = r[0] @ system.C[:, rows] + (system.E + dt / 2 * system.A)[rows, rows].T @ costate[0]
    return result


def _hand(system: EnergySystem, rows: slice, r: Array, costate: Array, dt: float) -> tuple[Array, Array]:
    """By the tables; the tissue feels the positions that the velocities lead to, the outputs those of the table."""
    n_s, k = system.n_s, rows.start
    E, A = system.E[rows, :k], system.A[rows, :k]
    by_x = r @ system.C[:, :k]
    by_x[1:] -= costate @ (E - dt / 2 * A)
    by_x[:-1] += costate @ (E + dt / 2 * A)
    table = r @ system.C_s
    by_q, by_v = by_x[:, :n_s] - table, by_x[:, n_s:].copy()
    # q_n = q_0 + dt sum_{j < n} (v_j + v_{j+1}) / 2: what comes after a velocity depends on it
    later = np.cumsum(by_q[::-1], axis=0)[::-1]
    by_v[:-1] += dt / 2 * later[1:]
    by_v[1:] += dt / 2 * later[1:]
    table[0] += later[0]
    return table, by_v


def sensitivities(
    system: EnergySystem, others: Sequence[EnergySystem], answer: ReducedTrajectory, *, driven: bool
) -> Array:
    """dy/dtheta of a run for steps of each constant, (others, steps + 1, p). Online; not collective.

        E s' = A s + (A_theta x + f_theta - E_theta x'),   dy/dtheta = C s

    Systems are affine in each constant, so that a derivative is the difference to the system at another value of it,
    times the step between the values. A start that is not zero is the equilibrium, which moves with the constants.

    Args:
        system: at which the run was made.
        others: the system at another value of one constant each.
        answer: the run.
        driven: whether the hand was prescribed.
    """
    k = 2 * system.n_s
    rows, tissue = slice(k if driven else 0, system.N), slice(k, system.N)
    x, dt = answer.x, float(answer.times[1])
    E, A, C = system.E[rows, rows], system.A[rows, rows], system.C[:, rows]
    step = MidpointSteps(dt, E, A, np.hstack([np.eye(len(E)), np.zeros((len(E), 1))]))
    middle, rate, moves = (x[1:] + x[:-1]) / 2, np.diff(x, axis=0) / dt, bool(x[0, tissue].any())
    result = np.empty((len(others), *answer.outputs.shape))
    for i, other in enumerate(others):
        slope_a, slope_e, slope_f = other.A - system.A, other.E - system.E, other.f - system.f
        start = np.zeros(system.N)
        if moves:  # A x_0 + f = 0 in the rows of the tissue
            start[tissue] = -np.linalg.solve(system.A[tissue, tissue], slope_a[tissue] @ x[0] + slope_f[tissue])
        loads = middle @ slope_a[rows].T + slope_f[rows] - rate @ slope_e[rows].T
        result[i] = step.march(loads, start[rows]) @ C.T
    return result
