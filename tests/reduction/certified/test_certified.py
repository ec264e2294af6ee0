"""Certified runs: norms and bounds against full runs, dense matrices and the textbook; archive and refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import to_scipy
from softgrasp.reduction import online
from softgrasp.reduction.archive import write_checksums
from softgrasp.reduction.certified import bounds
from softgrasp.reduction.certified.archive import load_certified, save_certified
from softgrasp.reduction.certified.certificate import Bound, ToleranceError
from softgrasp.reduction.certified.model import ParameterDomain
from softgrasp.reduction.certified.motion import Drive
from softgrasp.reduction.certified.oscillators import march
from softgrasp.reduction.certified.residual import ResidualSpace
from softgrasp.reduction.certified.training import certified_model
from softgrasp.reduction.system import ModelError
from tests.helpers.certified import (
    EQUILIBRIUM,
    KELVIN_VOIGT,
    TURNING,
    dense,
    energy_norm,
    error_to,
    full_at,
    mass_bound,
    ritz,
)
from tests.helpers.models import CUBE, LAYERS, close, make_scene
from tests.helpers.reduced import waves

RAYLEIGH = {"effects": {"damping": {"kind": "rayleigh", "beta": 0.01, "alpha": 0.3, "drag": "space"}}}
ROUNDING = 1e-9  # of the solution: what the bound, exact in exact arithmetic, may fall short by


def holds(bound: np.ndarray, error: np.ndarray, size: float) -> bool:
    return bool((bound >= error - ROUNDING * size).all())


# --- residual norms


@pytest.mark.ranks(2)
def test_triangles_give_the_norms_of_residuals(comm: MPI.Intracomm) -> None:
    """|T c| against C' W^-1 C on rank-independent smooth columns, for layers that differ."""
    model = build(make_scene({"tissue": {"layers": LAYERS}}, KELVIN_VOIGT), comm=comm)
    certified = ritz(model, 3, 5)
    full = certified.norms
    part = full.leading(3)
    own = ritz(model, 3, 3).norms
    materials = tuple(replace(m, lam=1.7 * m.lam, mu=0.6 * m.mu) for m in full.reference)
    rng = np.random.default_rng(1)
    for which in ("static", "mass"):
        G, M, K, D = part.columns(which, materials)
        theirs = own.columns(which, materials)
        c = [rng.standard_normal(X.shape[1]) for X in (G, M, K, D)]
        a = sum(X @ x for X, x in zip((G, M, K, D), c, strict=True))
        b = sum(X @ x for X, x in zip(theirs, c, strict=True))
        # leading blocks of the larger triangle are the smaller triangle, to rounding of the solves
        assert abs(np.linalg.norm(a) / np.linalg.norm(b) - 1) < 1e-9


@pytest.mark.serial
def test_triangles_against_dense_solves(comm: MPI.Intracomm) -> None:
    model = build(make_scene(KELVIN_VOIGT), comm=comm)
    space = ResidualSpace(model.system, model.system.materials)
    K, M, G = dense(model.system)
    Phi = scipy.linalg.eigh(K, M, subset_by_index=[0, 5])[1]
    space.extend(Phi[:, :2])
    space.extend(Phi[:, 2:])  # grown in two parts
    norms = space.norms()
    (m,) = model.system.materials
    other = (replace(m, lam=3 * m.lam, mu=0.5 * m.mu, rho=2 * m.rho),)
    (layer,) = model.system.layers
    K_mu, K_la = (to_scipy(A.ee).toarray() for A in (layer.K_mu, layer.K_lambda))
    K_at = other[0].mu * K_mu + other[0].lam * K_la
    rng = np.random.default_rng(2)
    c, b, a = rng.standard_normal(2), rng.standard_normal(6), rng.standard_normal(6)
    r = 2 * G @ c + 2 * M @ Phi @ b + K_at @ Phi @ a
    for which, W in (("static", K), ("mass", M)):
        X = norms.columns(which, other)
        assert np.linalg.norm(X[0] @ c + X[1] @ b + X[2] @ a) == pytest.approx(
            np.sqrt(r @ np.linalg.solve(W, r)), rel=1e-9
        )
    # without the part along K_r phi and M_r phi nothing is lost of a residual that is orthogonal to the modes
    a = rng.standard_normal(6)
    b = -np.linalg.solve(Phi.T @ M @ Phi, Phi.T @ (G @ c + K_at @ Phi @ a / 2))
    r = 2 * G @ c + 2 * M @ Phi @ b + K_at @ Phi @ a
    for which, W in (("static", K), ("mass", M)):
        X = norms.galerkin.columns(which, other)
        assert len(X[0]) == len(norms.columns(which, other)[0]) - 6
        assert np.linalg.norm(X[0] @ c + X[1] @ b + X[2] @ a) == pytest.approx(
            np.sqrt(r @ np.linalg.solve(W, r)), rel=1e-9
        )
    # the constants of the reference norms, over random residuals and in the worst direction
    worst = scipy.linalg.eigvalsh(K, K_at)[-1] ** 0.5
    assert worst <= norms.static_factor(other) * (1 + 1e-12)
    assert norms.static_factor(other) < 1.5 * worst
    assert norms.mass_factor(other) == pytest.approx(scipy.linalg.eigvalsh(M, 2 * M)[-1] ** 0.5)
    omega = np.sqrt(scipy.linalg.eigvalsh(K_at, 2 * M))
    low, high = norms.frequencies(other)
    assert 0.6 * omega[0] < low <= omega[0] * (1 + 1e-9)
    assert omega[-1] <= high < 2 * omega[-1]
    space.destroy()


@pytest.mark.serial
def test_triangles_see_residuals_that_a_gram_matrix_loses(comm: MPI.Intracomm) -> None:
    """Coefficients of a residual 1e-10 of its terms: the Gram matrix stalls at the root of eps."""
    model = build(make_scene(), comm=comm)
    K, M, G = dense(model.system)
    squares, Phi = scipy.linalg.eigh(K, M, subset_by_index=[0, 3])
    space = ResidualSpace(model.system, model.system.materials)
    space.extend(Phi)
    norms, (m,) = space.norms(), model.system.materials
    space.destroy()
    C = np.hstack([G, M @ Phi, K @ Phi])
    gram = C.T @ np.linalg.solve(M, C)
    T = np.hstack(norms.columns("mass", (m,))[:3])
    # eigh leaves residuals of eps times the largest frequency, some 1e-11 and not the same on every processor
    for small, rel in ((1e-6, 1e-2), (1e-10, 0.3)):
        # eigenmodes cancel, K phi - omega^2 M phi = 0, but for the part that is put in
        c = np.concatenate([[small, 0.0], -squares, np.ones(4)])
        exact = small * np.sqrt(G[:, 0] @ np.linalg.solve(M, G[:, 0]))
        assert np.linalg.norm(T @ c) == pytest.approx(exact, rel=rel)
    lost = np.sqrt(max(c @ gram @ c, 0.0))
    assert abs(lost - exact) >= exact  # a negative square counts as 0, an error of 100 %


# --- runs


@pytest.mark.parametrize("changes", [(), (KELVIN_VOIGT,), (RAYLEIGH, EQUILIBRIUM)], ids=["free", "kv", "sag"])
def test_modal_runs_are_those_of_the_propagator(comm: MPI.Intracomm, changes: tuple[Any, ...]) -> None:
    model = build(make_scene(*changes), comm=comm)
    certified = ritz(model, 5, 9)
    for materials in (certified.fine.materials, certified.materials(200.0, 20.0, 1.5)):
        mine = certified.run(materials, allow=True).trajectory
        small = certified.coarse.at(materials)
        x0 = small.equilibrium() if "time" in (changes[-1] if changes else {}) else None
        theirs = online.run(small, certified.drive.dt, hand=certified.drive.hand, x0=x0)
        # both round the same rule, in other coordinates
        assert close(mine.x, theirs.x) < 1e-11
        assert close(mine.outputs, theirs.outputs) < 1e-11
        assert mine.output_names == theirs.output_names


@pytest.mark.serial
def test_march_is_the_midpoint_rule() -> None:
    """Against a plain loop, for steps that are and are no multiple of a block, overdamped modes and a start."""
    rng = np.random.default_rng(3)
    omega, dt = np.array([0.3, 5.0, 80.0, 900.0]), 0.01
    rates = np.array([0.0, 0.1, 500.0, 1e5]), np.zeros(4)  # without damping it is a running sum
    for rate, steps in product(rates, (1, 5, 24, 61)):
        f, w = rng.standard_normal((4, steps)), rng.standard_normal((4, 2))
        states = march(omega, rate, f, dt, w)
        for i in range(4):
            A = np.array([[0.0, omega[i]], [-omega[i], -rate[i]]])
            left, right = np.eye(2) - dt / 2 * A, np.eye(2) + dt / 2 * A
            x = w[i].copy()
            for n in range(steps):
                assert np.allclose(states[i, :, n], x, rtol=1e-11, atol=1e-12)
                x = np.linalg.solve(left, right @ x + [0.0, dt * f[i, n]])
            assert np.allclose(states[i, :, steps], x, rtol=1e-11, atol=1e-12)


# --- bounds against full runs


SCENES: dict[str, tuple[dict[str, Any], ...]] = {
    "free": (),
    "kv": (KELVIN_VOIGT,),
    "sag": (RAYLEIGH, EQUILIBRIUM),
    "layers": ({"tissue": {"layers": LAYERS}}, KELVIN_VOIGT),
    "turning": (KELVIN_VOIGT, TURNING),
    "cube": (CUBE, KELVIN_VOIGT),
}


@pytest.mark.ranks(2)
@pytest.mark.parametrize("name", SCENES)
def test_the_bound_holds_at_every_step(comm: MPI.Intracomm, name: str) -> None:
    model = build(make_scene(*SCENES[name]), comm=comm)
    certified = ritz(model, 4, 10)
    places = [(50.0, 50.0), (30.0, 20.0), (500.0, 40.0), (-5.0, 50.0), (400.0, 4.0)]
    for lam, mu in places if name in ("free", "kv") else places[:3]:
        materials = certified.materials(lam, mu, 1.0 if mu > 20 else 0.5)
        system, full = full_at(model, materials)
        for sizes in ((4, 10), (2, 4), (1, 1)):
            part = replace(certified.with_sizes(*sizes), fine=certified.with_sizes(*sizes).fine)
            run = part.run(materials, allow=True)
            error, size = error_to(system, full, _reconstructible(part, certified), run)
            assert holds(run.certificate.energy.values, error, size), (lam, mu, sizes)
            off = np.abs(full.outputs - run.trajectory.outputs)
            assert (run.certificate.outputs.values >= off - ROUNDING * np.abs(full.outputs).max()).all()
            if run.certificate.effectivity_at_most < np.inf:
                top = run.certificate.energy.values.max() / error.max()
                assert top <= run.certificate.effectivity_at_most * (1 + 1e-6)


@pytest.mark.ranks
@pytest.mark.parametrize("force", [{}, {"motion": {"drive": "force"}, **TURNING}], ids=["motion", "two-way"])
def test_one_rank_and_all_say_the_same(comm: MPI.Intracomm, force: dict[str, Any]) -> None:
    """The same smooth modes on one rank and on all: bounds equal to 1e-10, not only to the residual's own rounding."""
    values = []
    for ranks in (MPI.COMM_SELF, comm):
        model = build(make_scene(KELVIN_VOIGT, force), comm=ranks)
        certified = certified_model(model, waves(model.system.layout, 8, 1), k=3)
        runs = certified.run_batch([certified.materials(*place) for place in ((50.0, 50.0), (30.0, 400.0))])
        values.append(np.array([run.certificate.energy.values for run in runs]))
    assert np.abs(values[0] - values[1]).max() <= 1e-10 * np.abs(values[0]).max()


def _reconstructible(part: Any, whole: Any) -> Any:
    """A smaller model with the reconstruction of the whole, which error_to takes its modes from."""
    return replace(part, fine=replace(part.fine, reconstruction=whole.fine.reconstruction))


@pytest.mark.ranks(2)
@pytest.mark.parametrize("changes", [(), (KELVIN_VOIGT, TURNING, {"effects": {"gravity": {"g": [0.5, -9.0]}}})])
def test_the_bound_holds_under_a_force(comm: MPI.Intracomm, changes: tuple[Any, ...]) -> None:
    """One-way the hand is exact; two-way it has an error of its own, which norm and bound take in."""
    model = build(make_scene({"motion": {"drive": "force"}}, *changes), comm=comm)
    certified = ritz(model, 4, 10)
    for lam, mu, rho in ((50.0, 50.0, 1.0), (300.0, 20.0, 1.0), (60.0, 45.0, 2.0)):
        materials = certified.materials(lam, mu, rho)
        system, full = full_at(model, materials)
        run = certified.run(materials, allow=True)
        error, size = error_to(system, full, certified, run, coupled=bool(changes))
        assert holds(run.certificate.energy.values, error, size)
        assert run.certificate.energy.values.max() < 100 * error.max()  # it is not void
        off = np.abs(full.outputs - run.trajectory.outputs)
        assert (run.certificate.outputs.values >= off - ROUNDING * np.abs(full.outputs).max()).all()


@pytest.mark.serial
def test_the_static_bound_is_far_below_the_textbooks(comm: MPI.Intracomm) -> None:
    model = build(make_scene({"tissue": {"cells": [6, 12]}, "time": {"steps": 120}}), comm=comm)
    certified = ritz(model, 12, 12)
    run = certified.run(allow=True)
    system, full = full_at(model, certified.fine.materials)
    x, Phi, drive = run.trajectory.x.T, certified.fine.reconstruction.L_q[:, 4:16], certified.drive
    c = np.diff(drive.hand[1], axis=0).T / drive.dt
    textbook = mass_bound(system, Phi, x[4:16], x[16:], c, drive.dt)
    error, size = error_to(system, full, certified, run)
    assert holds(textbook, error, size)
    assert run.certificate.energy.values.max() < textbook.max() / 5


@pytest.mark.serial
def test_an_equilibrium_under_gravity_starts_with_its_own_static_error(comm: MPI.Intracomm) -> None:
    """e_0 = -K^-1 r_0 whatever the basis is: at the start the bound is the error itself, at the reference."""
    model = build(make_scene(EQUILIBRIUM), comm=comm)
    certified = ritz(model, 3, 3)
    system, full = full_at(model, certified.fine.materials)
    run = certified.run(allow=True)
    error, _ = error_to(system, full, certified, run)
    assert error[0] > 0
    assert run.certificate.energy.values[0] == pytest.approx(error[0], rel=1e-6)


@pytest.mark.serial
def test_decay_of_a_damped_run(comm: MPI.Intracomm) -> None:
    """Long after the motion the bound with a kernel is below the one without, and above the error."""
    changes = {"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.02}}, "time": {"end": 15.0, "steps": 300}}
    model = build(make_scene(changes, {"motion": {"duration": 1.0}}), comm=comm)
    certified = ritz(model, 4, 4)
    system, full = full_at(model, certified.fine.materials)
    run = certified.run(allow=True)
    error, size = error_to(system, full, certified, run)
    assert holds(run.certificate.energy.values, error, size)
    motion = certified._motions(4, [certified.fine.materials], certified.drive, np.zeros(2), True)[0].residual
    plain = bounds.static_bound(motion.nodes, motion.rest, certified.drive.dt)
    assert run.certificate.energy.values[-1] < 0.7 * plain[-1]


@pytest.mark.serial
def test_kernels_are_above_the_powers_of_a_step() -> None:
    low, high, alpha, beta, dt, steps = 3.0, 400.0, 0.5, 1e-3, 0.01, 900
    free, forced = bounds.decay(low, high, alpha, beta, dt, steps)
    for omega in np.geomspace(low, high, 77):
        A = np.array([[0.0, omega], [-omega, -alpha - beta * omega**2]])
        inverse = np.linalg.inv(np.eye(2) - dt / 2 * A)
        R = inverse @ (np.eye(2) + dt / 2 * A)
        for j in (0, 1, 7, 100, 899):
            power = np.linalg.matrix_power(R, j)
            assert np.linalg.norm(power, 2) <= free[j] * (1 + 1e-12)
            assert np.linalg.norm(power @ inverse, 2) <= forced[j] * (1 + 1e-12)
    assert free[-1] < 0.5
    assert bounds.decay(low, high, 0.0, 0.0, dt, steps) is None


# --- certificates


def test_three_numbers(comm: MPI.Intracomm) -> None:
    """The time step's number against full runs at dt and at a tenth of it."""
    model = build(make_scene(KELVIN_VOIGT), comm=comm)
    certified = ritz(model, 14, 20)
    run = certified.run(prove_time_step=True, allow=True)
    system, full = full_at(model, certified.fine.materials)
    fine = build(make_scene(KELVIN_VOIGT, {"time": {"steps": 600}}), comm=comm)
    _, exact = full_at(fine, certified.fine.materials)
    n = system.layout.n_local
    d = full.snapshots.Z - exact.snapshots.Z[:, ::10]
    size = energy_norm(system, full.snapshots.Z[:n], full.snapshots.Z[n:]).max()
    true = energy_norm(system, d[:n], d[n:]).max() / size * 100 / 99
    assert run.certificate.time_step == pytest.approx(true, rel=0.03)
    assert run.certificate.time_step_proof > run.certificate.time_step
    assert "(proved)" in run.certificate.sentence()
    assert "(estimate)" in run.certificate.sentence()


def test_a_batch_is_the_runs_one_by_one(comm: MPI.Intracomm) -> None:
    certified = ritz(build(make_scene(KELVIN_VOIGT), comm=comm), 4, 9)
    many = [certified.materials(*place) for place in ((50.0, 50.0), (30.0, 20.0), (500.0, 400.0))]
    for materials, run in zip(many, certified.run_batch(many), strict=True):
        own = certified.run(materials, allow=True)
        assert close(run.trajectory.x, own.trajectory.x) < 1e-12
        assert close(run.certificate.energy.values, own.certificate.energy.values) < 1e-9


def test_refusals(comm: MPI.Intracomm) -> None:
    certified = ritz(
        build(make_scene(), comm=comm), 4, 9, box=ParameterDomain((30.0, 60.0), (20.0, 60.0)), tolerance=1e-3
    )
    with pytest.raises(ToleranceError, match=r"proved to be at most .* above the tolerance 0\.001"):
        certified.run()
    with pytest.raises(ToleranceError, match="larger than the deformation itself"):
        certified.with_sizes(1, 1).run(certified.materials(50.0, 2.0))
    run = certified.run(certified.materials(500.0, 50.0), allow=True)
    assert not run.certificate.inside
    assert any("outside the box" in reason for reason in run.certificate.reasons)
    twice = certified.materials(100.0, 100.0, 2.0)  # the same motion as (50, 50, 1)
    assert certified.run(twice, tolerance=0.9).certificate.inside
    estimate = replace(certified, certify="estimate").run(allow=True).certificate
    assert not estimate.proved
    assert "estimated" in estimate.sentence()
    still = Drive(certified.drive.dt, hand=tuple(0 * t for t in certified.drive.hand))
    assert certified.run(drive=still).certificate.reduction == 0.0
    with pytest.raises(ModelError, match="must have 2 columns"):
        certified.run(drive=Drive(0.1, force=np.zeros((5, 3))))
    with pytest.raises(ModelError, match="either the force"):
        certified.run(drive=Drive(0.1))
    with pytest.raises(ModelError, match="needs a second-order basis with fixed solid modes"):
        replace(certified, fine=replace(certified.fine, frame="absolute"))
    assert Bound(np.array([0.0, 2.0]), 1.0, "proof").relative == np.inf


# --- archive


@pytest.mark.ranks(2)
def test_archive(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    model = build(make_scene(KELVIN_VOIGT), comm=comm)
    certified = ritz(model, 4, 9, box=ParameterDomain((30.0, 500.0), (20.0, 500.0)), tolerance=0.5)
    file = mpi_tmp_path / "certified.h5"
    save_certified(certified, file)
    materials = certified.materials(77.0, 60.0)
    first = certified.run(materials)
    for layout in (None, model.system.layout):
        again = load_certified(file, layout)
        run = again.run(materials)
        assert np.array_equal(run.certificate.energy.values, first.certificate.energy.values)
        assert np.array_equal(run.trajectory.x, first.trajectory.x)
        assert run.certificate.time_step == first.certificate.time_step
        assert (again.box, again.tolerance, again.k) == (certified.box, certified.tolerance, certified.k)
    other = build(make_scene({"tissue": {"size": [1.0, 2.1]}}), comm=comm)
    with pytest.raises(ModelError, match="another mesh"):
        load_certified(file, other.system.layout)
    for name in ("certificate/static", "parts/K_mu", "certificate/drive/q_s"):
        if comm.rank == 0:
            with h5py.File(file, "r+") as data:
                kept = data[name][()]
                bits = kept.copy()
                bits.view(np.uint64).ravel()[bits.size // 2] ^= 1
                data[name][...] = bits
        comm.Barrier()
        with pytest.raises(ModelError, match="damaged"):
            load_certified(file)
        comm.Barrier()
        if comm.rank == 0:
            with h5py.File(file, "r+") as data:
                data[name][...] = kept
        comm.Barrier()
    assert load_certified(file).k2 == 9


@pytest.mark.ranks(2)
@pytest.mark.parametrize("whole", [False, True], ids=["online", "reconstruction"])
@pytest.mark.parametrize(
    ("part", "changed", "word"),
    [("box", {"lam": [30, 500], "mu": [20, 500]}, "'apart' is missing"), ("reference", [{"nu": 0.3}], "nu")],
)
def test_a_file_of_other_keys_is_refused(
    comm: MPI.Intracomm, mpi_tmp_path: Path, part: str, changed: object, word: str, whole: bool
) -> None:
    """As another version of the same format would write it, with right hashes."""
    model = build(make_scene(KELVIN_VOIGT), comm=comm)
    file = mpi_tmp_path / "certified.h5"
    save_certified(ritz(model, 4, 9), file)
    if comm.rank == 0:
        with h5py.File(file, "r+") as data:
            about = json.loads(data["certificate/about"][()].tobytes()) | {part: changed}
            del data["certificate/about"]
            data["certificate/about"] = np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)
            write_checksums(data)
    comm.Barrier()
    with pytest.raises(ModelError, match=rf"cannot be read .*{word}"):
        load_certified(file, model.system.layout if whole else None)


@pytest.mark.serial
def test_a_plain_model_holds_no_certificate(comm: MPI.Intracomm, tmp_path: Path) -> None:
    from softgrasp.reduction.archive import load, save

    certified = ritz(build(make_scene(), comm=comm), 2, 3)
    save(certified.fine, tmp_path / "plain.h5")
    with pytest.raises(ModelError, match="has no certificate"):
        load_certified(tmp_path / "plain.h5")
    save_certified(certified, tmp_path / "certified.h5")
    assert load(tmp_path / "certified.h5").N == certified.fine.N


@pytest.mark.serial
def test_other_densities_are_other_stiffnesses(comm: MPI.Intracomm) -> None:
    """(lambda, mu, rho) and (lambda / rho, mu / rho, 1) move alike, and their certificates say the same."""
    certified = ritz(build(make_scene(), comm=comm), 4, 9)
    a = certified.run((LayerMaterial(120.0, 90.0, 1.5),), allow=True)
    b = certified.run((LayerMaterial(80.0, 60.0, 1.0),), allow=True)
    assert close(a.trajectory.x, b.trajectory.x) < 1e-11
    assert a.certificate.reduction == pytest.approx(b.certificate.reduction, rel=1e-9)
