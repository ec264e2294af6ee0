"""Projection: against dense matrices by scikit-fem, a projection made again, and the whole space."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI

import softgrasp as sg
from softgrasp.fem.errors import SceneError
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.reduction.archive import load, save, write_checksums
from softgrasp.reduction.bases.basis import Basis, ReductionError
from softgrasp.reduction.bases.states import BasisError
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.online import run
from softgrasp.reduction.projection import project
from softgrasp.reduction.spectrum import GROWTH_TOLERANCE
from softgrasp.reduction.system import EnergySystem, ModelError, UnstableModelError
from tests.helpers.models import (
    CUBE,
    LAYERS,
    Array,
    close,
    first_order,
    gather_rows,
    make_scene,
    reference,
    same_everywhere,
)
from tests.helpers.reduced import (
    DAMPED,
    FORCED,
    KINDS,
    TINY,
    dense_columns,
    distance,
    force_of,
    full_and_reduced,
    joined,
    model_of,
    reduced,
    step_of,
    symplectic_basis,
    waves,
    whole_basis,
)

TWO_WAY = {"effects": {"reaction": True, "rotation": True}}
GRAVITY = {"effects": {"gravity": {"g": [1.0, -9.0], "hand_weight": True}}}


def operators(small: EnergySystem) -> dict[str, Array]:
    return {key: getattr(small, key) for key in ("E", "A", "B", "f", "H_tissue", "H", "S_v")}


def some_basis(model: Any, coordinates: str, frame: str, fixed: bool) -> Basis:
    return symplectic_basis(model.system.layout, 4, frame, fixed, coordinates)


# --- the whole space is the full model


@pytest.mark.parametrize("changes", [(DAMPED,), (DAMPED, TWO_WAY, GRAVITY)], ids=["one-way", "two-way"])
def test_whole_space_gives_the_full_trajectory(comm: MPI.Intracomm, changes: tuple[Any, ...]) -> None:
    model = model_of(comm, *changes)
    full, n = simulate(model), model.system.layout.n_local
    for kind in KINDS:
        rom = reduced(model, whole_basis(model.system.layout, *kind))
        small = rom.at()
        own = run(small, step_of(model), force_of(model))
        z, v_z = rom.reconstruct(small, own.x.T, own.v_s.T)
        # the same rule in other coordinates: rounding of 30 steps with matrices of condition 1e5
        assert distance(model.system, z, full.snapshots.Z[:n]) < 1e-9, kind
        assert distance(model.system, v_z, full.snapshots.Z[n:]) < 1e-9, kind
        assert close(own.q_s, full.q_s) < 1e-9, kind
        assert close(own.v_s, full.v_s) < 1e-9, kind
        assert close(own.outputs, full.outputs) < 1e-9, kind
        assert own.output_names == full.output_names


def test_layers_in_the_whole_space(comm: MPI.Intracomm) -> None:
    changes = {"tissue": {"layers": LAYERS}, "effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.01}}}
    model = model_of(comm, changes)
    for kind in (("qv", "absolute", True), ("qp", "relative", True)):
        full, small_run, rom = full_and_reduced(model, whole_basis(model.system.layout, *kind))
        z, _ = rom.reconstruct(rom.at(), small_run.x.T, small_run.v_s.T)
        # rounding, as above
        assert distance(model.system, z, full.snapshots.Z[: len(z)]) < 1e-9


# --- dense oracles


@pytest.mark.parametrize("fixed", [True, False])
@pytest.mark.parametrize("changes", [(DAMPED,), ({"effects": {"rotation": True}}, GRAVITY)], ids=["damped", "turning"])
def test_galerkin_is_the_papers(comm: MPI.Intracomm, changes: tuple[Any, ...], fixed: bool) -> None:
    """E_N = V'EV, A_N = V'AV, B_N = V'B with E, A, B assembled by scikit-fem in absolute coordinates."""
    model = model_of(comm, *changes)
    basis = some_basis(model, "qv", "absolute", fixed)
    dense, V = first_order(reference(model)), dense_columns(model, basis)
    small = reduced(model, basis).at()
    # two assemblies agree to rounding; K_es T + K_ee = 0 cancels entries of 1e2
    for name, theirs in (
        ("E", V.T @ dense.E @ V),
        ("A", V.T @ dense.A @ V),
        ("B", V.T @ dense.B),
        ("f", V.T @ dense.f),
    ):
        assert (
            close(operators(small)[name], theirs) < 1e-11 if np.abs(theirs).any() else not operators(small)[name].any()
        )


@pytest.mark.parametrize("frame", ["absolute", "relative"])
def test_two_way_canonical_model_is_the_symplectic_projection(comm: MPI.Intracomm, frame: str) -> None:
    """x_N' = (V'J'V)^-1 V' grad H(V x_N) with the dense Hamiltonian, V in the canonical coordinates of the whole."""
    model = model_of(comm, {"effects": {"reaction": True}})
    layout, system = model.system.layout, model.system
    basis = some_basis(model, "qp", frame, False)
    ref = reference(model)
    n_s, n = layout.n_s, layout.n_s + layout.n_e
    M, K = ref.P.T @ ref.M @ ref.P, ref.P.T @ ref.K @ ref.P
    M[:n_s, :n_s] += ref.M_hand
    V = dense_columns(model, basis)
    if frame == "relative":
        # z and M_ee v_z with p_s = M_hand v_s: to q_e = z + T q_s, v_e, and from there to momenta
        T, M_ee = ref.T, M[n_s:, n_s:]
        q_s, z, v_s = V[:n_s], V[n_s:n], np.linalg.solve(ref.M_hand, V[n : n + n_s])
        v_e = np.linalg.solve(M_ee, V[n + n_s :]) + T @ v_s
        V = np.concatenate([q_s, z + T @ q_s, M @ np.concatenate([v_s, v_e])])
    J = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
    H = scipy.linalg.block_diag(K, np.linalg.inv(M))
    small = reduced(model, basis).at()
    # two assemblies, and solves with mass matrices of condition 20
    assert close(small.E, V.T @ J.T @ V) < 1e-10
    assert close(small.A, V.T @ H @ V) < 1e-10
    assert close(small.H, V.T @ H @ V) < 1e-10
    assert system.two_way


@pytest.mark.parametrize("frame", ["absolute", "relative"])
def test_fixed_canonical_model_is_the_tissues_projection(comm: MPI.Intracomm, frame: str) -> None:
    """y' = V^+ [q_e'; p_e'](V y, hand) with V^+ = J'V'J, and the hand's own rows M_hand v_s' = u."""
    model = model_of(comm)
    layout = model.system.layout
    basis = some_basis(model, "qp", frame, True)
    n_s, k = layout.n_s, 2 * layout.n_s
    ref = reference(model)
    M_full, K_full = ref.P.T @ ref.M @ ref.P, ref.P.T @ ref.K @ ref.P
    M_ee, M_es = M_full[n_s:, n_s:], M_full[n_s:, :n_s]
    K_ee, K_es = K_full[n_s:, n_s:], K_full[n_s:, :n_s]
    V_q, V_p = (gather_rows(layout, X)[:, k:] for X in (basis.V_q, basis.V_p))
    m = V_q.shape[1] // 2
    J = np.block([[np.zeros((m, m)), np.eye(m)], [-np.eye(m), np.zeros((m, m))]])

    def plus(q_rate: Array, p_rate: Array) -> Array:
        return J.T @ (V_q.T @ p_rate - V_p.T @ q_rate)

    small = reduced(model, basis).at()
    rates = np.linalg.solve(small.E, np.hstack([small.A, small.B]))
    own = plus(np.linalg.solve(M_ee, V_p), -K_ee @ V_q)
    assert close(rates[k:, k : small.N], own) < 1e-10  # mass solves, as above
    if frame == "absolute":
        from_v, from_q = plus(-np.linalg.solve(M_ee, M_es), 0 * M_es), plus(0 * K_es, -K_es)
        assert close(rates[k:, n_s:k], from_v) < 1e-10  # as above
        assert close(rates[k:, :n_s], from_q) < 1e-10  # as above
    else:
        pull = M_es + M_ee @ ref.T
        assert np.abs(rates[k:, :k]).max() < 1e-12  # exact zeros but for the factorisation of E
        assert close(rates[k:, small.N :], plus(0 * pull, -pull @ np.linalg.inv(ref.M_hand))) < 1e-10  # as above
    assert close(rates[:k, :k], np.eye(k, k, n_s)) < 1e-14  # exact but for the factorisation of E
    assert close(rates[n_s:k, small.N :], np.linalg.inv(ref.M_hand)) < 1e-14  # as above


# --- new parameters


@pytest.mark.parametrize("two_way", [False, True])
def test_new_material_online_is_a_new_projection(comm: MPI.Intracomm, two_way: bool) -> None:
    changes = (DAMPED, {"effects": {"reaction": two_way, "gravity": {"g": [1.0, -9.0]}}})
    model = model_of(comm, *changes)
    other = model_of(comm, *changes, {"tissue": {"material": {"lambda": 222.0, "mu": 31.0, "rho": 1.7}}})
    for kind in KINDS:
        online = reduced(model, some_basis(model, *kind)).at(other.system.materials)
        again = reduced(other, some_basis(other, *kind)).at()
        for name, value in operators(online).items():
            # sums in another order; the entries that cancel are 1e2 times larger
            assert close(value, operators(again)[name]) < 1e-10, (name, kind)


def test_layers_change_one_by_one(comm: MPI.Intracomm) -> None:
    changes = {"tissue": {"layers": LAYERS}, "effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.01}}}
    model = model_of(comm, changes)
    new = tuple(
        LayerMaterial(30.0 + 50 * i, 400.0 - 90 * i, 1.0 + i, 0.005 * i) for i in range(len(model.system.materials))
    )
    basis = some_basis(model, "qv", "relative", True)
    online, again = reduced(model, basis).at(new), project(basis, model.system.with_materials(new)).at()
    for name, value in operators(online).items():
        assert close(value, operators(again)[name]) < 1e-10, name  # sums in another order

    canonical = some_basis(model, "qp", "absolute", True)
    heavier = tuple(replace(m, rho=2.5 * old.rho) for m, old in zip(new, model.system.materials, strict=True))
    online = reduced(model, canonical).at(heavier)
    again = project(canonical, model.system.with_materials(heavier)).at()
    for name, value in operators(online).items():
        assert close(value, operators(again)[name]) < 1e-10, name  # sums in another order
    with pytest.raises(ModelError, match="one factor"):
        reduced(model, canonical).at(new)


def test_gravity_in_any_direction(comm: MPI.Intracomm) -> None:
    model = model_of(comm, GRAVITY)
    other = model_of(comm, {"effects": {"gravity": {"g": [-4.0, 2.0], "hand_weight": True}}})
    for kind in (("qv", "absolute", False), ("qp", "relative", True)):
        online = reduced(model, some_basis(model, *kind)).at(gravity=np.array([-4.0, 2.0]))
        again = reduced(other, some_basis(other, *kind)).at()
        assert close(online.f, again.f) < 1e-14  # the same products


def test_materials_that_cannot_be_are_refused(comm: MPI.Intracomm) -> None:
    model = model_of(comm)
    rom = reduced(model, some_basis(model, "qv", "absolute", True))
    with pytest.raises(ModelError, match="layers"):
        rom.at((LayerMaterial(1.0, 1.0, 1.0),) * 2)
    for bad in (LayerMaterial(1.0, -1.0, 1.0), LayerMaterial(1.0, 1.0, 0.0), LayerMaterial(1.0, float("nan"), 1.0)):
        with pytest.raises(ModelError, match="elastic"):
            rom.at((bad,))
    with pytest.raises(ModelError, match=r"effects\.damping"):
        rom.at((LayerMaterial(1.0, 1.0, 1.0, 0.1),))


# --- structure and stability


@pytest.mark.ranks
def test_all_ranks_hold_the_same_bits(comm: MPI.Intracomm) -> None:
    model = model_of(comm, DAMPED)
    for kind in KINDS:
        rom = reduced(model, some_basis(model, *kind))
        assert all(same_everywhere(comm, value) for value in rom.parts.values())
        assert same_everywhere(comm, rom.outputs.C_z)
        assert same_everywhere(comm, rom.at().A)


@pytest.mark.parametrize("two_way", [False, True])
@pytest.mark.parametrize("damped", [False, True])
def test_canonical_models_conserve_or_lose_energy(comm: MPI.Intracomm, two_way: bool, damped: bool) -> None:
    model = model_of(comm, {"effects": {"reaction": two_way}}, DAMPED if damped else {})
    for coordinates, frame, fixed in KINDS:
        if coordinates == "qv":
            continue
        small = reduced(model, some_basis(model, "qp", frame, fixed)).at()
        inner = small.inner
        E, A = small.E[inner, inner], small.A[inner, inner]
        assert (A == A.T).all()
        assert np.linalg.eigvalsh(A).min() > -1e-13 * np.abs(A).max()  # rounding of a semidefinite matrix
        assert small.stable
        if not damped:
            assert (E == -E.T).all()
            assert small.spectral_abscissa == 0.0
        else:
            assert np.linalg.eigvalsh(E + E.T).max() < 1e-13 * np.abs(E).max()  # rounding, as above
            assert small.spectral_abscissa <= 0.0


def clamped_basis(model: Any, k: int) -> Basis:
    layout = model.system.layout
    Phi = lowest_modes(model.system, k)[1]
    zero = np.zeros_like(Phi)
    return joined(layout, np.hstack([Phi, zero]), np.hstack([zero, Phi]), zero, "qv", "relative", True, "second_order")


def test_spectrum_leaves_out_the_free_hand(comm: MPI.Intracomm) -> None:
    model = model_of(comm)
    omega = lowest_modes(model.system, 3)[0]
    small = reduced(model, clamped_basis(model, 3)).at()
    found = np.sort(small.spectrum.eigenvalues.imag)
    assert close(found, np.sort([*omega, *-omega])) < 1e-9  # the modes' own tolerance
    assert small.spectrum.zeros == 4
    assert small.spectral_abscissa == 0.0
    # a plain eigenvalue solver splits the double zeros
    plain = scipy.linalg.eigvals(small.A, small.E)
    assert close(np.sort(np.abs(plain))[4:], np.sort(np.abs(small.spectrum.eigenvalues))) < 1e-9  # as above


def test_whole_global_space_has_two_zeros_for_each_way_of_the_hand(comm: MPI.Intracomm) -> None:
    for coordinates in ("qv", "qp"):
        for frame in ("absolute", "relative"):
            model = model_of(comm, {"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.01}}})
            small = reduced(model, whole_basis(model.system.layout, coordinates, frame, False)).at()
            assert small.spectrum.zeros == 4
            omega = lowest_modes(model.system, 1)[0][0]
            # Kelvin-Voigt: the slowest decay is that of the lowest mode, beta omega^2 / 2; 1e-6 for eigenvalues of
            # a matrix of norm 1e5 whose zeros are defective
            assert abs(small.spectral_abscissa / (-0.005 * omega**2) - 1) < 1e-6


def test_unstable_models_say_so(comm: MPI.Intracomm) -> None:
    """(q, v) Galerkin with v against q: the mirror image in time of a basis that happens to damp."""
    model = model_of(comm)
    basis = some_basis(model, "qv", "absolute", True)
    small = reduced(model, replace(basis, V_p=-basis.V_p)).at()
    assert reduced(model, basis).at().spectral_abscissa < 0
    k = 2 * small.n_s
    plain = scipy.linalg.eigvals(small.A[k:, k:], small.E[k:, k:]).real.max()
    assert plain > 1e3 * GROWTH_TOLERANCE * np.abs(small.spectrum.eigenvalues).max()
    assert abs(small.spectral_abscissa / plain - 1) < 1e-8  # two eigenvalue solvers on a matrix of norm 1e3
    assert not small.stable
    with pytest.raises(UnstableModelError, match=f"N = {small.N} is unstable"):
        run(small, 0.01, np.zeros((3, 2)))
    run(small, 0.01, np.zeros((3, 2)), allow_unstable=True)


def test_dependent_columns_are_named(comm: MPI.Intracomm) -> None:
    model = model_of(comm)
    layout = model.system.layout
    twice = np.repeat(waves(layout, 1, 5), 2, axis=1)
    zero = np.zeros_like(twice)
    # exact copies: the reduced E has two equal columns
    basis = joined(
        layout, np.hstack([twice, zero]), np.hstack([zero, twice]), zero, "qp", "relative", True, "symplectic"
    )
    with pytest.raises(ModelError, match="dependent"):
        run(reduced(model, basis).at(), 0.01, np.zeros((3, 2)))


def test_hand_columns_of_a_canonical_basis_stay_out_of_the_tissue(comm: MPI.Intracomm) -> None:
    model = model_of(comm)
    basis = some_basis(model, "qp", "absolute", True)
    V_q = basis.V_q.copy()
    V_q[:, 0] = 1.0
    with pytest.raises(Exception, match="must be zero in the tissue"):
        reduced(model, replace(basis, V_q=V_q))


def test_inputs_are_left_alone(comm: MPI.Intracomm) -> None:
    model = model_of(comm)
    for kind in KINDS:
        basis = some_basis(model, *kind)
        before = [X.copy() for X in (basis.V_sq, basis.V_sv, basis.V_q, basis.V_p)]
        rom = reduced(model, basis)
        small = rom.at()
        parts = {key: value.copy() for key, value in rom.parts.items()}
        rom.at((LayerMaterial(60.0, 70.0, 2.0),))
        run(small, 0.01, np.ones((3, 2)), allow_unstable=True)
        assert all((a == b).all() for a, b in zip(before, (basis.V_sq, basis.V_sv, basis.V_q, basis.V_p), strict=True))
        assert all((value == rom.parts[key]).all() for key, value in parts.items())


def test_three_dimensions(comm: MPI.Intracomm) -> None:
    model = build(make_scene(CUBE, FORCED, {"time": {"steps": 12}, "effects": {"rotation": True}}), comm=comm)
    for kind in (("qv", "absolute", True), ("qp", "relative", True)):
        full, small_run, rom = full_and_reduced(model, whole_basis(model.system.layout, *kind))
        z, _ = rom.reconstruct(rom.at(), small_run.x.T, small_run.v_s.T)
        assert distance(model.system, z, full.snapshots.Z[: len(z)]) < 1e-9  # rounding, as above


def test_model_without_reconstruction_cannot_return_to_the_mesh(comm: MPI.Intracomm) -> None:
    model = model_of(comm, TINY)
    rom: ReducedModel = replace(reduced(model, some_basis(model, "qv", "absolute", True)), reconstruction=None)
    with pytest.raises(ModelError, match="no basis on the mesh"):
        rom.reconstruct(rom.at(), np.zeros((rom.N, 1)))


def test_files_of_earlier_versions_are_read(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    """They call the reconstruction "lift", and its checksum likewise."""
    model, file = model_of(comm, TINY), mpi_tmp_path / "rom.h5"
    rom = reduced(model, some_basis(model, "qp", "absolute", True))
    save(rom, file)
    if comm.rank == 0:
        with h5py.File(file, "r+") as data:
            data.move("reconstruction", "lift")
            del data.attrs["sha256_reconstruction"]
            write_checksums(data)
            assert set(data.attrs) == {"format", "model", "sha256", "sha256_lift"}
    comm.Barrier()
    read = load(file, model.system.layout)
    assert isinstance(read, ReducedModel)
    assert read.reconstruction is not None
    assert rom.reconstruction is not None
    np.testing.assert_array_equal(read.reconstruction.L_q, rom.reconstruction.L_q)
    comm.Barrier()
    if comm.rank == 0:
        with h5py.File(file, "r+") as data:
            data["lift/L_q"][0, 0] += 1.0
    comm.Barrier()
    with pytest.raises(ModelError, match="damaged"):
        load(file, model.system.layout)


@pytest.mark.serial
@pytest.mark.parametrize("N", [[], 3.5, "a", True, (14,), float("nan")])
def test_what_is_no_dimension_is_refused_in_one_sentence(N: object) -> None:
    model = sg.build("paper_forward", ["tissue.cells=[2, 4]", "time.steps=12"])
    run = sg.simulate(model)
    with pytest.raises(BasisError, match=r"^N = .* is no dimension; give a whole number, a Truncation or None$"):
        sg.reduce(model, run, N=N)  # type: ignore[arg-type]
    with pytest.raises(ReductionError, match=r"^3 is no run; give what softgrasp\.simulate returns"):
        sg.reduce(model, 3)  # type: ignore[arg-type]
    assert sg.reduce(model, run, N=np.int64(8)).N == 8  # a whole number of NumPy


@pytest.mark.serial
@pytest.mark.parametrize(
    ("given", "words"), [({"lam": "a"}, "lam = 'a' must"), ({"mu": [1]}, r"mu = \[1\] must"), ({"young": "x"}, "young")]
)
def test_materials_that_are_no_numbers_are_refused_in_one_sentence(given: dict[str, Any], words: str) -> None:
    with pytest.raises(SceneError, match=words):
        sg.build("paper_forward", ["tissue.cells=[2, 4]"]).with_materials(**given)
