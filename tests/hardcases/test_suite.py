"""The suite of hard cases itself tells right from wrong."""

from __future__ import annotations

import math
import typing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from pydantic import BaseModel
from rich.console import Console
from typer.testing import CliRunner

from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.shell import processes
from tests.hardcases import faults
from tests.hardcases import riccati as hard_riccati
from tests.hardcases.__main__ import app
from tests.hardcases.cases import Family, HardCase, Outcome, here, textbook
from tests.hardcases.run import FAMILIES, choose, run_hardcases
from tests.hardcases.textbook import leapfrog, newmark, solve_twice, staggered_hand, textbook_midpoint

pytestmark = pytest.mark.serial


def quiet_console() -> Console:
    return Console(quiet=True)


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


def test_command_ends_with_the_verdict(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    family = Family("bad", "A bad family", "x", "error", "textbook", "Nothing.", lambda quick: [number(1.0, 1e-2)])
    monkeypatch.setitem(FAMILIES, "bad", family)
    line = ["--quiet", "--out", str(tmp_path), "--family"]
    assert CliRunner().invoke(app, [*line, "bad"]).exit_code == 1
    assert CliRunner().invoke(app, [*line, "edge", "--quick"]).exit_code == 0


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
    assert row.ours.value == pytest.approx(0.9)
    assert row.reference.value == math.inf
    assert limits[1:] == [200.0 * faults.PATIENCE, 200.0 * faults.BARE_PATIENCE]


def test_a_rank_that_waits_for_ever_fails() -> None:
    command = ["-c", faults.BARE.format(fault="raise OSError")]
    outcome = faults.ending(command, 1.0, 0.5, "")  # half a second; the bare script never ends
    assert outcome.value == math.inf
    assert not number(outcome.value, faults.PATIENCE).ok
