"""Certified models over their box: bound and estimate beside full runs, and the figures that show them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import Model, build
from softgrasp.reduction.certified.model import CertifiedModel, ParameterDomain
from softgrasp.study.reduce.certified.measure import BoxCheck, check_box, sizes_of
from softgrasp.study.reduce.certified.page import tests_table as table_of
from softgrasp.study.reduce.certified.plots import draw
from tests.helpers.certified import KELVIN_VOIGT, error_to, full_at, ritz
from tests.helpers.models import make_scene

BOX = ParameterDomain((30.0, 500.0), (20.0, 500.0))


@cache
def checked() -> tuple[Model, CertifiedModel, BoxCheck]:
    model = build(make_scene(KELVIN_VOIGT), comm=MPI.COMM_WORLD)
    rounds = [{"k": k, "bound": bound} for k, bound in ((4, np.inf), (8, 0.3), (12, 0.02))]
    training = {"rounds": rounds, "chosen": [(120.0, 100.0), (30.0, 20.0), (30.0, 20.0)]}
    certified = ritz(model, 6, 12, box=BOX, training=training)
    check = check_box(model, certified)
    assert check is not None
    return model, certified, check


@pytest.mark.ranks(2)
def test_the_bound_is_above_the_truth_at_every_test() -> None:
    model, certified, check = checked()
    assert [(s.k, s.k2) for s in check.sizes] == sizes_of(certified)
    assert check.own.k == 6
    for size in check.sizes:
        assert len(size.tested) == 25
        assert all(t.bound >= t.truth * (1 - 1e-9) > 0 for t in size.tested)  # exact but for rounding
        assert size.query > 0
    first = check.own.tested[7]
    system, full = full_at(model, certified.materials(first.lam, first.mu))
    error, size_of_solution = error_to(
        system, full, certified, certified.run(certified.materials(first.lam, first.mu), allow=True)
    )
    assert first.truth == pytest.approx(float(error.max()) / size_of_solution, rel=1e-6)  # a difference of two runs
    assert BOX.lam[0] < first.lam < BOX.lam[1]


def test_a_hand_with_an_error_of_its_own_is_not_checked() -> None:
    model, certified, _ = checked()
    forced = replace(certified, fine=replace(certified.fine, two_way=True))
    assert certified.drive is not None
    drive = replace(certified.drive, hand=None, force=np.zeros((certified.drive.steps, 2)), finer=None)
    assert check_box(model, replace(forced, drive=drive)) is None


def test_figures_and_table(tmp_path: Path) -> None:
    _, certified, check = checked()
    files = draw(tmp_path, certified, check, 0.05)
    assert {f.name for f in files if f.suffix == ".png"} == {
        "certified_box.png", "certified_greedy.png", "certified_sizes.png",
    }  # fmt: skip
    assert all(f.stat().st_size > 5000 for f in files)
    assert len(draw(tmp_path, certified, None, 0.05)) == len(files) // 3  # the greedy alone
    assert len(table_of(check).rows) == 25 * len(check.sizes)
