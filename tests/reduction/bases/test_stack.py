"""Bases of one set of snapshots share tall factorisations, and are those that each makes by itself."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from softgrasp.reduction.bases import stack
from softgrasp.reduction.bases.registry import PAPER_METHODS, make_basis
from softgrasp.reduction.bases.states import States, states_of
from softgrasp.study.reduce.linear.measure import FURTHER
from tests.helpers.snapshots import case

METHODS = [key for key in (*PAPER_METHODS, *FURTHER) if key != "craig_bampton"]


@pytest.mark.ranks
def test_ten_bases_need_six_tall_factorisations(monkeypatch: pytest.MonkeyPatch) -> None:
    c, shapes, real = case(), list[int](), stack.factor

    def counted(comm: Any, X: Any, *given: Any) -> Any:
        shapes.append(X.shape[1])
        return real(comm, X, *given)

    monkeypatch.setattr(stack, "factor", counted)
    shared = states_of(c.model.system, c.snapshots)
    together = [make_basis(key, shared, 14) for key in METHODS]
    m = c.snapshots.Z.shape[1]
    # [q; v] of POD, q and v of componentwise POD, [q, p], and [q, K^-1 p] absolute and relative
    assert sorted(shapes) == 3 * [m] + 3 * [2 * m]
    for key, basis in zip(METHODS, together, strict=True):
        alone = make_basis(key, States(c.states.system, c.states.runs), 14)
        for name in ("V_sq", "V_sv", "V_q", "V_p"):  # the same operations on the same numbers
            np.testing.assert_array_equal(getattr(basis, name), getattr(alone, name), err_msg=f"{key} {name}")
