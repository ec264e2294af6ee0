"""The quick half of the hard cases, family by family, and the page that shows it."""

from __future__ import annotations

import csv
import json
import math
from functools import cache
from pathlib import Path

import pytest
from rich.console import Console

from softgrasp.study.shell import Session
from tests.hardcases.cases import FamilyResult, HardCase, HardCaseResult, Outcome
from tests.hardcases.page import compose
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
    assert [(case.case, case.verdict_text, case.ours.value, case.bound) for case in cases if not case.ok] == []
    # beside each stands what the textbook way gives, a number or a sentence
    assert all(case.reference.text or case.reference.value is not None for case in cases)


# Families in which the way of a competent engineer does as well as ours; what fails stands in the remark, if anything.
EQUAL = {
    "contrast": "Jacobi-CG", "damping": "leapfrog", "long": "", "mass": "once: blows up",
    "tiny": "over the change alone", "far": "over the change alone", "resonance": "implicit Euler", "held": "unsampled",
}  # fmt: skip


def fails(case: HardCase) -> bool:
    """The textbook way has no number, breaks the bound that is kept here, or goes on where it must not."""
    value, kept = case.reference.value, case.bound
    if kept is None:
        return not case.reference.error
    return value is None or not value <= kept


@pytest.mark.parametrize("name", EQUAL)
def test_the_textbook_way_does_as_well_and_the_remark_says_what_does_not(name: str) -> None:
    cases = quick(name).cases
    assert [case.case for case in cases if fails(case)] == []
    assert any(EQUAL[name] in case.reference.text for case in cases)


@pytest.mark.parametrize("name", [name for name in FAMILIES if name not in EQUAL])
def test_the_textbook_way_fails_somewhere(name: str) -> None:
    """Otherwise the family shows nothing. Where a case must be refused, an exception is as good as a sentence."""
    assert any(fails(case) for case in quick(name).cases)


@pytest.mark.parametrize(
    ("textbook", "bound", "worse"),
    [
        (Outcome(0.5), 1.0, False),
        (Outcome(0.9, "warns: ill-conditioned"), 1.0, False),
        (Outcome(2.0), 1.0, True),
        (Outcome(math.nan), 1.0, True),
        (Outcome(None, "hangs"), 1.0, True),
        (Outcome(None, "ValueError: singular", error="ValueError"), None, False),
        (Outcome(None, "goes on"), None, True),
    ],
)
def test_what_counts_as_a_failure_of_the_textbook_way(textbook: Outcome, bound: float | None, worse: bool) -> None:
    case = HardCase("a case", 1.0, Outcome(1e-9), textbook, bound, "a reason")
    assert fails(case) is worse


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[HardCaseResult, Path]:
    out = tmp_path_factory.mktemp("hardcases")
    result = HardCaseResult(tuple(quick(name) for name in FAMILIES), quick=True)
    session = Session("hardcases", Path(), (), out, Console(quiet=True), pictures=False)
    session.write(None, result.to_dict(), lambda: compose(result, None, session), clock=False)
    return result, out


def test_files_hold_every_case(written: tuple[HardCaseResult, Path]) -> None:
    result, out = written
    numbers = json.loads((out / "result.json").read_text())
    assert numbers.pop("files") == ["result.json", "hardcases.csv", "report.html"]
    assert numbers == result.to_dict()
    with (out / "hardcases.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert len(table) == result.counts["cases"] == sum(len(quick(name).cases) for name in FAMILIES)
    page = (out / "report.html").read_text()
    assert all(family.title in page for family in FAMILIES.values())
    assert "/tmp" not in page  # messages carry no folder of this machine


def test_page_in_a_browser(written: tuple[HardCaseResult, Path]) -> None:
    assert look(written[1] / "report.html", figures=0) == []
