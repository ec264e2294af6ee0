"""What ``softgrasp hardcases`` finds: the cases of each family that was run, and result.json of all."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from softgrasp import package_version
from softgrasp.study.hardcases.cases import Family, HardCase
from softgrasp.study.report.files import to_json
from softgrasp.study.report.origin import machine


@dataclass(frozen=True)
class FamilyResult:
    """A family that was run: its cases and the seconds they took."""

    family: Family
    cases: tuple[HardCase, ...]
    seconds: float

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

    families: tuple[FamilyResult, ...]
    quick: bool

    @property
    def counts(self) -> dict[str, int]:
        """The counts of all families together."""
        each = [f.counts for f in self.families]
        return {name: sum(count[name] for count in each) for name in ("cases", "passed", "refused")}

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
        head = {"command": "hardcases", "version": package_version(), "machine": machine(), "quick": self.quick}
        verdict = {"ok": not self.failed, **self.counts, "failed": self.failed}
        families = {f.family.name: f.to_dict() for f in self.families}
        return dict(to_json({**head, **verdict, "families": families, "time": {"total": self.seconds}}))


def bare_label(text: str) -> str:
    """A label without the marks of mathematics, for terminals and files."""
    return text.replace("$", "").replace("\\nu", "nu")
