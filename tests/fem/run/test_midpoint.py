"""The time loop against dense linear algebra: the paper's first-order system, exact solutions, conservation laws."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI
from numpy.typing import NDArray

from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import PETSc
from softgrasp.fem.run.midpoint import TissueMidpoint, state_on
from softgrasp.fem.run.motion import force_values, motion_table
from softgrasp.fem.run.simulate import simulate
from tests.helpers.models import (
    CUBE,
    LAYERS,
    FirstOrder,
    absolute,
    at_rest,
    close,
    first_order,
    gather_matrix,
    gather_rows,
    gather_states,
    held_by_paper,
    held_on_top,
    local_rows,
    make_scene,
    reference,
    run_from,
    same_everywhere,
    wave,
)

pytestmark = pytest.mark.ranks

Array = NDArray[np.float64]
# 60 solves with a matrix of condition 1e4, each good to 1e-12: the two runs may part by 1e-10
SAME_RUN = 1e-10
TINY = {"tissue": {"cells": [2, 4]}}
RAYLEIGH = {"damping": {"kind": "rayleigh", "alpha": 0.4, "beta": 0.01}}
DRAGGED = {"damping": {"kind": "rayleigh", "alpha": 0.4, "beta": 0.01, "drag": "space"}}
VISCOUS = {"damping": {"kind": "kelvin-voigt", "beta": 0.01}}
GRAVITY = {"gravity": {"g": [1.0, -9.0], "hand_weight": True}}
LAYERED = {"tissue": {"layers": LAYERS, "thickness": 0.5}}
CASES: dict[str, list[dict[str, Any]]] = {
    "bare": [],
    "viscous": [{"effects": VISCOUS}],
    "rayleigh": [{"effects": RAYLEIGH}],
    "dragged": [{"effects": DRAGGED}],
    "gravity": [{"effects": GRAVITY}],
    "equilibrium": [{"effects": GRAVITY | RAYLEIGH, "time": {"start": "equilibrium"}}],
    "layers": [LAYERED, {"effects": RAYLEIGH | GRAVITY}],
    "layers-dragged": [LAYERED, {"effects": DRAGGED | GRAVITY}],
    "p2": [TINY, {"tissue": {"order": 2}, "effects": VISCOUS}],
}


def states(model: Model, run: Any) -> Array:
    kept = run.snapshots
    return absolute(model, kept.q_s, kept.v_s, kept.Z)


def parts(full: FirstOrder, X: Array) -> tuple[Array, ...]:
    """Hand and tissue, positions and velocities: scales differ."""
    n = len(X) // 2
    return X[: full.n_s], X[full.n_s : n], X[n : n + full.n_s], X[n + full.n_s :]


def midpoints(model: Model) -> Array:
    scene = model.scene
    return (np.arange(scene.time.steps) + 0.5) * scene.time_end / scene.time.steps


def monolithic(model: Model, held: Any = held_by_paper) -> tuple[FirstOrder, Array]:
    full, n_s = first_order(reference(model, held)), model.system.layout.n_s
    loads = np.array([wave(0, t, np.zeros(n_s), np.zeros(n_s)) for t in midpoints(model)])
    return full, full.run(at_rest(model), model.scene.time_end / model.scene.time.steps, loads)


@pytest.mark.ranks(reaction=True, rotation=True, name=("bare", "equilibrium", "layers-dragged", "p2"))
@pytest.mark.parametrize("rotation", [False, True])
@pytest.mark.parametrize("reaction", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_run_equals_the_first_order_system(comm: MPI.Intracomm, name: str, reaction: bool, rotation: bool) -> None:
    model = build(make_scene(*CASES[name], {"effects": {"reaction": reaction, "rotation": rotation}}), comm=comm)
    run = simulate(model, force=wave)
    full, X = monolithic(model)
    assert same_everywhere(comm, np.hstack([run.q_s, run.v_s, run.outputs @ np.eye(2, run.q_s.shape[1])]))
    for mine, theirs in zip(parts(full, states(model, run)), parts(full, X), strict=True):
        assert close(mine, theirs) < SAME_RUN
    assert run.energy_drift < 1e-12  # sixty steps of rounding


@pytest.mark.parametrize("reaction", [False, True])
def test_run_in_3d_equals_the_first_order_system(comm: MPI.Intracomm, reaction: bool) -> None:
    effects = {"reaction": reaction, "rotation": True, "gravity": {"g": [0.5, 0.2, -9.0]}} | RAYLEIGH
    scene = make_scene(CUBE, hand={"inertia": [1.0, 2.0, 3.0]}, effects=effects, time={"start": "equilibrium"})
    model = build(scene, comm=comm)
    run = simulate(model, force=wave)
    full, X = monolithic(model, held_on_top)
    for mine, theirs in zip(parts(full, states(model, run)), parts(full, X), strict=True):
        assert close(mine, theirs) < SAME_RUN


@pytest.mark.parametrize("reaction", [False, True])
def test_force_profile_of_the_scene(comm: MPI.Intracomm, reaction: bool) -> None:
    effects = GRAVITY | RAYLEIGH | {"reaction": reaction}
    model = build(make_scene(motion={"drive": "force"}, effects=effects), comm=comm)
    run = simulate(model)
    full = first_order(reference(model))
    u = force_values(model.scene, 2, model.system.M_hand)
    X = full.run(at_rest(model), 3.0 / 60, u)
    for mine, theirs in zip(parts(full, states(model, run)), parts(full, X), strict=True):
        assert close(mine, theirs) < SAME_RUN


@pytest.mark.parametrize("damping", [VISCOUS, DRAGGED])
def test_prescribed_motion_deforms_the_tissue_as_its_mean_force_does(
    comm: MPI.Intracomm, damping: dict[str, Any]
) -> None:
    """The hand follows the profile itself; the tissue sees the mean acceleration of each step."""
    model = build(make_scene(effects=damping), comm=comm)
    run = simulate(model)
    ref = reference(model)
    full, table = first_order(ref), motion_table(model.scene, 2)
    X = full.run(at_rest(model), 3.0 / 60, table.a @ ref.M_hand.T)
    q_s, q_e, v_s, v_e = parts(full, X)
    np.testing.assert_array_equal(run.q_s, table.q)
    z, v_z = np.split(gather_states(model.system.layout, run.snapshots.Z), 2)
    assert close(z, q_e - ref.T @ q_s) < SAME_RUN
    assert close(v_z, v_e - ref.T @ v_s) < SAME_RUN


@pytest.mark.serial
@pytest.mark.parametrize("reaction", [False, True])
def test_run_equals_petsc_theta(comm: MPI.Intracomm, reaction: bool) -> None:
    scene = make_scene(TINY, effects=RAYLEIGH | {"reaction": reaction}, time={"steps": 40})
    model = build(scene, comm=comm)
    run = simulate(model, force=wave)
    full, dt, n = first_order(reference(model)), 3.0 / 40, 2 * (model.system.layout.n_s + model.system.layout.n_e)
    zero = np.zeros(full.n_s)

    def residual(ts: Any, t: float, x: Any, dx: Any, r: Any) -> None:
        r.array[:] = full.E @ dx.array_r - full.A @ x.array_r - full.B @ wave(0, t, zero, zero)

    def jacobian(ts: Any, t: float, x: Any, dx: Any, shift: float, J: Any, P: Any) -> None:
        P.setValues(range(n), range(n), shift * full.E - full.A)
        P.assemble()

    x, J = PETSc.Vec().createSeq(n), PETSc.Mat().createDense((n, n), comm=PETSc.COMM_SELF)
    J.setUp()
    ts = PETSc.TS().create(PETSc.COMM_SELF)
    ts.setType("theta")
    ts.setTheta(0.5)
    ts.setThetaEndpoint(False)
    ts.setIFunction(residual, x.duplicate())
    ts.setIJacobian(jacobian, J)
    ts.setTimeStep(dt)
    ts.setMaxSteps(40)
    ts.setMaxTime(1e9)
    ts.setExactFinalTime(PETSc.TS.ExactFinalTime.STEPOVER)
    ts.getSNES().setType("ksponly")
    ts.getSNES().getKSP().setType("preonly")
    ts.getSNES().getKSP().getPC().setType("lu")
    ts.solve(x)
    assert ts.getStepNumber() == 40
    mine = states(model, run)[:, -1:]
    for a, b in zip(parts(full, mine), parts(full, x.array_r[:, None]), strict=True):
        assert close(a, b) < SAME_RUN


def exact(full: FirstOrder, powers: Array, t: float) -> Array:
    """x(t) from x(0) = 0 under u = sum_k powers[k] t^k, by the exponential of one larger matrix."""
    n, m = len(full.A), len(powers)
    big = np.zeros((n + m, n + m))
    big[:n, :n] = scipy.linalg.solve(full.E, full.A)
    big[:n, n:] = scipy.linalg.solve(full.E, full.B) @ powers.T
    big[n:, n:] = np.diag(np.arange(1.0, m), -1)  # (t^k)' = k t^(k-1)
    return scipy.linalg.expm(t * big)[:n, n]


@pytest.mark.serial
@pytest.mark.parametrize("damping", [{}, RAYLEIGH])
def test_order_two_under_a_moving_hand(comm: MPI.Intracomm, damping: dict[str, Any]) -> None:
    """The quintic is a polynomial, so the exact deformation at the end of the motion is one matrix exponential."""
    steps, errors = [160, 320, 640, 1280], []
    for n in steps:
        model = build(make_scene(TINY, effects=damping, time={"steps": n}, motion={"duration": 1.5}), comm=comm)
        run = simulate(model)
        if n == steps[0]:
            ref = reference(model)
            d, target = 1.5, np.array([5.0, 3.0])
            rates = np.array([0, 60 / d**3, -180 / d**4, 120 / d**5])
            x = exact(first_order(ref), np.outer(rates, ref.M_hand @ target), d)
            q_s, q_e, _, _ = parts(first_order(ref), x)
            np.testing.assert_allclose(q_s, target, rtol=1e-10)  # the exponential itself
        z = gather_states(model.system.layout, run.final[:, None])[: model.system.layout.n_e, 0]
        errors.append(np.linalg.norm(z - (q_e - ref.T @ q_s)))
    order = -np.polyfit(np.log(steps[1:]), np.log(errors[1:]), 1)[0]
    assert abs(order - 2) < 0.05, f"order {order:.3f}, errors {errors}"  # the bound the issue asks for


@pytest.mark.serial
@pytest.mark.parametrize("damping", [{}, VISCOUS, RAYLEIGH])
def test_order_two_of_free_vibration(comm: MPI.Intracomm, damping: dict[str, Any]) -> None:
    """Four lowest modes let go: z = sum c_i Re(exp(p_i t) ...) exactly, mode by mode."""
    end, steps, errors = 1.0, [80, 160, 320, 640], []
    for n in steps:
        scene = make_scene(
            TINY, effects=damping, motion={"profile": "hold", "target": None}, time={"steps": n, "end": end}
        )
        model = build(scene, comm=comm)
        layout = model.system.layout
        K, M = (gather_matrix(layout, A).toarray() for A in (model.system.K_ee, model.system.M_ee))
        squares, modes = scipy.linalg.eigh(K, M, subset_by_index=(0, 3))
        amplitudes = np.array([1.0, -0.5, 0.3, 0.2])
        run = run_from(model, modes @ amplitudes, np.zeros(layout.n_e))
        d = model.scene.effects.damping
        half = 0.0 if d is None else (d.alpha + d.beta * squares) / 2
        omega = np.sqrt(squares - half**2)
        now = amplitudes * np.exp(-half * end) * (np.cos(omega * end) + half / omega * np.sin(omega * end))
        z = gather_rows(layout, run.state.array[: layout.n_local])
        errors.append(np.linalg.norm(z - modes @ now))
    order = -np.polyfit(np.log(steps[1:]), np.log(errors[1:]), 1)[0]
    assert abs(order - 2) < 0.05, f"order {order:.3f}, errors {errors}"  # the bound the issue asks for


def test_midpoint_is_not_the_trapezoid_rule(comm: MPI.Intracomm) -> None:
    """Both are the same for constant loads; on a changing one only the midpoint value reproduces the run."""
    model = build(make_scene(time={"steps": 20}), comm=comm)
    full, X = monolithic(model)
    t, zero = np.linspace(0, 3, 21), np.zeros(2)
    ends = np.array([wave(0, s, zero, zero) for s in t])
    Y = full.run(at_rest(model), 3.0 / 20, (ends[1:] + ends[:-1]) / 2)
    mine = states(model, simulate(model, force=wave))
    assert close(mine, X) < SAME_RUN
    assert close(mine, Y) > 1e-3  # dt^2 / 8 times the second derivative of the load, of order one


def random_state(n: int, seed: int = 3) -> tuple[Array, Array]:
    z, v = np.random.default_rng(seed).standard_normal((2, n))
    return 0.1 * z, v


def test_time_reversal_returns_to_the_start(comm: MPI.Intracomm) -> None:
    """N steps, velocities turned, the loads in reverse order, N steps: back at the start."""
    model = build(make_scene(effects=GRAVITY), comm=comm)
    system, layout = model.system, model.system.layout
    loads = np.random.default_rng(1).standard_normal((200, 2))
    z, v = random_state(layout.n_e)
    midpoint = TissueMidpoint(system, 0.02, "cholesky")
    state = state_on(np.concatenate([local_rows(layout, z), local_rows(layout, v)]), system)
    for order in (loads, loads[::-1]):
        midpoint.start(state)
        for a in order:
            midpoint.solve_midpoint(a)
            midpoint.advance(state, state)
        state.v.scale(-1.0)
    back = gather_states(layout, state.array)
    midpoint.destroy()
    assert close(back[: layout.n_e], z) < 1e-10  # 400 solves
    assert close(back[layout.n_e :], v) < 1e-10  # as above


def true_energy(model: Model, local: Array) -> Array:
    """(v' M v + z' K z) / 2 of each column, from gathered matrices."""
    layout = model.system.layout
    z, v = np.split(gather_states(layout, local), 2)
    K, M = (gather_matrix(layout, A) for A in (model.system.K_ee, model.system.M_ee))
    return ((z * (K @ z)).sum(axis=0) + (v * (M @ v)).sum(axis=0)) / 2


def long_steps(comm: MPI.Intracomm) -> int:
    return 100_000 if comm.size == 1 else 5_000


def test_energy_of_free_vibration_does_not_drift(comm: MPI.Intracomm) -> None:
    model = build(make_scene(TINY), comm=comm)
    layout = model.system.layout
    z, v = random_state(layout.n_e)
    midpoint = TissueMidpoint(model.system, 0.01, "cholesky")
    state = state_on(np.concatenate([local_rows(layout, z), local_rows(layout, v)]), model.system)
    before = true_energy(model, state.array[:, None])[0]
    midpoint.start(state)
    assert abs(midpoint.energy(state) - before) < 1e-13 * before  # the same sums in another order
    for _ in range(long_steps(comm)):
        midpoint.solve_midpoint(np.zeros(2))
        midpoint.advance(state, state)
    after = true_energy(model, state.array[:, None])[0]
    carried = midpoint.energy(state)
    midpoint.destroy()
    assert abs(after - before) < 1e-12 * before  # the bound the issue asks for
    assert abs(carried - before) < 1e-12 * before  # the same bound


def test_energy_under_gravity_does_not_drift(comm: MPI.Intracomm) -> None:
    """Let go at rest, elastic plus kinetic energy is the work of gravity z' G g at every step."""
    steps = long_steps(comm)
    scene = make_scene(
        TINY,
        effects={"gravity": {"g": [0.0, -9.0]}},
        motion={"profile": "hold", "target": None},
        time={"steps": steps, "end": 0.01 * steps},
        output={"every": steps // 50},
    )
    model = build(scene, comm=comm)
    run = simulate(model)
    load = gather_rows(model.system.layout, model.system.G) @ [0.0, -9.0]
    z = gather_states(model.system.layout, run.snapshots.Z)[: model.system.layout.n_e]
    energy = true_energy(model, run.snapshots.Z)
    assert np.abs(energy - load @ z).max() < 1e-12 * energy.max()  # the bound the issue asks for
    assert run.energy_drift < 1e-12  # the same bound


def pulse(n: int, t: float, q: Array, v: Array) -> Array:
    """Force during the first second only."""
    return wave(n, t, q, v) if t < 1.0 else np.zeros_like(q)


@pytest.mark.ranks(force=pulse, changes=([LAYERED, {"effects": VISCOUS}], [CUBE]))
@pytest.mark.parametrize(
    "changes",
    [[], [{"effects": VISCOUS}], [{"effects": RAYLEIGH}], [LAYERED, {"effects": VISCOUS}], [CUBE]],
    ids=["undamped", "viscous", "rayleigh", "layers", "3d"],
)
@pytest.mark.parametrize("force", [pulse, lambda n, t, q, v: np.zeros_like(q)], ids=["pulse", "free"])
def test_total_momentum_changes_by_the_impulse(
    comm: MPI.Intracomm, changes: list[dict[str, Any]], force: Callable[..., Array]
) -> None:
    """Hand and tissue together, linear and (linearised) angular, from the velocities of all nodes."""
    model = build(make_scene(*changes, effects={"reaction": True, "rotation": True}), comm=comm)
    layout, n_s = model.system.layout, model.system.layout.n_s
    ref = reference(model, held_on_top if layout.dimension == 3 else held_by_paper)
    z, v = random_state(layout.n_e)
    v_s = np.linspace(-1, 2, n_s)
    run = run_from(model, z, v, v_s, force)
    zero = np.zeros(n_s)
    impulse = sum(force(0, t, zero, zero) for t in midpoints(model)) * run.dt

    def momentum(v_s: Array, v_z: Array) -> Array:
        nodes = ref.P @ np.concatenate([v_s, v_z + ref.T @ v_s])
        return ref.M_hand @ v_s + ref.R.T @ ref.M @ nodes

    before = momentum(v_s, v)
    after = momentum(run.drive.v[-1], gather_rows(layout, run.state.array[layout.n_local :]))
    assert np.abs(run.drive.v[-1] - v_s).max() > 1e-3  # hand and tissue do exchange momentum
    # 60 steps, each with a rounding error of eps times the tissue's forces dt K z, about 1e3 of the momentum here
    assert np.abs(after - before - impulse).max() < 1e-11 * np.abs(before).max()
