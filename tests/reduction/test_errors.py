"""Errors of reduced runs against dense matrices, of one model and of a family that shares one factorisation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.run.simulate import simulate
from softgrasp.reduction import errors as module
from softgrasp.reduction.errors import VIEWS, ModelComparison, Span, full_energy, prepare
from softgrasp.reduction.online import run
from softgrasp.reduction.replay import full_run, replay_linear
from softgrasp.reduction.system import ModelError
from tests.helpers.models import Array, close, gather_matrix, gather_rows, gather_states
from tests.helpers.reduced import (
    FORCED,
    KINDS,
    force_of,
    leading,
    model_of,
    reduced,
    step_of,
    symplectic_basis,
    whole_basis,
)

pytestmark = pytest.mark.ranks

DAMPED = {"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.01}}}
norm = np.linalg.norm


@pytest.mark.parametrize("whole", [True, False], ids=["alone", "of a family"])
def test_errors_against_dense_matrices(comm: MPI.Intracomm, whole: bool) -> None:
    """Errors of N = 6 (and the hand), computed from the model alone or from one of N = 10."""
    model = model_of(comm, DAMPED, FORCED, {"output": {"every": 3}})
    layout, system = model.system.layout, model.system
    full, dt = simulate(model), step_of(model)
    snapshots = full.snapshots
    T, G = gather_rows(layout, system.T), gather_rows(layout, system.G)
    M = gather_matrix(layout, system.M_ee)
    z, v = np.split(gather_states(layout, snapshots.Z), 2)
    energy = full_energy(system, snapshots.Z)

    def views(z: Array, v: Array, q_s: Array, v_s: Array) -> list[Array]:
        absolute = np.concatenate([q_s, z + T @ q_s, v_s, v + T @ v_s])
        canonical = np.concatenate([q_s, z + T @ q_s, system.M_hand @ v_s, M @ v + G @ v_s])
        return [absolute, canonical, np.concatenate([z, v])]

    exact = views(z, v, snapshots.q_s, snapshots.v_s)
    for coordinates, frame, fixed in KINDS:
        large = symplectic_basis(layout, 5, frame, fixed, coordinates)
        rom = reduced(model, leading(large, 3))
        small = rom.at()
        largest = rom if whole else reduced(model, large)
        comparison = ModelComparison(largest, largest.at(), system, snapshots, energy)
        own = run(small, dt, force_of(model), allow_unstable=True)
        errors = comparison.errors(rom, small, own)
        q_s, v_s = own.q_s[::3].T, own.v_s[::3].T
        z_r, v_r = (gather_rows(layout, part) for part in rom.reconstruct(small, own.x[::3].T, v_s))
        found = (errors.error, errors.error_canonical, errors.error_deformation)
        for mine, X, X_r in zip(found, exact, views(z_r, v_r, q_s, v_s), strict=True):
            assert mine == pytest.approx(norm(X_r - X) / norm(X), rel=1e-10)  # sums in another order
        peak = np.abs(small.energy(own.x[::3]) - energy).max() / energy.max()
        assert errors.error_energy == pytest.approx(peak, rel=1e-12)  # the same products
        # everything that the model can show
        eye = np.eye(small.N)
        shown = views(*(gather_rows(layout, part) for part in rom.reconstruct(small, eye)),
                      small.S_q, small.S_v)  # fmt: skip
        for view, mine, X, V in zip(("velocities", "momenta"), found, exact, shown, strict=False):
            least = norm(X - V @ scipy.linalg.lstsq(V, X)[0]) / norm(X)
            projected = comparison.projection_error(view, rom, small)
            assert projected == pytest.approx(least, rel=1e-8)  # least squares, condition 1e4
            assert mine > least


def test_a_model_outside_the_family_is_refused(comm: MPI.Intracomm) -> None:
    model = model_of(comm)
    snapshots = simulate(model).snapshots
    basis = symplectic_basis(model.system.layout, 3, "relative", True)
    rom, other = reduced(model, basis), reduced(model, replace(basis, V_q=basis.V_p, V_p=basis.V_q))
    comparison = ModelComparison(rom, rom.at(), model.system, snapshots, full_energy(model.system, snapshots.Z))
    with pytest.raises(ModelError, match="larger than the one that the errors were prepared for"):
        comparison.projection_error("deformation", other, other.at())


def test_errors_of_the_full_space_vanish(comm: MPI.Intracomm) -> None:
    model = model_of(comm, DAMPED)
    snapshots: Any = simulate(model).snapshots
    rom = reduced(model, whole_basis(model.system.layout, "qp", "absolute", True))
    small = rom.at()
    comparison = ModelComparison(rom, small, model.system, snapshots, full_energy(model.system, snapshots.Z))
    errors = comparison.errors(rom, small, run(small, step_of(model), force_of(model)))
    # rounding of 30 steps in other coordinates
    assert max(errors.error, errors.error_canonical, errors.error_deformation, errors.error_energy) < 1e-9
    assert comparison.projection_error("velocities", rom, small) < 1e-13  # the whole space leaves rounding
    with pytest.raises(ModelError, match="reach step 30"):
        comparison.errors(rom, small, run(small, 0.1, np.zeros((5, 2))))


def test_a_pushed_model_repeats_a_led_run_of_which_few_states_are_kept(comm: MPI.Intracomm) -> None:
    """In the whole space it is the full model; the force comes from the run, not from its states.

    Positions part, for the profile of the scene gives them beside the velocities that the steps take.
    """
    effects = DAMPED["effects"] | {"reaction": True, "gravity": {"g": [1.0, -9.0], "hand_weight": True}}
    model = model_of(comm, {"effects": effects, "motion": {"drive": "motion"}, "output": {"every": 3}})
    full = full_run(model, simulate(model))
    rom = reduced(model, whole_basis(model.system.layout, "qp", "absolute", False))
    again = replay_linear(rom, model, full)
    # rounding of 30 steps in other coordinates
    assert close(again.v_s, full.trajectory.v_s) < 1e-9
    assert close(again.outputs - again.q_s, full.trajectory.outputs - full.trajectory.q_s) < 1e-9


def test_what_a_model_shows_is_put_into_the_span_once(comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors and least errors of one model take three views, and the numbers of another model are its own."""
    model = model_of(comm)
    snapshots: Any = simulate(model).snapshots
    layout, energy = model.system.layout, full_energy(model.system, snapshots.Z)
    large = symplectic_basis(layout, 5, "relative", True)
    roms = [reduced(model, leading(large, k)) for k in (3, 5)]
    comparison = ModelComparison(roms[1], roms[1].at(), model.system, snapshots, energy)
    calls: list[int] = []
    inside = Span.inside
    monkeypatch.setattr(Span, "inside", lambda self, V: calls.append(V.shape[1]) or inside(self, V))
    for rom in roms:
        small = rom.at()
        own = run(small, step_of(model), force_of(model), allow_unstable=True)
        alone = ModelComparison(rom, small, model.system, snapshots, energy)
        for fresh, each in ((True, alone), (False, comparison)):
            calls.clear()
            found = each.errors(rom, small, own)
            least = [each.projection_error(view, rom, small) for view in VIEWS]
            assert len(calls) == 3
            if fresh:
                expected = found, least
        assert found.error == pytest.approx(expected[0].error, rel=1e-10)  # sums in another order
        assert least == pytest.approx(expected[1], rel=1e-8)  # least squares, condition 1e4


def test_snapshots_are_read_once_for_all_views_sizes_and_families(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = model_of(comm)
    snapshots: Any = simulate(model).snapshots
    energy = full_energy(model.system, snapshots.Z)
    large = symplectic_basis(model.system.layout, 5, "relative", True)
    roms = [reduced(model, leading(large, k)) for k in (3, 5)]
    readings: list[int] = []
    blocks = module.column_blocks
    monkeypatch.setattr(module, "column_blocks", lambda m: readings.append(m) or blocks(m))
    # sizes of one family: states, momenta, deformation and what a basis of each size can show
    family = ModelComparison(roms[1], roms[1].at(), model.system, snapshots, energy)
    for rom in roms:
        small = rom.at()
        family.errors(rom, small, run(small, step_of(model), force_of(model), allow_unstable=True))
        family.projection_error("velocities", rom, small)
    assert len(readings) == 1
    # two families together, and the numbers of each alone
    two = [ModelComparison(rom, rom.at(), model.system, snapshots, energy) for rom in roms]
    prepare(two, ["deformation"])
    assert len(readings) == 2
    for rom, together in zip(roms, two, strict=True):
        found = together.projection_error("deformation", rom, rom.at())
        # the largest model of the other family, least squares of condition 1e4
        assert found == pytest.approx(family.projection_error("deformation", rom, rom.at()), rel=1e-8)
    assert len(readings) == 2
