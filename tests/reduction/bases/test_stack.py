"""Bases of one set of snapshots share tall factorisations, and are those that each makes by itself."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from softgrasp.reduction.bases import stack
from softgrasp.reduction.bases.registry import PAPER_METHODS, make_basis
from softgrasp.reduction.bases.states import States, states_of
from tests.helpers.snapshots import case

FURTHER = ("psd_svd_like", "psd_svd_like_fixed", "psd_cotangent_lift_fixed", "psd_fixed_relative")
METHODS = (*PAPER_METHODS, *FURTHER)


@pytest.mark.ranks
def test_ten_bases_need_five_tall_factorisations(monkeypatch: pytest.MonkeyPatch) -> None:
    c, shapes, real = case(), list[int](), stack.factor

    def counted(comm: Any, X: Any, *given: Any) -> Any:
        shapes.append(X.shape[1])
        return real(comm, X, *given)

    monkeypatch.setattr(stack, "factor", counted)
    shared = states_of(c.model.system, c.snapshots)
    together = [make_basis(key, shared, 14) for key in METHODS]
    m = c.snapshots.Z.shape[1]
    # q and v of POD, [q, p], and [q, K^-1 p] absolute and relative
    assert sorted(shapes) == 2 * [m] + 3 * [2 * m]
    for key, basis in zip(METHODS, together, strict=True):
        alone = make_basis(key, States(c.states.system, c.states.runs), 14)
        for name in ("V_sq", "V_sv", "V_q", "V_p"):  # the same operations on the same numbers
            np.testing.assert_array_equal(getattr(basis, name), getattr(alone, name), err_msg=f"{key} {name}")


@pytest.mark.serial
def test_a_shared_factor_counts_in_the_offline_time_of_each_basis() -> None:
    c = case()
    shared = states_of(c.model.system, c.snapshots)
    times = [make_basis(key, shared, 14).seconds for key in ("psd", "psd_fixed")]
    ((*_, spent),) = [made for made in shared.kept["qp", "absolute"].kept.values() if isinstance(made, tuple)]
    assert all(seconds["factor"] >= spent > 0 for seconds in times)
    assert times[0]["snapshots"] == times[1]["snapshots"] > 0
