"""A hard case: a number from here and from the textbook way, a bound with its reason, and a verdict."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from softgrasp import __version__
from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import PETSc, to_scipy
from softgrasp.fem.scene.file import shipped_scenes
from softgrasp.study.report.files import to_json
from softgrasp.study.report.origin import machine

Array = NDArray[np.float64]
Verdict = Literal["pass", "fail", "refused"]
EPS = float(np.finfo(float).eps)
LENGTH = 400  # characters of a message that are kept


@dataclass(frozen=True)
class Outcome:
    """Result of one way: a number, or the sentence with which it ended."""

    value: float | None  # the measured number; None when there is none
    text: str = ""  # the refusal or failure in words, or a remark on the number
    refused: bool = False  # it ended by one of our own errors
    error: str = ""  # name of the exception that ended the textbook way

    def __str__(self) -> str:
        """Number and remark as a table shows them."""
        number = "" if self.value is None else f"{self.value:.3g}" if self.value >= 100 else f"{self.value:.2g}"
        return f"{number} ({self.text})" if number and self.text else number or self.text


@dataclass(frozen=True)
class HardCase:
    """One case."""

    case: str  # what is special, in words
    x: float  # the varied number, the position in the picture
    ours: Outcome  # result of softgrasp
    reference: Outcome  # result of the textbook way
    bound: float | None  # the number from here must not exceed it; None when the case has to be refused
    reason: str  # where the bound comes from
    may_refuse: bool = False  # a refusal is as good as a number within the bound
    group: str = ""  # curve of the picture it belongs to

    @property
    def verdict(self) -> Verdict:
        """Within the bound, above it, or refused with a sentence. NaN is above every bound."""
        if self.ours.refused:
            return "refused"
        if self.ours.value is None or self.bound is None:
            return "fail"
        return "pass" if self.ours.value <= self.bound else "fail"

    @property
    def ok(self) -> bool:
        """Whether the promise is kept: stable where it can be, refused where it must be."""
        if self.verdict == "refused":
            return self.bound is None or self.may_refuse
        return self.verdict == "pass"

    @property
    def verdict_text(self) -> str:
        """The verdict with the sentence of a refusal."""
        if self.verdict == "refused":
            return f"refused: {self.ours.text}" if self.ok else f"fail, refused: {self.ours.text}"
        return self.verdict

    @property
    def bound_text(self) -> str:
        """The bound as a table shows it."""
        if self.bound is None:
            return "must be refused"
        return f"<= {self.bound:.2g}" + (" or refused" if self.may_refuse else "")

    def to_dict(self) -> dict[str, Any]:
        """Its entry in result.json."""
        return {
            "case": self.case, "x": self.x, "group": self.group, "bound": self.bound,
            "must_be_refused": self.bound is None, "may_be_refused": self.may_refuse, "reason": self.reason,
            "ours": self.ours, "plain": self.reference, "verdict": self.verdict_text, "ok": self.ok,
        }  # fmt: skip


@dataclass(frozen=True)
class Family:
    """Cases that vary one thing."""

    name: str  # short name, as `--family` takes it
    title: str  # what is hard, in words
    varied: str  # label of the varied number with its unit
    quantity: str  # label of the measured number with its unit
    textbook: str  # the textbook way in a few words
    lesson: str  # what the comparison shows, one or two sentences
    cases: Callable[[bool], Iterable[HardCase]]  # runs them; True for the quick half
    # of the varied number in the picture: a logarithm, linear, or the cases one below the other
    axis: Literal["log", "linear", "listed"] = "log"


@dataclass(frozen=True)
class FamilyResult:
    """A family that was run: its cases and the seconds they took."""

    family: Family  # the family that was run
    cases: tuple[HardCase, ...]  # its cases in their order
    seconds: float  # wall time of all its cases [s]

    @property
    def counts(self) -> dict[str, int]:
        """Number of cases, of those that keep their bound, and of those that are refused as they may be."""
        verdicts = [case.verdict if case.ok else "fail" for case in self.cases]
        return {"cases": len(verdicts), "passed": verdicts.count("pass"), "refused": verdicts.count("refused")}

    @property
    def failed(self) -> list[str]:
        """Cases that break their promise."""
        return [case.case for case in self.cases if not case.ok]

    def to_dict(self) -> dict[str, Any]:
        """Its entry in result.json."""
        family = self.family
        labels = {"varied": bare_label(family.varied), "quantity": bare_label(family.quantity)}
        texts = {"title": family.title, **labels, "plain": family.textbook, "lesson": family.lesson}
        rows = [case.to_dict() for case in self.cases]
        return {**texts, "ok": not self.failed, "seconds": self.seconds, "rows": rows}


@dataclass(frozen=True)
class HardCaseResult:
    """All families that were run; ``quick``: the quick half of each."""

    families: tuple[FamilyResult, ...]  # results in the order of the families
    quick: bool  # whether only the quick half was run

    @property
    def counts(self) -> dict[str, int]:
        """The counts of all families together."""
        return {name: sum(f.counts[name] for f in self.families) for name in ("cases", "passed", "refused")}

    @property
    def failed(self) -> list[str]:
        """Cases that break their promise, with their family."""
        return [f"{f.family.name}: {case}" for f in self.families for case in f.failed]

    @property
    def seconds(self) -> float:
        """What all took."""
        return sum(f.seconds for f in self.families)

    @property
    def summary(self) -> str:
        """One sentence on the whole suite."""
        cases, passed, refused = self.counts.values()
        text = f"{cases} cases: {passed} keep their bound, {refused} are refused as they may be, "
        return f"{text}{len(self.failed)} fail" + (f": {'; '.join(self.failed)}" if self.failed else "")

    def to_dict(self) -> dict[str, Any]:
        """What result.json holds."""
        head = {"command": "hardcases", "version": __version__, "machine": machine(), "quick": self.quick}
        verdict = {"ok": not self.failed, **self.counts, "failed": self.failed}
        families = {f.family.name: f.to_dict() for f in self.families}
        return dict(to_json({**head, **verdict, "families": families, "time": {"total": self.seconds}}))


def bare_label(text: str) -> str:
    """A label without the marks of mathematics, for terminals and files."""
    return text.replace("$", "").replace("\\nu", "nu")


# --- how a case is run


def short(text: str) -> str:
    """A message without the folders of this machine, cut where it is long."""
    text = re.sub(r"/\S*/(?=[^/\s])", "", text)
    return text if len(text) <= LENGTH else text[: LENGTH - 3] + "..."


def _first_line(error: BaseException) -> str:
    return short(next(iter(str(error).strip().splitlines()), type(error).__name__))


def here(work: Callable[..., float], *arguments: Any) -> Outcome:
    """Run a case here; one of our own errors is a refusal, any other exception goes through."""
    try:
        return Outcome(float(work(*arguments)))
    except SoftgraspError as error:
        return Outcome(None, _first_line(error), refused=True)


def textbook(work: Callable[..., float | Outcome], *arguments: Any) -> Outcome:
    """Run the textbook way; whatever it raises or warns is its outcome."""
    with np.errstate(all="ignore"), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            result = work(*arguments)
        except Exception as error:  # the point of the comparison is how it fails
            name = type(error).__name__
            return Outcome(None, f"{name}: {_first_line(error)}", error=name)
    if isinstance(result, Outcome):
        return result
    value = float(result)
    notes = [str(w.message) for w in caught if not issubclass(w.category, DeprecationWarning)]
    text = "" if math.isfinite(value) else "overflow" if math.isinf(value) else "not a number"
    note = f"warns: {notes[0].splitlines()[0][:80]}" if notes and not text else text
    return Outcome(value, note)


def make(name: str, *overrides: str, comm: MPI.Intracomm = MPI.COMM_SELF) -> Model:
    """Build a shipped scene with overrides of the form `section.key=value`. Collective."""
    return build(shipped_scenes()[name], overrides, comm)


def scaled_condition(A: PETSc.Mat) -> float:
    """Condition of a symmetric positive definite matrix with its diagonal scaled to one [VDS69].

    Up to the size of the matrix it is the least that any diagonal scaling reaches, and what Cholesky's error depends
    on. For matrices of hundreds of rows.
    """
    dense = np.asarray(to_scipy(A).toarray())
    scale = 1 / np.sqrt(np.diag(dense))
    values = np.linalg.eigvalsh(scale[:, None] * dense * scale)
    return float(values[-1] / values[0])


def qr_rounding(rows: int, columns: int) -> float:
    """Bound on |Q'Q - I| of Householder's QR without its constant, rows x columns x eps [H02]."""
    return rows * columns * EPS


def thin(values: Sequence[float], quick: bool) -> list[float]:
    """All values, or for the quick half the first, the middle and the last."""
    return list(dict.fromkeys([values[0], values[len(values) // 2], values[-1]])) if quick else list(values)
