"""Errors of reduced models that rounding of the snapshots, another on every number of ranks, does not change."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from mpi4py import MPI

import softgrasp as sg
from softgrasp.reduction.bases.registry import find_method, make_basis
from softgrasp.reduction.bases.states import BasisError, States, states_of
from softgrasp.reduction.reduce import reduce_linear
from softgrasp.reduction.replay import FullRun, errors_linear, full_run, replay_linear
from tests.helpers.models import close
from tests.helpers.reduced import model_of, reduced, symplectic_basis

pytestmark = pytest.mark.ranks

# nearly incompressible, damped, two-way, a hand that turns: its rigid motion is 300 times the deformation
SCENE = ("tissue.cells=[2, 2, 3]", "tissue.order=1", "time.steps=20")
METHODS = ("global_pod", "componentwise_pod", "psd", "psd_svd_like", "psd_svd_like_fixed", "psd_fixed_relative")
ROUNDING = 1e-14  # relative change of every entry, that of two factorisations of one matrix
FLOOR = 3e-7  # bases with fixed solid modes in the absolute frame carry the rigid motion in two columns that cancel


@cache
def run_on(alone: bool) -> FullRun:
    model = sg.build("block_3d", SCENE, MPI.COMM_SELF if alone else MPI.COMM_WORLD)
    return full_run(model, sg.simulate(model))


def most_of(full: FullRun, name: str) -> int:
    """Largest N of a basis, by the sentence that refuses a larger one."""
    step = 2 if find_method(name).pairs else 1
    with pytest.raises(BasisError, match=r"more than the snapshots carry above rounding .*; request N <= \d+$") as e:
        make_basis(name, full_states(full), 100 * step)
    assert e.value.most is not None
    return e.value.most


def full_states(full: FullRun) -> States:
    return states_of(full.model.system, full.snapshots)


def error(full: FullRun, name: str, N: int) -> float:
    rom = reduce_linear(full.model, [full], name, N)
    return errors_linear(rom, replay_linear(rom, full.model, full, allow_unstable=True), full).error_deformation


@pytest.mark.parametrize("name", METHODS)
def test_errors_are_those_of_one_rank_and_of_rounded_snapshots(name: str) -> None:
    full = run_on(False)
    rng = np.random.default_rng(1 + MPI.COMM_WORLD.rank)
    Z = full.snapshots.Z * (1 + ROUNDING * rng.standard_normal(full.snapshots.Z.shape))
    rounded = replace(full, snapshots=replace(full.snapshots, Z=Z))
    most = most_of(full, name)
    assert most_of(rounded, name) == most_of(run_on(True), name) == most
    for N in (most - 4, most):
        own = error(full, name, N)
        for other in (run_on(True), rounded):
            # the smallest pair is right to about a tenth where it is ten times the rounding
            assert error(other, name, N) == pytest.approx(own, rel=0.1, abs=FLOOR)


@pytest.mark.parametrize("fixed", [False, True])
def test_symplectic_pairs_that_are_almost_parallel_give_the_same_model(fixed: bool) -> None:
    """(s, t) and (s, t + c s) span the same and are both symplectic; E and A of the second cancel c^2 times."""
    model = model_of(MPI.COMM_WORLD, {"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.01}}})
    layout = model.system.layout
    basis = symplectic_basis(layout, 5, "absolute", fixed)
    hand, c = 2 * layout.n_s if fixed else 0, 1e6
    shear = np.eye(basis.N)
    shear[hand : hand + 5, hand + 5 :] += c * np.eye(5)
    blocks = {key: np.asfortranarray(getattr(basis, key) @ shear) for key in ("V_sq", "V_sv", "V_q", "V_p")}
    points = 1j * np.array([0.3, 1.0, 3.0])
    exact, found = (reduced(model, b).at().transfer(points) for b in (basis, replace(basis, **blocks)))
    # columns of length c carry eps c of their partner; with the columns themselves eps c^2 = 2e-4
    assert close(found, exact) < 1e-7
