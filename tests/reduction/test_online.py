"""Running and storing reduced models: against plain loops; their energy and their time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import h5py
import numpy as np
import pytest
from mpi4py import MPI

import softgrasp.reduction.online
from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate
from softgrasp.reduction.archive import LINEAR, load, save, write_model
from softgrasp.reduction.bases.registry import make_basis
from softgrasp.reduction.bases.states import states_of
from softgrasp.reduction.online import Stepper, run, run_batch
from softgrasp.reduction.projection import project
from softgrasp.reduction.propagator import propagator, rotation
from softgrasp.reduction.system import EnergySystem, ModelError
from tests.helpers.models import Array, close, gather_rows, make_scene
from tests.helpers.reduced import (
    DAMPED,
    KINDS,
    TINY,
    model_of,
    reduced,
    small_of,
    step_of,
    symplectic_basis,
    wiggle,
)

CANONICAL = [kind for kind in KINDS if kind[0] == "qp"]


def plain_loop(small: EnergySystem, dt: float, force: Array, x: Array) -> Array:
    """The midpoint rule as it is written, in the raw coordinates."""
    states = [x]
    for u in force:
        right = (small.E + dt / 2 * small.A) @ x + dt * (small.B @ u + small.f)
        x = np.linalg.solve(small.E - dt / 2 * small.A, right)
        states.append(x)
    return np.array(states)


# --- trajectories


@pytest.mark.parametrize("steps", [1, 7, 8, 21])
def test_blocks_of_steps_are_the_plain_rule(comm: MPI.Intracomm, steps: int) -> None:
    model = model_of(comm, {"effects": {"gravity": {"g": [1.0, -9.0]}}})
    dt = 0.013
    for kind in KINDS:
        small = small_of(model, kind)
        x0 = np.cos(np.arange(small.N))
        own = run(small, dt, wiggle(steps, dt), x0=x0, allow_unstable=True)
        assert own.x.shape == (steps + 1, small.N)
        assert close(own.times, dt * np.arange(steps + 1)) < 1e-15  # the same products
        assert close(own.x, plain_loop(small, dt, wiggle(steps, dt), x0)) < 1e-10, kind  # rounding, as above


def test_a_prescribed_hand_is_the_force_that_carries_it(comm: MPI.Intracomm) -> None:
    """u_n = M_hand (v_{n+1} - v_n) / dt reproduces the hand; the table's own positions differ by O(dt^2)."""
    scene = make_scene(TINY, DAMPED, {"output": {"snapshots": "memory"}})
    model = build(scene, comm=comm)
    full, dt = simulate(model), step_of(model)
    u = np.diff(full.v_s, axis=0) / dt @ model.system.M_hand.T
    for kind in KINDS:
        if not kind[2]:
            continue
        small = small_of(model, kind)
        tables = run(small, dt, hand=(full.q_s, full.v_s), allow_unstable=True)
        forced = run(small, dt, u, allow_unstable=True)
        assert close(tables.v_s, forced.v_s) < 1e-12  # sums of 30 terms
        assert close(tables.x, forced.x) < 1e-10, kind  # rounding, as above
        assert (tables.q_s == full.q_s).all()
        assert 1e-9 < close(tables.q_s, forced.q_s) < 1e-2  # (dt / T)^2 = 1e-3
    with pytest.raises(ModelError, match="cannot be prescribed"):
        run(small_of(model, ("qp", "relative", False)), dt, hand=(full.q_s, full.v_s))


def test_start_in_equilibrium_stays_there(comm: MPI.Intracomm) -> None:
    model = model_of(comm, {"effects": {"gravity": {"g": [1.0, -9.0]}}})
    for kind in KINDS:
        small = small_of(model, kind)
        if not kind[2]:
            with pytest.raises(ModelError, match="fixed solid"):
                small.equilibrium()
            continue
        x = small.equilibrium()
        assert np.abs(x).max() > 1e-3  # the weight does move it: 0.1
        own = run(small, 0.01, np.zeros((200, 2)), x0=x, allow_unstable=True)
        # rounding against the load; a (q, v) model may amplify it
        assert close(own.x, np.tile(x, (201, 1))) < 1e-9, kind


def test_one_step_at_a_time_is_the_run(comm: MPI.Intracomm) -> None:
    model = model_of(comm, DAMPED)
    dt, u = 0.01, wiggle(25, 0.01)
    for kind in KINDS:
        small = small_of(model, kind)
        x0 = np.sin(np.arange(small.N))
        own = run(small, dt, u, x0=x0, allow_unstable=True)
        stepper = Stepper(small, dt, x0, allow_unstable=True)
        assert close(stepper.outputs, own.outputs[0]) < 1e-12  # one product with C
        outputs = np.array([stepper(force).copy() for force in u])
        assert close(outputs, own.outputs[1:]) < 1e-11, kind  # rounding of powers of one matrix
        assert close(stepper.state, own.x[-1]) < 1e-11, kind  # as above


@pytest.mark.parametrize("together", [softgrasp.reduction.online.TOGETHER, 0])
def test_a_batch_is_its_runs(comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch, together: int) -> None:
    monkeypatch.setattr(softgrasp.reduction.online, "TOGETHER", together)
    model = model_of(comm, DAMPED)
    rom = reduced(model, symplectic_basis(model.system.layout, 4, "relative", True))
    (m,) = model.system.materials
    many = [rom.at((replace(m, lam=lam, mu=mu),)) for lam, mu in ((30.0, 20.0), (50.0, 50.0), (500.0, 400.0))]
    dt, u = 0.01, wiggle(21, 0.01)
    for single, whole in zip(many, run_batch(many, dt, u), strict=True):
        assert close(run(single, dt, u).x, whole.x) < 1e-12  # the same products in another order
    forces = np.stack([u, 2 * u, -u])
    for force, whole in zip(forces, run_batch(many[:1], dt, forces), strict=True):
        assert close(run(many[0], dt, force).outputs, whole.outputs) < 1e-12  # as above
    with pytest.raises(ModelError, match="do not fit"):
        run_batch(many[:2], dt, forces)


def test_wrong_inputs_are_named(comm: MPI.Intracomm) -> None:
    small = small_of(model_of(comm))
    with pytest.raises(ModelError, match="either"):
        run(small, 0.01)
    with pytest.raises(ModelError, match="time step"):
        run(small, force=np.zeros((3, 2)))
    with pytest.raises(ModelError, match=r"\(steps, 2\)"):
        run(small, 0.01, np.zeros((3, 3)))
    with pytest.raises(ModelError, match="steps \\+ 1"):
        run(small, 0.01, hand=(np.zeros((3, 2)), np.zeros((4, 2))))
    with pytest.raises(ModelError, match="another"):
        run(propagator(small, 0.01), 0.02, np.zeros((3, 2)))


# --- energy


def test_rotations_keep_their_length() -> None:
    angle, wide = np.linspace(0.02, 3.1, 500), np.longdouble
    angle = angle[np.abs(np.cos(angle)) > 0.01]
    c, s = rotation(angle)
    length = c.astype(wide) ** 2 + s.astype(wide) ** 2 - 1
    # plain rounding leaves 5e-17 in the median, 2e-16 at worst
    assert np.abs(length).max() < 1e-16
    if np.finfo(wide).eps < 1e-18:  # elsewhere a long double is no wider than a double
        assert np.median(np.abs(length)) < 1e-18  # a fiftieth of that
    assert np.abs(np.arctan2(s, c) - angle).max() < 1e-12  # 200 units in the last place at 1e-2
    slow = np.geomspace(1e-9, 1e-2, 30)
    c, s = rotation(slow)
    assert np.abs(np.arctan2(s, c) / slow - 1).max() < 1e-12  # the bound of the docstring


@pytest.mark.parametrize("two_way", [False, True])
@pytest.mark.parametrize("kind", CANONICAL, ids=["-".join(map(str, kind[1:])) for kind in CANONICAL])
def test_energy_is_constant_over_many_steps(comm: MPI.Intracomm, kind: tuple[Any, ...], two_way: bool) -> None:
    small = small_of(model_of(comm, {"effects": {"reaction": two_way}}), kind, 7)
    assert_constant_energy(small, 0.005)


def assert_constant_energy(small: EnergySystem, dt: float) -> None:
    """The Hamiltonian over 1e5 steps; the tissue's energy beside a resting hand where the hand is an input."""
    apart = small.hand_first and not small.two_way
    x0 = np.cos(np.arange(small.N))
    x0[: 4 if apart else 0] = 0.0

    def energy(x: Array) -> Array:
        return small.energy(x) if apart else small.total_energy(x)

    found = energy(run(small, dt, np.zeros((100_000, 2)), x0=x0).x)
    # the bound; rounding of 12500 products adds up at random to about 1e-14
    assert np.abs(found / found[0] - 1).max() < 1e-12
    stepper = Stepper(small, dt, x0)
    for _ in range(2000):
        stepper(np.zeros(2))
    assert abs(energy(stepper.state) / found[0] - 1) < 1e-13  # rounding of 2000 products


@pytest.mark.parametrize("two_way", [False, True])
def test_energy_of_craig_bampton_is_constant_over_many_steps(comm: MPI.Intracomm, two_way: bool) -> None:
    system = model_of(comm, {"effects": {"reaction": two_way}}).system
    assert_constant_energy(project(make_basis("craig_bampton", states_of(system), 12), system).at(), 0.005)


@pytest.mark.parametrize("two_way", [False, True])
def test_energy_never_grows_with_damping(comm: MPI.Intracomm, two_way: bool) -> None:
    model = model_of(comm, DAMPED, {"effects": {"reaction": two_way, "damping": {"beta": 0.002}}})
    for kind in KINDS:
        small = small_of(model, kind)
        if kind[0] == "qv":
            continue
        x0 = np.cos(np.arange(small.N))
        if not two_way:
            # the hand at rest: its motion would do work on the tissue
            x0 = x0 if not kind[2] else np.where(np.arange(small.N) < 4, 0.0, x0)
        own = run(small, 0.01, np.zeros((400, 2)), x0=x0)
        energy = small.total_energy(own.x) if (two_way or not kind[2]) else small.energy(own.x)
        drop = np.diff(energy)
        assert drop.max() <= 1e-14 * energy[0], kind  # rounding of the quadratic form
        assert energy[-1] < 0.9 * energy[0], kind


# --- time


@pytest.mark.serial
def test_online_speed(comm: MPI.Intracomm) -> None:
    """600 steps below 1.5 ms and one step below 5 us at N = 30: the best of many tries, ten times slower than usual."""
    model = model_of(comm)
    small = small_of(model, pairs=13)
    assert small.N == 30
    step, u = propagator(small, 0.005), wiggle(600, 0.005)
    stepper = Stepper(step)

    def best(call: Any, count: int) -> float:
        times = []
        for _ in range(30):
            begin = perf_counter()
            for _ in range(count):
                call()
            times.append((perf_counter() - begin) / count)
        return min(times)

    assert best(lambda: run(step, force=u), 1) < 1.5e-3
    assert best(lambda: stepper(u[0]), 200) < 5e-6


# --- file


def test_file_keeps_everything(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    model = model_of(comm, DAMPED, {"effects": {"gravity": {"g": [1.0, -9.0]}}})
    layout = model.system.layout
    alone = build(model.scene, comm=MPI.COMM_SELF).system.layout
    for kind in KINDS:
        coordinates, frame, fixed = kind
        rom = reduced(model, symplectic_basis(layout, 3, frame, fixed, coordinates))
        path = mpi_tmp_path / f"{coordinates}{frame}{fixed}.h5"
        save(rom, path)
        again = load(path, layout, "hash")
        online = load(path)
        for other in (again, online):
            assert other.materials == rom.materials
            assert other.seconds == rom.seconds
            assert (other.at().A == rom.at().A).all()
            assert (other.at().f == rom.at().f).all()
            assert other.outputs.names == rom.outputs.names
        assert online.reconstruction is None
        x = np.cos(np.arange(rom.N))[:, None]
        z, v = rom.reconstruct(rom.at(), x)
        for mine, theirs in zip((z, v), again.reconstruct(again.at(), x), strict=True):
            assert (mine == theirs).all()
        # another number of ranks: every rank holds the whole mesh
        z_alone, _ = (lambda m: m.reconstruct(m.at(), x))(load(path, alone))
        assert close(gather_rows(alone, z_alone), gather_rows(layout, z)) < 1e-15  # the same numbers


@pytest.mark.serial
def test_a_file_that_cannot_be_written_whole_leaves_nothing(tmp_path: Path) -> None:
    def fails(file: h5py.File) -> None:
        file["part"] = np.ones(1000)
        raise OSError("No space left on device")

    with pytest.raises(OSError, match="No space left"):
        write_model(tmp_path / "model.h5", LINEAR, {}, None, fails)
    assert list(tmp_path.iterdir()) == []


def test_files_that_do_not_fit_are_refused(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    model = model_of(comm)
    path = mpi_tmp_path / "model.h5"
    save(reduced(model, symplectic_basis(model.system.layout, 3, "relative", True)), path)
    with pytest.raises(ModelError, match="another scene"):
        load(path, scene_hash="other")
    with pytest.raises(ModelError, match="mesh of"):
        load(path, model_of(comm, {"tissue": {"cells": [3, 6]}}).system.layout)
    with pytest.raises(ModelError, match="another mesh"):
        load(path, model_of(comm, {"tissue": {"size": [1.0, 1.9]}}).system.layout)
    with pytest.raises(ModelError, match="cannot be read"):
        load(mpi_tmp_path / "none.h5", model.system.layout)
    bad = mpi_tmp_path / f"bad{comm.rank}.h5"
    bad.write_bytes(b"not a file")
    with pytest.raises(ModelError, match="cannot be read"):
        load(bad)
    bare = mpi_tmp_path / f"bare{comm.rank}.h5"
    save(load(path), bare)
    with pytest.raises(ModelError, match="no basis on the mesh"):
        load(bare, model.system.layout)
