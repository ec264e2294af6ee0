"""Derivatives of reduced runs against complex steps through the midpoint rule as it is written, in wide numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import softgrasp as sg
from softgrasp.reduction.galerkin import galerkin_equations
from softgrasp.reduction.gradient.reduced import sensitivities
from softgrasp.reduction.online import run
from softgrasp.reduction.system import ModelError

pytestmark = pytest.mark.serial
TINY = 1e-30  # complex steps have no cancellation
WIDE = np.clongdouble  # in 64 bits complex steps themselves have an error of 1e-9 on the block, by its rigid motions
# of the largest derivative of its kind: rounding of 60 to 600 steps at N = 14 and 36, at most 3e-13 measured (block)
EXACT = 1e-12
KEYS = ["time.steps=60", "effects.damping={kind='rayleigh', beta=0.004, alpha=0.1, drag='space'}"]
SCENES: dict[str, tuple[str, list[str], int, bool]] = {
    "driven": ("paper_forward", ["tissue.cells=[4, 8]", *KEYS], 14, True),
    "pushed": ("paper_forward", ["tissue.cells=[4, 8]", *KEYS, "effects.reaction=true", "hand.mass=20"], 14, False),
    "layers": ("layers_2d", ["time.steps=200"], 36, True),
    "block": ("block_3d", ["tissue.cells=[3,2,4]", "tissue.order=2", "time.steps=600"], 36, False),
}


def factored(A: Any) -> Any:
    """A function that solves A x = b by elimination with pivots, in the numbers of A (LAPACK has no wide ones)."""
    scale = np.abs(A).max(axis=1)
    A, order, n = A / scale[:, None], np.arange(len(A)), len(A)
    for k in range(n):
        i = k + np.abs(A[k:, k]).argmax()
        A[[k, i]], order[[k, i]] = A[[i, k]], order[[i, k]]
        A[k + 1 :, k] /= A[k, k]
        A[k + 1 :, k + 1 :] -= np.outer(A[k + 1 :, k], A[k, k + 1 :])

    def solve(b: Any) -> Any:
        x = (b / scale[:, None])[order]
        for k in range(n):
            x[k] -= A[k, :k] @ x[:k]
        for k in range(n - 1, -1, -1):
            x[k] = (x[k] - A[k, k + 1 :] @ x[k + 1 :]) / A[k, k]
        return x

    return solve


def plain(rom: Any, materials: Any, alpha: Any, dt: float, force: Any, hand: Any, x0: Any) -> Any:
    """Outputs by the rule, step by step, in complex arithmetic."""
    numbers = [{key: WIDE(getattr(m, key)) for key in ("lam", "mu", "rho", "beta")} for m in materials]
    materials = tuple(replace(m, **each) for m, each in zip(materials, numbers, strict=True))
    p = replace(rom.parameters(rom.materials), materials=materials, alpha=WIDE(alpha))
    parts = {key: part.astype(np.longdouble) for key, part in rom.parts.items()}
    E, A, f = galerkin_equations(parts, p)
    S_v, out, dt = parts["S_v"], rom.outputs, WIDE(dt)
    n_s, N = S_v.shape
    k = 0 if hand is None else 2 * n_s
    left, right = E - dt / 2 * A, E + dt / 2 * A
    solve = factored(left[k:, k:])
    steps = len(force) if hand is None else len(hand[0]) - 1
    x = np.zeros((steps + 1, N), dtype=WIDE)
    if isinstance(x0, str):
        j = 2 * n_s
        x[0, j:] = -factored(A[j:, j:])(f[j:, None])[:, 0]
    else:
        x[0] = x0
    if hand is not None:
        q, v = (table.astype(WIDE) for table in hand)
        at = np.concatenate([q[:1], q[0] + dt * np.cumsum((v[1:] + v[:-1]) / 2, axis=0)])
        x[:, :k] = np.hstack([at, v])
    P, Q = solve(right[k:]), solve(dt * S_v.T if hand is None else -left[k:, :k])
    loads = (force if hand is None else x[1:, :k]) @ Q.T + solve(dt * f[k:, None])[:, 0]
    for n in range(steps):
        x[n + 1, k:] = P @ x[n] + loads[n]
    outputs = x @ (out.C_z + out.C_s @ parts["S_q"]).T
    return outputs if hand is None else outputs + (q - x[:, :n_s]) @ out.C_s.T


@pytest.fixture(params=SCENES)
def case(request: pytest.FixtureRequest) -> tuple[Any, dict[str, Any]]:
    """A reduced model and the arguments of a run."""
    scene, changes, N, driven = SCENES[request.param]
    model = sg.build(scene, changes)
    run = sg.simulate(model)
    rom = sg.reduce(model, run, "craig_bampton", N=N)
    rng = np.random.default_rng(3)
    x0 = 1e-2 * rng.standard_normal(N)
    arguments: dict[str, Any] = {"dt": run.times[1], "force": None, "hand": None, "x0": x0, "y": 0.9 * run.outputs}
    if driven:
        arguments["hand"] = (run.q_s, run.v_s)
        x0[: 2 * run.q_s.shape[1]] = 0
    else:
        arguments["force"] = run.force + rng.standard_normal(run.force.shape)
    return rom, arguments


def test_gradients_are_those_of_complex_steps(case: tuple[Any, dict[str, Any]]) -> None:
    rom, arguments = case
    y = arguments.pop("y")
    if len(y) > 600 and np.finfo(WIDE).eps > 1e-18:
        pytest.skip("long double is a plain double here")
    found = sg.gradient(rom, lambda outputs: (((outputs - y) ** 2).sum() / 2, outputs - y), **arguments)
    exact = plain(rom, rom.materials, rom.alpha, **arguments).real
    r = exact - y
    assert found.value == pytest.approx(float((r**2).sum() / 2), rel=EXACT)

    def slope(materials: Any = rom.materials, alpha: Any = rom.alpha, **changes: Any) -> float:
        return float((plain(rom, materials, alpha, **{**arguments, **changes}).imag * r).sum() / TINY)

    for key in ("lam", "mu", "rho", *(("beta",) if rom.damped else ())):
        exact = [
            slope((*rom.materials[:i], replace(m, **{key: getattr(m, key) + 1j * TINY}), *rom.materials[i + 1 :]))
            for i, m in enumerate(rom.materials)
        ]
        np.testing.assert_allclose(getattr(found, key), exact, rtol=0, atol=EXACT * np.abs(exact).max(), err_msg=key)
    if rom.damped:
        assert found.alpha == pytest.approx(slope(alpha=rom.alpha + 1j * TINY), rel=EXACT)
    for i in (0, len(found.start) - 1):
        bump = np.zeros(len(found.start), dtype=complex)
        bump[i] = 1j * TINY
        if arguments["hand"] is None or i:
            exact = slope(x0=arguments["x0"] + bump)
            assert abs(found.start[i] - exact) <= EXACT * np.abs(found.start).max()
    tables = arguments["hand"] or (arguments["force"],)
    slopes = found.hand or (found.force,)
    for part, table in enumerate(tables):
        for n in (0, 7, len(table) - 1):
            bump = table.astype(complex)
            bump[n, 1] += 1j * TINY
            changed = {"force": bump} if arguments["hand"] is None else {
                "hand": tuple(bump if j == part else t.astype(complex) for j, t in enumerate(tables))
            }  # fmt: skip
            assert abs(slopes[part][n, 1] - slope(**changed)) <= EXACT * np.abs(slopes[part]).max(), (part, n)


@pytest.mark.parametrize("drive", ["motion", "force"])
def test_a_start_in_equilibrium_moves_with_the_material(drive: str) -> None:
    keys = [
        "tissue.cells=[4, 8]",
        "effects.gravity={g=[1.0, -9.0]}",
        f"motion.drive='{drive}'",
        "time.start='equilibrium'",
    ]
    model = sg.build("paper_forward", [*KEYS, *keys, f"effects.reaction={str(drive == 'force').lower()}"])
    run = sg.simulate(model)
    rom = sg.reduce(model, run, "craig_bampton", N=14)
    given: dict[str, Any] = {"dt": run.times[1], "force": None, "hand": None, "x0": "equilibrium"}
    given |= {"hand": (run.q_s, run.v_s)} if drive == "motion" else {"force": run.force}
    found = sg.gradient(rom, lambda y: ((y**2).sum() / 2, y), **given)
    still = sg.gradient(rom, lambda y: ((y**2).sum() / 2, y), **given | {"x0": rom.at().equilibrium()})
    assert found.value == still.value
    for key in ("lam", "mu", "rho", "beta"):
        m = replace(rom.materials[0], **{key: getattr(rom.materials[0], key) + 1j * TINY})
        exact = (plain(rom, (m,), rom.alpha, **given).imag * found.run.outputs).sum() / TINY
        assert getattr(found, key)[0] == pytest.approx(float(exact), rel=EXACT), key
    assert abs(found.mu / still.mu - 1) > 1e-3  # a start that stays has another one
    np.testing.assert_array_equal(found.beta, still.beta)
    with pytest.raises(ModelError, match="x0 = 'rest': the initial state must be an array"):
        sg.gradient(rom, lambda y: (0.0, y), **given | {"x0": "rest"})


def test_what_does_not_fit_is_refused(case: tuple[Any, dict[str, Any]]) -> None:
    rom, arguments = case
    given = {key: value for key, value in arguments.items() if key != "y"}
    with pytest.raises(ModelError, match=r"dJ/dy has the shape \(2,\)"):
        sg.gradient(rom, lambda y: (0.0, np.zeros(2)), **given)
    with pytest.raises(ModelError, match="give either the force"):
        sg.gradient(rom, lambda y: (0.0, y), given["dt"])


def test_sensitivities_are_the_gradients_of_the_adjoint(case: tuple[Any, dict[str, Any]]) -> None:
    rom, arguments = case
    given = {key: arguments[key] for key in ("dt", "force", "hand")}
    system, driven = rom.at(), given["force"] is None
    answer = run(system, **given)
    weight = np.random.default_rng(1).standard_normal(answer.outputs.shape)
    found = sg.gradient(rom, lambda y: ((weight * y).sum(), weight), **given)
    m = rom.materials[-1]
    keys = ("lam", "mu", "rho")
    others = [rom.at((*rom.materials[:-1], replace(m, **{key: 2 * getattr(m, key)}))) for key in keys]
    slopes = sensitivities(system, others, answer, driven=driven)
    for key, slope in zip(keys, slopes, strict=True):
        exact = getattr(m, key) * getattr(found, key)[-1]
        assert (weight * slope).sum() == pytest.approx(exact, rel=1e-10)  # rounding: two ways, 5e-12 (block, 600 steps)


def test_sensitivities_follow_the_equilibrium_that_a_run_starts_in() -> None:
    model = sg.build("layers_2d", ["time.steps=40"])
    rom = sg.reduce(model, sg.simulate(model), "craig_bampton", N=20)
    still = np.zeros((41, 2)), np.zeros((41, 2))

    def at(share: float) -> tuple[Any, Any]:
        system = rom.at(tuple(replace(m, mu=share * m.mu) for m in rom.materials))
        return system, run(system, 0.025, hand=still, x0=system.equilibrium())

    (system, answer), (other, _) = at(1.0), at(2.0)
    (slope,) = sensitivities(system, [other], answer, driven=True)
    difference = (at(1 + 1e-4)[1].outputs - at(1 - 1e-4)[1].outputs) / 2e-4
    assert np.abs(slope - difference).max() < 1e-6 * np.abs(slope).max()  # 1e-8 of the step's square, and rounding
    assert np.abs(slope).min(axis=0).max() > 0  # it sags from the start
