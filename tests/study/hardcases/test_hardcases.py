"""The quick half of the hard cases, and that the suite itself tells right from wrong."""

from __future__ import annotations

import csv
import json
import math
import typing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from pydantic import BaseModel
from rich.console import Console

from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.hardcases import faults
from softgrasp.study.hardcases import riccati as hard_riccati
from softgrasp.study.hardcases.cases import Family, HardCase, Outcome, here, textbook
from softgrasp.study.hardcases.run import FAMILIES, choose, run_hardcases
from softgrasp.study.hardcases.textbook import leapfrog, newmark, solve_twice, staggered_hand, textbook_midpoint
from softgrasp.study.shell import processes
from tests.helpers.browser import look

pytestmark = pytest.mark.serial


def quiet_console() -> Console:
    return Console(quiet=True)


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    out = tmp_path_factory.mktemp("hardcases")
    return run_hardcases(out, quiet_console(), quick=True, quiet=True, pictures=False), out


@pytest.mark.parametrize("name", FAMILIES)
def test_every_case_keeps_its_bound_or_is_refused(result: tuple[dict[str, Any], Path], name: str) -> None:
    family = result[0]["families"][name]
    assert family["rows"]
    assert [row for row in family["rows"] if not row["ok"]] == []
    # beside each stands what the textbook way gives, a number or a sentence
    assert all(row["plain"]["text"] or row["plain"]["value"] is not None for row in family["rows"])


# Families in which the way of a competent engineer does as well as ours: what fails stands in its remark.
EQUAL = {"contrast": "Jacobi-CG", "damping": "leapfrog", "mass": "once: blows up"}


@pytest.mark.parametrize("name", EQUAL)
def test_the_remark_says_what_the_plainer_way_does(result: tuple[dict[str, Any], Path], name: str) -> None:
    texts = [row["plain"]["text"] for row in result[0]["families"][name]["rows"]]
    assert any(EQUAL[name] in text for text in texts)


@pytest.mark.parametrize("name", [n for n in FAMILIES if n not in ("restart", "numbers", "outputs", *EQUAL)])
def test_the_textbook_way_does_worse_somewhere(result: tuple[dict[str, Any], Path], name: str) -> None:
    """Otherwise the family shows nothing."""
    rows = result[0]["families"][name]["rows"]

    def worse(row: dict[str, Any]) -> bool:
        a, b = row["ours"]["value"], row["plain"]["value"]
        return b is None or (a is not None and b > 10 * a) or row["must_be_refused"]

    assert any(worse(row) for row in rows)


def test_files_hold_every_case(result: tuple[dict[str, Any], Path]) -> None:
    found, out = result
    assert json.loads((out / "result.json").read_text()) == found
    with (out / "hardcases.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert len(table) == found["cases"] == sum(len(f["rows"]) for f in found["families"].values())
    page = (out / "report.html").read_text()
    assert all(family.title in page for family in FAMILIES.values())
    assert "/tmp" not in page  # messages carry no folder of this machine


def test_page_in_a_browser(result: tuple[dict[str, Any], Path]) -> None:
    assert look(result[1] / "report.html", figures=0) == []


@pytest.mark.parametrize("name", ["sigma", "edge", "deficient"])
def test_pictures(tmp_path: Path, name: str) -> None:
    """One of each kind of axis."""
    assert run_hardcases(tmp_path, quiet_console(), quick=True, family=name, quiet=True)["ok"]
    assert (tmp_path / "report.html").read_text().count("<img") == 1
    assert (tmp_path / f"hard_{name}.png").stat().st_size > 5000


def number(value: float | None, bound: float | None, **more: Any) -> HardCase:
    return HardCase("a case", 1.0, Outcome(value), Outcome(1.0), bound, "a reason", **more)


@pytest.mark.parametrize(
    ("row", "verdict", "ok"),
    [
        (number(1e-3, 1e-2), "pass", True),
        (number(1e-1, 1e-2), "fail", False),
        (number(math.nan, 1e-2), "fail", False),
        (number(math.inf, 1e-2), "fail", False),
        (number(None, 1e-2), "fail", False),
        (number(1e-3, None), "fail", False),  # had to be refused and was not
        (HardCase("a case", 1.0, Outcome(None, "no", True), Outcome(1.0), 1e-2, ""), "refused", False),
        (HardCase("a case", 1.0, Outcome(None, "no", True), Outcome(1.0), 1e-2, "", may_refuse=True), "refused", True),
        (HardCase("a case", 1.0, Outcome(None, "no", True), Outcome(1.0), None, ""), "refused", True),
    ],
)
def test_verdicts(row: HardCase, verdict: str, ok: bool) -> None:
    assert (row.verdict, row.ok) == (verdict, ok)


def test_a_failing_case_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    family = Family("bad", "A bad family", "x", "error", "textbook", "Nothing.", lambda quick: [number(1.0, 1e-2)])
    monkeypatch.setitem(FAMILIES, "bad", family)
    found = run_hardcases(tmp_path, quiet_console(), family="bad", quiet=True)
    assert not found["ok"]
    assert found["failed"] == ["bad: a case"]
    assert list(found["families"]) == ["bad"]


def test_unknown_family_is_one_sentence() -> None:
    with pytest.raises(SoftgraspError, match="'locking2' is no family of hard cases; there are locking, "):
        choose("locking2")


def test_only_our_own_errors_are_refusals() -> None:
    def refuse() -> float:
        raise SoftgraspError("no number")

    def bug() -> float:
        raise ZeroDivisionError("a bug")

    assert here(refuse) == Outcome(None, "no number", refused=True)
    with pytest.raises(ZeroDivisionError):
        here(bug)
    assert textbook(bug) == Outcome(None, "ZeroDivisionError: a bug", error="ZeroDivisionError")
    assert textbook(lambda: math.nan).text == "not a number"


def leaves(annotation: Any) -> int:
    """Numeric leaves of an annotation, independent of the JSON schema."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return sum(leaves(f.annotation) for f in annotation.model_fields.values())
    if annotation in (int, float):
        return 1
    parts = typing.get_args(annotation)
    if typing.get_origin(annotation) is typing.Literal:
        return int(all(isinstance(part, int) for part in parts))
    if typing.get_origin(annotation) is typing.Annotated:
        parts = parts[:1]
    return sum(leaves(part) for part in parts if part is not type(None))


def test_no_numeric_key_is_missed() -> None:
    """Each material can also be written by young and poisson, which no annotation knows."""
    assert len(faults.numeric_keys()) == leaves(Scene) + 4


def test_a_key_that_takes_nan_would_be_seen(tmp_path: Path) -> None:
    """A name is no number: the loader takes it, and the count says so."""
    file = tmp_path / "scene.toml"
    file.write_text(faults.SCENE)
    assert faults.accepted(file, "name", "'%s'") == ["name = nan", "name = inf", "name = -inf"]


@pytest.mark.parametrize("example", [pytest.param((n, f, p), id=n) for n, f, p in hard_riccati.EXAMPLES])
def test_known_solutions_solve_their_equations(example: tuple[str, Any, tuple[float, ...]]) -> None:
    _, make, parameters = example
    x = make(parameters[0])
    G, H = x.B @ np.linalg.solve(x.R, x.B.T), x.C.T @ x.Q @ x.C
    residual = x.A.T @ x.X + x.X @ x.A - x.X @ G @ x.X + H
    assert np.abs(residual).max() < 1e-13 * np.abs(x.X @ G @ x.X).max()  # a few roundings of the largest term
    assert np.linalg.eigvals(x.A - G @ x.X).real.max() < 0


def test_the_textbook_ways_are_right_where_they_should_be() -> None:
    """One oscillator: the implicit rules keep its energy, leapfrog blows up beyond dt = 2 / omega only."""
    M, K = scipy.sparse.csr_matrix([[1.0]]), scipy.sparse.csr_matrix([[4.0]])
    z = np.array([0.3])
    assert textbook_midpoint(M, K, z, 0.1, 1000) < 1e-12  # a thousand roundings
    stable, unstable = (leapfrog(M, K, 0 * M, z, dt, 1000).value for dt in (0.01, 1.01))
    assert stable is not None
    assert stable < 1e-3  # omega^2 dt^2 / 4 of the energy is exchanged in a period
    assert unstable == math.inf
    for D in (0 * M, scipy.sparse.csr_matrix([[0.7]])):
        kept = newmark(M, K, D, z, 1.01, 1000).value
        assert kept is not None
        assert kept < 1e-12


def test_jacobi_cg_stands_bad_scales() -> None:
    """Springs of 1, 1e6 and 1e12: three steps with the diagonal as preconditioner, ten times as many are not enough
    without it."""
    K = scipy.sparse.diags_array([1.0, 1e6, 1e12]).tocsr()
    outcome = solve_twice(K, np.ones(3), lambda z: float(np.abs(K @ z - 1).max()))
    assert outcome.value is not None
    assert outcome.value < 1e-15
    assert outcome.text.startswith("Jacobi-CG")
    assert "stops" not in outcome.text


def test_hand_and_tissue_in_turn() -> None:
    """A light hand on a heavy mass: repeated until both agree the momentum is right, once a step it is lost."""
    M, K = scipy.sparse.csr_matrix([[1.0]]), scipy.sparse.csr_matrix([[4.0]])
    light = (M, K, np.ones((1, 1)), np.ones((1, 1)), 0.01 * np.eye(1), np.ones(1), 0.01, 300)
    agreed = staggered_hand(*light).value
    assert agreed is not None
    assert agreed < 1e-10  # the tolerance 1e-12 of a step, three hundred times at most
    once = staggered_hand(*light, repeat=1).value
    assert once is not None
    assert once > 1


def test_a_loaded_machine_is_not_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    """All jobs take a hundred times as long: the same row, because the bound counts healthy runs."""
    limits: list[float] = []

    def job(command: list[str], limit: float) -> tuple[int | None, str, float]:
        limits.append(limit)
        if "allreduce" in command[1]:
            return None, "", limit  # the bare script hangs
        return (1, "cannot be written", 180.0) if "disk" in command else (0, "", 200.0)

    monkeypatch.setattr(faults, "job", job)
    for variable in processes.IN_MPI_JOB:
        monkeypatch.delenv(variable, raising=False)
    (row,) = faults.rank_rows(True)
    assert row.ok
    assert row.here.value == pytest.approx(0.9)
    assert row.textbook.value == math.inf
    assert limits[1:] == [200.0 * faults.PATIENCE, 200.0 * faults.BARE_PATIENCE]


def test_a_rank_that_waits_for_ever_fails() -> None:
    command = ["-c", faults.BARE.format(fault="raise OSError")]
    outcome = faults.ending(command, 1.0, 0.5, "")  # half a second; the bare script never ends
    assert outcome.value == math.inf
    assert not number(outcome.value, faults.PATIENCE).ok
