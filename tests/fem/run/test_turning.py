"""Runs in the frame of a hand that turns by any angle: against space, against analysis, and what they conserve."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from mpi4py import MPI

import softgrasp as sg
from softgrasp.fem.errors import Paused, SceneError
from softgrasp.fem.frame.balance import HandBalance, HandPlace, no_travel, still
from softgrasp.fem.frame.rotation import Pose, cross_matrix, rotation_matrix, spatial
from softgrasp.fem.petsc import Array, to_scipy, total
from softgrasp.fem.run.motion import quintic
from softgrasp.fem.run.simulate import Run, RunOptions, simulate
from softgrasp.fem.solve.stiffness import static_columns
from softgrasp.fem.strain.body import HyperelasticBody

TURN: dict[str, Any] = {"rotation": True, "frame": "hand"}
STVK: dict[str, Any] = {"finite_strain": {"law": "stvk", "tol": 1e-11}}


def plate(comm: MPI.Intracomm, effects: dict[str, Any], steps: int, **keys: Any) -> sg.Model:
    """A plate of the paper's shape, turned by half a turn about the contact zone in 1 s."""
    young = keys.pop("young", 3e3)
    tissue = {"cells": [2, 4], "material": {"lambda": young / 1.7, "mu": young / 2.6, "rho": 1.0}}
    motion = keys.pop("motion", {"target": [0.2, 0.1, np.pi], "duration": 1.0})
    return sg.build(
        "paper_forward", comm=comm, tissue=tissue, hand={"mass": 3.0, "inertia": 1.5}, effects=effects,
        motion=motion, time={"steps": steps, "end": keys.pop("end", 1.0)}, **keys,
    )  # fmt: skip


def block(comm: MPI.Intracomm, effects: dict[str, Any], steps: int, **keys: Any) -> sg.Model:
    """A small block in space that a force moves."""
    return sg.build(
        "block_3d", comm=comm, tissue={"cells": [2, 2, 3], "order": 1, "refine": False},
        hand={"mass": 0.2, "inertia": [2e-4, 3e-4, 1e-4]}, effects=effects | {"gravity": False, "damping": False},
        motion={"profile": "hold", "target": False, "drive": "force"}, output={"snapshots": "memory"},
        time={"steps": steps, "end": keys.pop("end", 0.5), "start": "rest"}, **keys,
    )  # fmt: skip


def pulse(load: list[float], end: float) -> Any:
    """A smooth push that ends before the run."""
    return lambda n, t, q, v: np.array(load) * np.sin(np.pi * t / end) ** 2 * (t < end)


def in_space(model: sg.Model, end: float) -> Array:
    """The z of the body in the axes of space, by a Runge-Kutta method of order 8: no frame, and F of the whole turn."""
    system = model.system
    points, moments = system.points, system.frame.moments(system.materials)  # type: ignore[union-attr]
    assert points is not None
    moduli = points.moduli(system.materials)
    B, M = to_scipy(points.B), scipy.linalg.cho_factor(to_scipy(system.M_ee).toarray())
    d, k, target = system.layout.dimension, B.shape[1], np.array(model.scene.motion.target)
    axis = spatial(target)[3:]
    W = cross_matrix(axis)[:d, :d]

    def rate(t: float, x: Array) -> Array:
        s, ds, dds = (float(v) for v in quintic(np.array(t), 1.0))
        Q = rotation_matrix(axis * s)[:d, :d]
        second = (W * dds + W @ W * ds**2) @ Q  # Q''
        H = (Q - np.eye(d))[:, :, None] + (B @ x[:k]).reshape(d, d, -1)
        force = B.T @ (points.laws.stress(H, *moduli) * points.vol).ravel()
        load = system.G[:, :d] @ target[:d] * dds + moments @ second.ravel()
        return np.concatenate([x[k:], scipy.linalg.cho_solve(M, -force - load)])

    done = scipy.integrate.solve_ivp(rate, (0, end), np.zeros(2 * k), method="DOP853", rtol=1e-9, atol=1e-11)
    Q = rotation_matrix(axis * float(quintic(np.array(end), 1.0)[0]))[:d, :d]
    return np.asarray(done.y[:k, -1].reshape(-1, d) @ Q)  # back into the axes of the hand


@pytest.mark.serial
def test_half_a_turn_against_finite_strain_in_space(comm: MPI.Intracomm) -> None:
    """Of order 2 at finite strain; the linear law is off by a few times the strain, below 1 % in a stiff plate."""
    end, errors = 0.7, []
    exact = in_space(plate(comm, TURN | STVK, 10), end)
    for steps in (140, 280, 560):
        run = sg.simulate(plate(comm, TURN | STVK, steps, end=end))
        errors.append(np.linalg.norm(run.final[: exact.size].reshape(-1, 2) - exact) / np.linalg.norm(exact))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(orders - 2) < 0.1), (errors, orders)
    changes = []
    for young in (1e5, 4e5):
        model = plate(comm, TURN | STVK, 400, young=young)
        finite = sg.simulate(model)
        linear = sg.simulate(plate(comm, TURN, 400, young=young))
        Z, other = (run.snapshots.Z[: exact.size] for run in (finite, linear))  # type: ignore[union-attr]
        assert model.system.points is not None
        strain = np.linalg.norm((to_scipy(model.system.points.B) @ Z).reshape(4, -1, Z.shape[1]), axis=0).max()
        changes.append(np.linalg.norm(Z - other) / np.linalg.norm(Z) / strain)
    assert max(changes) < 5  # of the strain: what linear elasticity leaves out, and nothing of the angle of pi
    assert strain < 1e-3


@pytest.mark.serial
def test_a_stiff_plate_at_finite_strain_is_that_of_space_to_a_thousandth(comm: MPI.Intracomm) -> None:
    """Half a turn in 1 s with strains below 1 %; the linear law differs by twice the strain."""
    end, steps, young = 0.5, 700, 2e4
    model = plate(comm, TURN | STVK, steps, end=end, young=young)
    exact, runs = (
        in_space(model, end),
        [sg.simulate(model), sg.simulate(plate(comm, TURN, steps, end=end, young=young))],
    )
    finite, linear = (
        np.linalg.norm(run.final[: exact.size].reshape(-1, 2) - exact) / np.linalg.norm(exact) for run in runs
    )
    assert model.system.points is not None
    Z = runs[0].snapshots.Z[: exact.size]  # type: ignore[union-attr]
    strain = np.linalg.norm((to_scipy(model.system.points.B) @ Z).reshape(4, -1, Z.shape[1]), axis=0).max()
    assert 5e-3 < strain < 1e-2
    assert finite < 1e-3  # what issue 32 asks for
    assert linear < 3 * strain


@pytest.mark.serial
def test_half_a_turn_in_space_about_a_slanted_axis(comm: MPI.Intracomm) -> None:
    half = float(np.pi / np.sqrt(2))
    keys: dict[str, Any] = {
        "tissue": {"cells": [1, 1, 2], "order": 1, "refine": False, "material": "muscle"},
        "effects": TURN | STVK | {"gravity": False, "damping": False, "reaction": False},
        "motion": {"target": [0.02, 0.01, 0.02, half, 0.0, half], "duration": 1.0},
    }
    errors, exact = [], np.zeros(0)
    for steps in (300, 600, 1200):
        model = sg.build("block_3d", comm=comm, **keys, time={"steps": steps, "end": 0.6, "start": "rest"})
        exact = exact if exact.size else in_space(model, 0.6)
        z = sg.simulate(model).final[: exact.size].reshape(-1, 3)
        errors.append(np.linalg.norm(z - exact) / np.linalg.norm(exact))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(orders - 2) < 0.1), (errors, orders)


@pytest.mark.serial
def test_free_flight_keeps_energy_and_both_momenta(comm: MPI.Intracomm) -> None:
    """From the states alone, by sums over the nodes in space: all three are kept to what the iteration leaves."""
    two_way = TURN | {"reaction": True}
    cases = (
        (plate(comm, two_way | {"finite_strain": {"tol": 1e-12}}, 200, end=1.0), [10.0, 4.0, 20.0]),
        (block(comm, two_way, 200), [0.8, 0.4, -0.3, 0.016, 0.012, 0.03]),
    )
    for model, load in cases:
        end = model.scene.time_end
        run = sg.simulate(model, force=pulse(load, end / 4))
        kept = np.array([energy_and_momenta(model, run, k) for k in range(60, 201, 20)])
        d = model.system.layout.dimension
        for part in (slice(0, 1), slice(1, 1 + d), slice(1 + d, None)):
            drift = np.abs(kept[:, part] - kept[0, part]).max() / np.abs(kept[:, part]).max()
            assert drift < 1e-11, (part, drift)  # iterated to 1e-12 of the loads
        assert np.abs(run.q_s[-1, d:]).max() > 0.2  # it turns
        assert run.energy_drift < 1e-10


def energy_and_momenta(model: sg.Model, run: sg.fem.Trajectory, k: int) -> Array:
    """Energy, linear momentum and angular momentum about the origin of space, of hand and tissue at a step."""
    system, d, n = model.system, model.system.layout.dimension, model.system.layout.n_local
    pose, v = Pose.of(run.q_s[k], d), run.v_s[k]
    X = system.layout.nodes - system.layout.reference
    z, e = np.split(run.snapshots.Z[:, k], 2)  # type: ignore[union-attr]
    z, e = z.reshape(-1, d), e.reshape(-1, d)
    local = np.concatenate([pose.Q.T @ v[:d], pose.Q.T @ v[d:] if d == 3 else v[d:]])

    def turned(w: Array, x: Array) -> Array:
        return np.cross(w, x) if d == 3 else w[0] * np.stack([-x[:, 1], x[:, 0]], axis=1)

    u = local[:d] + turned(local[d:], X + z) + e  # velocities in the axes of the hand
    M, M_es = to_scipy(system.M_ee), system.M_es
    M_ss = sum(m.rho * layer.M_1.ss for m, layer in zip(system.materials, system.layers, strict=True))
    momentum = (M @ u.ravel() + M_es @ local).reshape(-1, d)
    contact = M_es.T @ u.ravel() + (M_ss + system.M_hand) @ local
    kinetic = (u.ravel() @ momentum.ravel() + local @ contact) / 2
    if system.points is None:
        elastic = z.ravel() @ to_scipy(system.K_ee) @ z.ravel() / 2
    else:
        vector = system.K_ee.createVecRight()
        vector.array_w[:] = z.ravel()
        elastic = HyperelasticBody(system.points, system.materials).energy(vector)
    x = X + z
    lever = np.cross(x, momentum) if d == 3 else x[:, :1] * momentum[:, 1:] - x[:, 1:] * momentum[:, :1]
    P, L = momentum.sum(axis=0) + contact[:d], np.atleast_1d(lever.sum(axis=0)) + contact[d:]
    P, p = pose.Q @ P, pose.shift
    L = (pose.Q @ L if d == 3 else L) + (np.cross(p, P) if d == 3 else p[0] * P[1] - p[1] * P[0])
    assert n == z.size
    return np.concatenate([[kinetic + elastic], P, L])


@pytest.mark.serial
def test_a_bar_that_spins_stretches_as_it_should(comm: MPI.Intracomm, tmp_path: Path) -> None:
    """E u'' + rho w^2 (x + u) = 0, u(0) = 0, u'(L) = 0: u = sin(k x) / (k cos k L) - x with k^2 = rho w^2 / E."""
    w, rho, young, length, ramp = 2.0, 1.0, 100.0, 1.0, 1.0
    t = np.linspace(0, 6.0, 241)
    turned = np.where(t < ramp, ramp * quintic_integral(np.minimum(t / ramp, 1)), t - ramp / 2) * w
    np.savetxt(tmp_path / "spin.csv", np.column_stack([t, 0 * t, 0 * t, turned]), delimiter=",", fmt="%.17g")
    model = sg.build(
        "paper_forward", comm=comm, contact={"sides": ["left"], "box": False},
        hand={"inertia": 1.0, "reference": [0.0, 0.2]},
        tissue={"size": [length, 0.4], "cells": [10, 4], "order": 2,
                "material": {"lambda": 0.0, "mu": young / 2, "rho": rho}},
        effects=TURN | {"damping": {"kind": "rayleigh", "beta": 0.02, "alpha": 4.0}},
        motion={"profile": "csv", "csv": str(tmp_path / "spin.csv"), "target": False, "duration": 5.0},
        time={"steps": 400, "end": 5.0}, control={"outputs": [{"kind": "node", "point": [length, 0.2]}]},
    )  # fmt: skip
    run = sg.simulate(model)
    k = w * np.sqrt(rho / young)
    stretch = np.tan(k * length) / k - length
    turn = run.q_s[-1, 2]
    found = (run.outputs - run.outputs_rigid)[-1] @ [np.cos(turn), np.sin(turn)]
    assert found == pytest.approx(stretch, rel=2e-3)  # a bar is nearly a line
    plain = rho * w**2 * length**3 / (3 * young)
    assert abs(found - stretch) < 0.1 * abs(stretch - plain)  # the load of the stretched bar is seen


def quintic_integral(x: Array) -> Array:
    """Integral of 10 x^3 - 15 x^4 + 6 x^5."""
    return np.asarray(x**4 * (2.5 - 3 * x + x * x))


@pytest.mark.parametrize("law", ["", "neo-hooke"])
def test_gravity_turns_in_the_hand(comm: MPI.Intracomm, law: str) -> None:
    """Turned slowly by 90 degrees and held, the body hangs as under gravity from the side; in space too."""
    effects = TURN | {"gravity": [0.0, -2.0], "damping": {"kind": "kelvin-voigt", "beta": 0.05}, "reaction": True}
    effects |= {"finite_strain": {"law": law}} if law else {}
    model = plate(comm, effects, 200, end=5.0, motion={"target": [0.1, 0.0, np.pi / 2], "duration": 2.0})
    run, system = sg.simulate(model), model.system
    still = static_columns(system, np.asfortranarray(system.G @ [[-2.0], [0.0], [0.0]]))[:, 0]  # -y is the hand's -x
    n = system.layout.n_local
    parts = total(comm, np.array([np.sum((run.final[:n] - still) ** 2), still @ still]))
    assert np.sqrt(parts[0] / parts[1]) < (0.05 if law else 1e-4)  # strain of 1 %; what damping has left
    weight = 2.0 * (system.M_rigid[0, 0])
    assert run.force[-1][:2] == pytest.approx([0, weight], abs=1e-3 * weight)


@pytest.mark.parametrize("law", ["", "neo-hooke"])
def test_a_motion_may_begin_turned(comm: MPI.Intracomm, law: str, tmp_path: Path) -> None:
    """The equilibrium at the start is that under gravity as it acts in the axes of the hand: nothing moves."""
    t = np.linspace(0, 0.2, 5)
    np.savetxt(tmp_path / "held.csv", np.column_stack([t, 0 * t, 0 * t, 0 * t + 1.2]), delimiter=",")
    effects = TURN | {"gravity": [0.0, -2.0]} | ({"finite_strain": {"law": law}} if law else {})
    model = sg.build(
        "paper_forward", comm=comm, effects=effects, hand={"inertia": 1.5}, tissue={"cells": [2, 4]},
        motion={"profile": "csv", "csv": str(tmp_path / "held.csv"), "target": False, "duration": 0.2},
        time={"steps": 10, "end": 0.2, "start": "equilibrium"},
    )  # fmt: skip
    run = sg.simulate(model)
    sag = np.linalg.norm((run.outputs - run.outputs_rigid)[0])
    assert sag > 1e-4
    assert np.abs(run.outputs - run.outputs[0]).max() < 1e-9 * sag


@pytest.mark.serial
def test_a_fast_hand_changes_its_momentum_by_the_load() -> None:
    """A step may go as far as the body is large: P changes by the weight, to rounding, whatever the speed."""
    g, c, I_c = np.array([0.0, 0.0, -9.81]), np.array([0.01, -0.08, 0.05]), np.diag([2e-4, 3e-4, 1e-4])
    C, m, dt = cross_matrix(c), 0.5, 4e-3
    M = np.block([[m * np.eye(3), -m * C], [m * C, I_c - m * C @ C]])
    hand = HandPlace.of(np.array([0, 0, 0, 0.3, 2.0, -1.0]), np.array([30.0, -20, 5, 10, -60, 20]))
    load = np.array([5.0, -3, 2, 0.1, 0.2, -0.3])
    balance = HandBalance(M, M, g, list(range(6)), dt)
    after = hand.moved(balance.velocity(hand, still(), no_travel(), load, hand.xi), dt)
    before, behind = (place.Q @ (M @ place.xi)[:3] for place in (hand, after))
    assert behind - before == pytest.approx(dt * (load[:3] + m * g), abs=1e-13 * np.linalg.norm(before))


@pytest.mark.parametrize("solver", ["cholesky", "mumps"])
@pytest.mark.ranks
def test_any_number_of_ranks(comm: MPI.Intracomm, solver: str) -> None:
    keys = {
        "time": {"solver": solver, "reproducible": solver == "cholesky", "steps": 10, "end": 0.1 / 3, "start": "rest"}
    }
    runs = []
    for ranks in (comm, MPI.COMM_SELF):
        scene = block(ranks, TURN | {"reaction": True}, 30).scene
        model = sg.build(scene.changed(lambda table: table["time"].update(keys["time"])), comm=ranks)
        runs.append(sg.simulate(model, force=pulse([0.8, 0.4, -0.3, 0.016, 0.012, 0.03], 0.1)))
    scale = np.abs(runs[1].outputs).max()
    assert runs[0].outputs == pytest.approx(runs[1].outputs, abs=1e-9 * scale)  # each step is iterated to 1e-12
    assert runs[0].energy_drift < 1e-10


@pytest.mark.serial
def test_without_a_turn_it_is_the_run_of_small_angles(comm: MPI.Intracomm) -> None:
    keys: dict[str, Any] = {"motion": {"target": [0.2, 0.1, 0.0], "duration": 1.0}}
    small = sg.simulate(plate(comm, {"rotation": True}, 100, **keys))
    any_angle = sg.simulate(plate(comm, TURN, 100, **keys))
    assert any_angle.outputs == pytest.approx(small.outputs, abs=1e-13)  # rounding
    assert any_angle.force[:, :2] == pytest.approx(small.force[:, :2], abs=1e-9 * np.abs(small.force).max())


def test_force_and_path_are_two_sides_of_one_motion(comm: MPI.Intracomm) -> None:
    """The wrench found from the momenta of a run is the force that drove it, to second order."""
    errors = []
    for steps in (100, 200):
        model = block(comm, TURN | {"reaction": True}, steps, end=0.1)
        load = [0.8, 0.4, -0.3, 0.016, 0.012, 0.03]
        seen: list[Any] = []
        run = simulate(model, RunOptions(begin=seen.append), pulse(load, 0.1))
        live: Run = seen[0]
        whole = live.midpoint.operators.whole
        assert live.turning is not None
        found = live.turning.wrench(live.ledger.pulls if whole else total(comm, live.ledger.pulls))
        errors.append(np.abs((found - run.force) / load).max())
    assert errors[0] < 0.02
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.2)


def test_fields_are_those_of_space(comm: MPI.Intracomm) -> None:
    """The velocity of the nodes is the rate of their displacement, and the tip is where the output says."""
    model = plate(comm, TURN | {"finite_strain": {}}, 400)
    run = sg.simulate(model)
    n, Z = model.system.layout.n_local, run.snapshots.Z  # type: ignore[union-attr]
    before, at, after = (model.displacement(Z[:n, k], run.q_s[k]).x.array.copy() for k in (199, 200, 201))
    speed = model.velocity(Z[:n, 200], Z[n:, 200], run.q_s[200], run.v_s[200]).x.array
    here = np.abs(speed - (after - before) / (2 * run.times[1])).max(initial=0.0)
    largest = comm.allreduce(np.abs(speed).max(initial=0.0), MPI.MAX)
    assert comm.allreduce(here, MPI.MAX) < 1e-3 * largest  # of order 2 in the step
    (output,) = model.outputs
    tip = model.space.nodal(np.zeros(n))
    tip.x.array[:] = at
    values = tip.x.array.reshape(-1, 2)[model.space.free].ravel()[output.dofs]
    assert total(comm, values.sum(axis=0)) == pytest.approx(run.outputs[200], abs=1e-12)


@pytest.mark.serial
def test_a_free_hand_resumes_bit_by_bit(comm: MPI.Intracomm, tmp_path: Path) -> None:
    push = pulse([0.8, 0.4, -0.3, 0.016, 0.012, 0.03], 0.05)
    effects = TURN | {"reaction": True, "finite_strain": {}}
    whole = sg.simulate(block(comm, effects, 20, end=0.1), force=push)
    with pytest.raises(Paused):
        simulate(block(comm, effects, 20, end=0.1), RunOptions(tmp_path, until=11), push)
    again = simulate(block(comm, effects, 20, end=0.1), RunOptions(tmp_path, resume=True), push)
    assert np.array_equal(again.final, whole.final)
    assert np.array_equal(again.q_s, whole.q_s)


def test_what_the_frame_cannot_do_is_refused(comm: MPI.Intracomm) -> None:
    for effects, text in (
        ({"frame": "hand"}, "rotation is off"),
        (TURN | {"damping": {"kind": "rayleigh", "beta": 0.0, "alpha": 1.0, "drag": "space"}}, "drag = 'space'"),
    ):
        with pytest.raises(SceneError, match=text):
            plate(comm, effects, 10)
    model = plate(comm, TURN, 4)
    with pytest.raises(SceneError, match=r"turns by .* rad in step 2, at most 0.5"):
        sg.simulate(model)
    with pytest.raises(SceneError, match=r"control cannot go with effects\.frame"):
        sg.problem(model)
    with pytest.raises(SceneError, match=r"effects\.frame=false --set effects\.finite_strain=false for small angles"):
        sg.problem(plate(comm, TURN | STVK, 100))
