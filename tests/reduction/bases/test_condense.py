"""Few columns carry all snapshots: bases and errors from them are those from all columns."""

from __future__ import annotations

from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest

from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.file import load_scene
from softgrasp.reduction.bases.condense import Condensed, condense, condensed
from softgrasp.reduction.bases.registry import make_bases
from softgrasp.reduction.bases.states import BasisError, states_of
from softgrasp.reduction.reduce import errors, project_scene, replay
from softgrasp.reduction.replay import FullRun, full_run
from tests.helpers.models import gather_states

PAPER = Path(__file__).parents[3] / "demos" / "scenes" / "paper_forward.toml"
METHODS = ("global_pod", "componentwise_pod_fixed", "psd", "psd_svd_like_fixed", "psd_fixed_relative")


@pytest.fixture(scope="module")
def run() -> FullRun:
    """2n = 212 and 301 snapshots."""
    model = build(load_scene(PAPER, ["tissue.cells=[5,10]", "time.steps=300"]))
    return full_run(model, simulate(model))


@pytest.mark.ranks
def test_few_columns_carry_all_snapshots(run: FullRun) -> None:
    made, own = condense(run.snapshots), run.snapshots
    assert made is not None
    r = made.W.shape[1]
    assert r < 0.8 * own.Z.shape[1]
    assert np.abs(made.W.T @ made.W - np.eye(r)).max() < 1e-13  # rounding of an SVD
    layout = own.layout
    (z, v), (z_few, v_few) = (np.vsplit(gather_states(layout, X), 2) for X in (own.Z, made.few.Z))
    pairs = [(z, z_few), (v, v_few), (own.q_s, made.few.q_s), (own.v_s, made.few.v_s)]
    for X, few in pairs:
        # at most 300 singular values of 1e-15 are left out
        assert np.linalg.norm(X - few @ made.W.T) < 1e-13 * np.linalg.norm(X)
    assert condense(run.snapshots) is made


@pytest.mark.ranks
@pytest.mark.parametrize("name", METHODS)
def test_bases_and_errors_from_few_columns_are_those_from_all(run: FullRun, name: str) -> None:
    """Vectors to the rounding of the run over the gaps of the singular values, which are 1e-3 and more up to N = 14."""
    fresh = replace(run, snapshots=replace(run.snapshots))
    assert Condensed not in fresh.snapshots.kept
    system, layout = run.model.system, run.snapshots.layout
    every = states_of(system, fresh.snapshots)
    few = condensed(states_of(system, run.snapshots))
    for one, other in zip(make_bases(name, every, [8, 14]), make_bases(name, few, [8, 14]), strict=True):
        for a, b in zip(one.sigma, other.sigma, strict=True):
            k = min(len(a), len(b))
            assert np.abs(a[:k] - b[:k]).max() < 1e-12 * a[0]
        V, W = (gather_states(layout, np.vstack([basis.V_q, basis.V_p])) for basis in (one, other))
        first = 4 if one.fixed_solid else 0  # columns of the hand alone
        V, W = (np.linalg.qr(X[:, first:])[0] for X in (V, W))
        assert np.linalg.norm(V - W @ (W.T @ V)) < 1e-8
        rom = project_scene(one, run.model)
        reduced = replay(rom, run.model, fresh, allow=True)
        assert astuple(errors(rom, reduced, run.model, run)) == pytest.approx(
            astuple(errors(rom, reduced, run.model, fresh)), rel=1e-10
        )


def test_snapshots_that_are_not_finite_are_refused(run: FullRun) -> None:
    Z = run.snapshots.Z.copy(order="F")
    Z[3, 2] = np.nan
    with pytest.raises(BasisError, match="NaN"):
        condensed(states_of(run.model.system, replace(run.snapshots, Z=Z)))


def test_few_columns_that_would_not_pay_are_all_columns(run: FullRun) -> None:
    """Seven snapshots of a motion are independent, and a body at rest has zeros."""
    some = run.snapshots.columns(np.arange(20, 300, 40))
    assert condense(some) is None
    assert some.kept == {Condensed: None}  # nothing that holds the snapshots themselves
    zero = replace(some, Z=np.zeros_like(some.Z, order="F"), q_s=0 * some.q_s, v_s=0 * some.v_s)
    assert condense(zero) is None
