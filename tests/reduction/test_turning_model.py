"""Reduced models in the frame of a turning hand: against the full run and an integrator, and what they conserve."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.integrate
from mpi4py import MPI

import softgrasp as sg
from softgrasp.fem.frame.balance import HandBalance, HandPlace
from softgrasp.fem.frame.integrals import Sums, in_space
from softgrasp.fem.frame.rotation import cross_matrix, rotation_matrix, spatial
from softgrasp.fem.petsc import Array, to_scipy
from softgrasp.reduction.bases.basis import ReductionError
from softgrasp.reduction.bases.states import BasisError
from softgrasp.reduction.system import ModelError
from softgrasp.reduction.turning.compiled import FreeStep
from softgrasp.reduction.turning.model import TurningModel
from softgrasp.reduction.turning.stepper import TurningSteps

TURN: dict[str, Any] = {"rotation": True, "frame": "hand", "reaction": True}
DAMPED = {"damping": {"kind": "kelvin-voigt", "beta": 0.01}, "gravity": [0.0, -2.0]}
UNDAMPED: dict[str, Any] = {"damping": False, "gravity": [0.0, -2.0]}
LOAD = [0.8, 0.4, -0.3, 0.016, 0.012, 0.03]


def plate(comm: MPI.Intracomm, effects: dict[str, Any], steps: int = 60, **keys: Any) -> sg.Model:
    """A plate that turns by half a turn in 1 s."""
    return sg.build(
        "paper_forward", comm=comm, hand={"mass": 3.0, "inertia": 1.5}, effects=TURN | effects,
        tissue={"cells": [2, 4], "material": keys.pop("material", {"lambda": 1.8e3, "mu": 1.2e3, "rho": 1.0})},
        motion={"target": [0.2, 0.1, np.pi], "duration": 1.0}, output={"snapshots": "memory"},
        time={"steps": steps, "end": 1.0, "start": "equilibrium"}, **keys,
    )  # fmt: skip


def block(comm: MPI.Intracomm, steps: int) -> sg.Model:
    """A small free block in space."""
    return sg.build(
        "block_3d", comm=comm, tissue={"cells": [2, 2, 2], "order": 1, "refine": False},
        hand={"mass": 0.2, "inertia": [2e-4, 3e-4, 1e-4]}, effects=TURN | {"gravity": False, "damping": False},
        motion={"profile": "hold", "target": False, "drive": "force"}, output={"snapshots": "memory"},
        time={"steps": steps, "end": 0.2, "start": "rest"},
    )  # fmt: skip


def push(n: int, t: float, q: Array, v: Array) -> Array:
    return np.array(LOAD) * np.sin(np.pi * t / 0.05) ** 2 * (t < 0.05)


def complete(model: sg.Model, run: Any) -> TurningModel:
    """A basis of as many modes as there are unknowns."""
    layout = model.system.layout
    rom = sg.reduce(model, run, "craig_bampton", N=2 * (layout.n_s + layout.n_e))
    assert isinstance(rom, TurningModel)
    return rom


@pytest.mark.serial
def test_with_all_modes_it_is_the_full_run(comm: MPI.Intracomm) -> None:
    """Led in the plane, at the material of the basis and another; free in space: to what the iterations leave."""
    model = plate(comm, DAMPED)
    run = sg.simulate(model)
    rom, size = complete(model, run), float(np.abs(run.outputs - run.outputs_rigid).max())
    mine = sg.replay(rom, model, run)
    assert np.abs(mine.outputs - run.outputs).max() < 1e-9 * size
    assert np.abs(mine.force - run.force).max() < 1e-9 * np.abs(run.force).max()
    assert np.abs(mine.energy - run.energy).max() < 1e-9 * run.energy.max()
    other = plate(comm, DAMPED | {"damping": {"kind": "kelvin-voigt", "beta": 0.02}},
                  material={"lambda": 3e3, "mu": 2e3, "rho": 1.5})  # fmt: skip
    again = sg.simulate(other)
    assert np.abs(sg.replay(rom, other, again).outputs - again.outputs).max() < 1e-9 * size
    model = block(comm, 30)
    run = sg.simulate(model, force=push)
    free = complete(model, run).at(run.times[1]).run(force=push, steps=30)
    assert np.abs(free.outputs - run.outputs).max() < 1e-9 * np.abs(run.outputs).max()


@pytest.mark.serial
def test_a_free_hand_keeps_energy_and_momenta(comm: MPI.Intracomm) -> None:
    model = block(comm, 80)
    rom = sg.reduce(model, sg.simulate(model, force=push), "craig_bampton", N=24)
    assert isinstance(rom, TurningModel)
    small = rom.at(0.2 / 80)
    run = small.run(force=push, steps=80)
    M, kept = in_space(rom.M_hand + small.rigid), []
    for n in range(24, 81, 8):
        place, sums = HandPlace.of(spatial(run.q_s[n]), spatial(run.v_s[n])), Sums.of(run.rows[n], 6)
        P, L = (place.Q @ x for x in sums.momenta(M, place.xi).reshape(2, 3))
        L = L + np.cross(place.q[:3], P)
        energy = place.xi @ M @ place.xi / 2 + place.xi @ sums.drift + run.energy[n]
        kept.append(np.concatenate([[energy], P, L]))
    each = np.array(kept)
    for part in (slice(0, 1), slice(1, 4), slice(4, 7)):
        assert np.ptp(each[:, part], axis=0).max() < 1e-11 * np.abs(each[:, part]).max()  # iterated to 1e-13
    assert np.linalg.norm(run.q_s[-1, 3:]) > 0.5  # it turns
    assert run.energy[-1] > 1e-6 * each[0, 0]  # and swings


@pytest.mark.serial
@pytest.mark.parametrize("compiled", [True, False])
def test_a_hand_that_spins_freely_may_have_the_shortest_steps(
    comm: MPI.Intracomm, compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its loads are small beside the inertia of a step, whose rounding then ends the iteration."""
    model = block(comm, 30)
    rom = sg.reduce(model, sg.simulate(model, force=push), "craig_bampton", N=24)
    if not compiled:
        monkeypatch.setattr(FreeStep, "of", lambda *of: None)
    ends = []
    for dt, steps in ((1e-5, 40), (4e-5, 10)):
        system, rest = rom.at(dt), np.zeros(rom.k)
        inertia, place = (
            in_space(rom.M_hand + system.rigid),
            HandPlace.of(np.zeros(6), np.array([0, 0, 0, 0.5, 2, 0.3])),
        )
        balance, last = HandBalance(inertia, inertia, np.zeros(3), list(range(6)), dt), place.xi
        march = TurningSteps(system.small, dt, rest, rest, place.xi[3:])
        for _ in range(steps):
            xi = march.free(balance, place, np.zeros(6), 2 * place.xi - last)
            place, last = place.moved(xi, dt), xi
        ends.append(np.concatenate([1e5 * march.a, place.v]))
    assert np.abs(ends[1] - ends[0]).max() < 2e-2 * np.abs(ends[0]).max()  # the longer step's error


@pytest.mark.serial
@pytest.mark.parametrize("d", [2, 3])
def test_the_compiled_step_of_a_free_hand_is_that_in_numpy(
    comm: MPI.Intracomm, d: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Under gravity, pushed and turned, hand with weight; both iterate to 1e-13 of the loads."""
    if d == 2:
        model = plate(comm, DAMPED, steps=30)
        force, load = None, [8.0, 4.0, 900.0]
    else:
        model, force, load = block(comm, 30), push, LOAD
    rom, runs = sg.reduce(model, sg.simulate(model, force=force), "craig_bampton", N=24), []
    small = replace(rom, hand_weight=True).at(2e-3, gravity=np.array([0.3, -2.0, 0.5][:d]))
    for compiled in (True, False):
        if not compiled:
            monkeypatch.setattr(FreeStep, "of", lambda *of: None)
        runs.append(small.run(force=lambda n, t, q, v: np.array(load) * np.sin(40 * t), steps=60))
    for mine, other in ((runs[0].a, runs[1].a), (runs[0].q_s, runs[1].q_s), (runs[0].v_s, runs[1].v_s)):
        assert np.abs(mine - other).max() < 1e-10 * np.abs(other).max()  # measured 1e-12
    assert np.abs(runs[0].q_s[:, d:]).max() > 0.1  # it turns


@pytest.mark.serial
def test_few_modes_against_an_integrator_of_their_equations(comm: MPI.Intracomm) -> None:
    """M a'' + ... of the docstring with dense matrices of the mesh, by a Runge-Kutta method of order 8: of order 2."""
    model = plate(comm, DAMPED)
    rom = sg.reduce(model, sg.simulate(model), "craig_bampton", N=14)
    assert isinstance(rom, TurningModel)
    assert rom.Phi is not None
    system, Phi, w, k = model.system, rom.Phi, 2.5, rom.k
    M, K = to_scipy(system.M_ee).toarray(), to_scipy(system.K_ee).toarray()
    nodes, beta, g = M.shape[0] // 2, 0.01, np.array([0.0, -2.0, 0.0])

    def theta(t: float) -> Array:
        return w * t * t / 2  # from rest, with a rate that grows

    def rate(t: float, x: Array) -> Array:
        a, e, spin = x[:k], x[k:], w * t
        J = np.array([[0.0, -1.0], [1.0, 0.0]])
        turn, faster, square = (np.kron(np.eye(nodes), A) for A in (J * spin, J * w, J @ J * spin**2))
        fall = (rotation_matrix(np.array([0, 0, theta(t)])).T @ g)[:2]
        r = system.layout.nodes - system.layout.reference
        assert system.frame is not None
        load = (
            -system.G @ np.array([-fall[0], -fall[1], w])
            + system.frame.moments(system.materials)[:, [0, 3]].sum(axis=1) * spin**2
        )
        assert len(r) == nodes
        inertia = Phi.T @ (load - 2 * M @ turn @ Phi @ e - M @ (faster + square) @ Phi @ a)
        return np.concatenate([e, inertia - Phi.T @ K @ Phi @ (a + beta * e)])

    done = scipy.integrate.solve_ivp(rate, (0, 1.0), np.zeros(2 * k), method="DOP853", rtol=1e-10, atol=1e-13)
    errors = []
    for steps in (200, 400, 800):
        t = np.linspace(0, 1.0, steps + 1)
        q, v = np.zeros((steps + 1, 3)), np.zeros((steps + 1, 3))
        q[:, 2], v[:, 2] = theta(t), w * t
        run = rom.at(1.0 / steps).run((q, v))
        errors.append(np.linalg.norm(run.a[-1] - done.y[:k, -1]) / np.linalg.norm(done.y[:k, -1]))
        assert np.linalg.norm(run.v[-1] - done.y[k:, -1]) < 50 * errors[-1] * np.linalg.norm(done.y[k:, -1])
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(orders - 2) < 0.1), (errors, orders)


@pytest.mark.ranks(2)
def test_ranks_and_files_agree(comm: MPI.Intracomm, tmp_path: Path) -> None:
    """Modes of any partition span the same space; a file gives the same bits, with its rows by their nodes."""
    model = plate(comm, DAMPED)
    run = sg.simulate(model)
    rom = sg.reduce(model, run, "psd_cotangent_lift_fixed_relative", N=18)
    mine = sg.replay(rom, model, run)
    errors = sg.errors(rom, mine, model, run)
    assert errors.z < 1e-3  # measured 1e-5 to 1e-4
    alone = plate(MPI.COMM_SELF, DAMPED)
    other = sg.replay(
        sg.reduce(alone, sg.simulate(alone), "psd_cotangent_lift_fixed_relative", N=18), alone, sg.simulate(alone)
    )
    assert (
        np.abs(mine.outputs - other.outputs).max() < 1e-7 * np.abs(other.outputs).max()
    )  # the solver's tolerance, in a basis
    path = Path(comm.bcast(str(tmp_path))) / "rom.h5"
    sg.save(rom, path)
    again = sg.load(path, model.system.layout)
    assert isinstance(again, TurningModel)
    repeated = sg.replay(again, model, run)
    assert np.array_equal(repeated.x, mine.x)
    assert sg.errors(again, repeated, model, run) == errors
    online = sg.load(path)
    assert isinstance(online, TurningModel)
    with pytest.raises(ModelError, match="no basis on the mesh"):
        online.reconstruct(mine.a)
    comm.Barrier()


@pytest.mark.serial
def test_a_spin_above_what_the_linear_law_withstands_is_named(comm: MPI.Intracomm) -> None:
    model = plate(comm, DAMPED)
    rom = sg.reduce(model, sg.simulate(model), "craig_bampton", N=14)
    assert isinstance(rom, TurningModel)
    small = rom.at(1e-3)
    lowest = small.small.bending()
    t = 1e-3 * np.arange(11.0)
    for factor, named in ((0.5, False), (2.0, True)):
        spin = factor * lowest
        run = small.run((np.outer(t, [0, 0, spin]), np.tile([0, 0, spin], (11, 1))))
        assert bool(run.caution) is named
        assert named == ("grows without bound" in run.card().text())
    assert np.allclose(small.small.spun(np.array([0, 0, 3.0])) - small.small.K, -9 * small.small.M)  # in the plane
    assert cross_matrix(np.array([0, 0, 1.0]))[1, 0] == 1


@pytest.mark.serial
def test_what_it_cannot_do_is_refused(comm: MPI.Intracomm) -> None:
    model = plate(comm, UNDAMPED)
    run = sg.simulate(model)
    with pytest.raises(BasisError, match="choose one of craig_bampton"):
        sg.reduce(model, run, "psd_fixed", N=14)
    rom = sg.reduce(model, run, "craig_bampton", N=14)
    assert isinstance(rom, TurningModel)
    soft = replace(rom.materials[0], beta=1.0)
    with pytest.raises(ModelError, match="beta > 0 needs a model projected with"):
        rom.at(1e-3, (soft,))
    with pytest.raises(ModelError, match="either the motion of the hand or the force"):
        rom.at(1e-3).run()
    strained = plate(comm, UNDAMPED | {"finite_strain": {}}, steps=10)
    with pytest.raises(ReductionError, match="whose models have one basis"):
        sg.reduce(strained, sg.simulate(plate(comm, UNDAMPED, steps=20)), "craig_bampton", N=14)
