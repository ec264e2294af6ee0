"""The quick half of the hard cases, family by family, and the page that shows it."""

from __future__ import annotations

import csv
import json
from functools import cache
from pathlib import Path

import pytest

from tests.hardcases.cases import FamilyResult, HardCase, HardCaseResult
from tests.hardcases.page import write_files
from tests.hardcases.run import FAMILIES, run_family
from tests.helpers.browser import look

pytestmark = pytest.mark.serial


@cache
def quick(name: str) -> FamilyResult:
    return run_family(FAMILIES[name], quick=True)


@pytest.mark.parametrize("name", FAMILIES)
def test_every_case_keeps_its_bound_or_is_refused(name: str) -> None:
    cases = quick(name).cases
    assert cases
    assert [(case.case, case.verdict_text, case.here.value, case.bound) for case in cases if not case.ok] == []
    # beside each stands what the textbook way gives, a number or a sentence
    assert all(case.textbook.text or case.textbook.value is not None for case in cases)


# Families in which the way of a competent engineer does as well as ours: what fails stands in its remark.
EQUAL = {"contrast": "Jacobi-CG", "damping": "leapfrog", "mass": "once: blows up"}


@pytest.mark.parametrize("name", EQUAL)
def test_the_remark_says_what_the_plainer_way_does(name: str) -> None:
    assert any(EQUAL[name] in case.textbook.text for case in quick(name).cases)


@pytest.mark.parametrize("name", [n for n in FAMILIES if n not in ("restart", "numbers", "outputs", *EQUAL)])
def test_the_textbook_way_does_worse_somewhere(name: str) -> None:
    """Otherwise the family shows nothing."""

    def worse(case: HardCase) -> bool:
        a, b = case.here.value, case.textbook.value
        breaks = b is not None and case.bound is not None and b > case.bound
        return b is None or breaks or (a is not None and b > 10 * a) or case.bound is None

    assert any(worse(case) for case in quick(name).cases)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[HardCaseResult, Path]:
    out = tmp_path_factory.mktemp("hardcases")
    result = HardCaseResult(tuple(quick(name) for name in FAMILIES), quick=True)
    write_files(out, result, None, pictures=False)
    return result, out


def test_files_hold_every_case(written: tuple[HardCaseResult, Path]) -> None:
    result, out = written
    assert json.loads((out / "result.json").read_text()) == result.to_dict()
    with (out / "hardcases.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert len(table) == result.counts["cases"] == sum(len(quick(name).cases) for name in FAMILIES)
    page = (out / "report.html").read_text()
    assert all(family.title in page for family in FAMILIES.values())
    assert "/tmp" not in page  # messages carry no folder of this machine


def test_page_in_a_browser(written: tuple[HardCaseResult, Path]) -> None:
    assert look(written[1] / "report.html", figures=0) == []
