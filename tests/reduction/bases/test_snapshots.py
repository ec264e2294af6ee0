"""Snapshots that are not as they should be: tiny, zero, not finite, repeated, of several runs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.run.states.snapshots import Snapshots
from softgrasp.reduction.bases.inner import INNERS, InnerName
from softgrasp.reduction.bases.registry import METHODS, PAPER_METHODS, make_basis
from softgrasp.reduction.bases.states import BasisError, States, states_of
from tests.helpers.models import close
from tests.helpers.snapshots import (
    SNAPSHOT_METHODS,
    Case,
    case,
    dense,
    gap,
    symplecticity,
)


def changed(c: Case, **fields: Any) -> States:
    return states_of(c.model.system, replace(c.snapshots, **fields))


@pytest.mark.parametrize("inner", INNERS)
@pytest.mark.parametrize("size", [1e-300, 1e200])
def test_tiny_and_huge_snapshots_have_the_same_basis(inner: InnerName, size: float) -> None:
    c = case()
    s = c.snapshots
    scaled = changed(c, q_s=s.q_s * size, v_s=s.v_s * size, Z=np.asfortranarray(s.Z * size))
    for key in (*PAPER_METHODS, "psd_cotangent_lift_fixed", "psd_svd_like_fixed"):
        first, second = make_basis(key, c.states, 8, inner), make_basis(key, scaled, 8, inner)
        assert gap(dense(first), dense(second)) < 1e-8, key  # rounding over the gap
        assert second.sigma[0][:4] / size == pytest.approx(first.sigma[0][:4], rel=1e-8), key  # well separated


def test_zero_snapshots_are_refused() -> None:
    c = case()
    s = c.snapshots
    zero = changed(c, q_s=0 * s.q_s, v_s=0 * s.v_s, Z=np.zeros_like(s.Z, order="F"))
    for key in SNAPSHOT_METHODS:
        for size in (8, None):
            with pytest.raises(BasisError, match=r"zero|more than the snapshots carry"):
                make_basis(key, zero, size)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_snapshot_that_is_not_finite_is_named(comm: MPI.Intracomm, bad: float) -> None:
    c = case()
    Z = c.snapshots.Z.copy(order="F")
    if comm.rank == comm.size - 1:
        Z[3, 7] = bad
    for key in ("global_pod", "psd_fixed", "psd_svd_like_fixed", "componentwise_pod"):
        with pytest.raises(BasisError, match=r"snapshot 7 \(step 28\) contains NaN or infinity"):
            make_basis(key, changed(c, Z=Z), 8)


@pytest.mark.parametrize("key", ["global_pod", "psd_fixed", "psd_svd_like_fixed", "psd_cotangent_lift_fixed"])
def test_duplicated_and_deficient_snapshots(key: str) -> None:
    c = case()
    pick = np.tile([5, 15, 25, 35], 6)
    s = c.snapshots
    steps = np.arange(len(pick))
    few = Snapshots(s.layout, steps, 0.1 * steps, s.q_s[:, pick], s.v_s[:, pick], np.asfortranarray(s.Z[:, pick]))
    once = replace(
        few, steps=steps[:4], times=steps[:4] * 0.1, q_s=few.q_s[:, :4], v_s=few.v_s[:, :4],
        Z=np.asfortranarray(few.Z[:, :4]),
    )  # fmt: skip
    size = 4 + (4 if METHODS[key].fixed else 0)
    many, single = (make_basis(key, states_of(c.model.system, x), size) for x in (few, once))
    assert gap(dense(many), dense(single)) < 1e-7  # the same span; rounding over the smallest gap
    with pytest.raises(BasisError, match=r"more than the snapshots carry above rounding.*request N <= \d+"):
        make_basis(key, states_of(c.model.system, few), 40)


def test_still_hand_leaves_its_rows_zero() -> None:
    c = case()
    s = c.snapshots
    still = changed(c, q_s=0 * s.q_s, v_s=0 * s.v_s)
    for key in ("global_pod", "psd", "componentwise_pod"):
        basis = make_basis(key, still, 8)
        assert np.abs(basis.V_sq).max() < 1e-12  # rounding
        assert np.abs(basis.V_sv).max() < 1e-12  # rounding


def test_no_snapshots_and_other_mistakes_are_refused() -> None:
    c = case()
    alone = states_of(c.model.system)
    with pytest.raises(BasisError, match="there are no snapshots"):
        make_basis("psd", alone, 8)
    with pytest.raises(BasisError, match="basis 'pod' is unknown; choose one of global_pod"):
        make_basis("pod", alone, 8)
    with pytest.raises(BasisError, match="inner product 'mas' is unknown"):
        make_basis("psd", c.states, 8, "mas")  # type: ignore[arg-type]
    with pytest.raises(BasisError, match="shapes"):
        make_basis("psd", changed(c, q_s=c.snapshots.q_s[:, 1:]), 8)
    with pytest.raises(BasisError, match="N = 9 does not fit"):
        make_basis("psd_fixed", c.states, 9)


def test_runs_at_several_parameters_are_one_set_of_snapshots() -> None:
    c = case()
    stiff = c.model.system.with_materials(tuple(replace(m, mu=90.0, rho=2.6) for m in c.model.system.materials))
    both = States(c.model.system, ((c.model.system, c.snapshots), (stiff, c.snapshots)))
    blocks, one = both.columns("qp", "relative"), c.states.columns("qp", "relative")
    m = one.e_p.shape[1]
    assert np.array_equal(blocks.e_p[:, :m], one.e_p)
    assert close(blocks.e_p[:, m:], 2 * one.e_p) < 1e-13  # rho doubled: rounding
    assert symplecticity(make_basis("psd_fixed", both, 14)) < 1e-12  # goal of the issue
