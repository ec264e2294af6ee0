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
    def passed(self) -> int:
        """Cases that keep their bound."""
        return sum(case.verdict == "pass" for case in self.cases)

    @property
    def refused(self) -> int:
        """Cases that are refused as they may be."""
        return sum(case.verdict == "refused" and case.ok for case in self.cases)

    @property
    def failed(self) -> list[str]:
        """Cases that break their promise."""
        return [case.case for case in self.cases if not case.ok]

    def to_dict(self) -> dict[str, Any]:
        """Its entry in result.json."""
        family = self.family
        return {
            "title": family.title,
            "varied": bare_label(family.varied),
            "quantity": bare_label(family.quantity),
            "plain": family.textbook,
            "lesson": family.lesson,
            "ok": not self.failed,
            "seconds": self.seconds,
            "rows": [case.to_dict() for case in self.cases],
        }


@dataclass(frozen=True)
class HardCaseResult:
    """All families that were run; ``quick``: the quick half of each."""

    families: tuple[FamilyResult, ...]
    quick: bool

    @property
    def counts(self) -> dict[str, int]:
        """Number of cases, of those that keep their bound, and of those that are refused as they may be."""
        names = {"cases": lambda f: len(f.cases), "passed": lambda f: f.passed, "refused": lambda f: f.refused}
        return {name: sum(map(count, self.families)) for name, count in names.items()}

    @property
    def failed(self) -> list[str]:
        """Cases that break their promise, with their family."""
        return [f"{f.family.name}: {case}" for f in self.families for case in f.failed]

    @property
    def summary(self) -> str:
        """One sentence on the whole suite."""
        cases, passed, refused = self.counts.values()
        text = (
            f"{cases} cases: {passed} keep their bound, {refused} are refused as they may be, {len(self.failed)} fail"
        )
        return text + (f": {'; '.join(self.failed)}" if self.failed else "")

    def to_dict(self) -> dict[str, Any]:
        """What result.json holds."""
        result: dict[str, Any] = to_json(
            {
                "command": "hardcases",
                "version": package_version(),
                "machine": machine(),
                "quick": self.quick,
                "ok": not self.failed,
                **self.counts,
                "failed": self.failed,
                "families": {f.family.name: f.to_dict() for f in self.families},
                "time": {"total": sum(f.seconds for f in self.families)},
            }
        )
        return result


def bare_label(text: str) -> str:
    """A label without the marks of mathematics, for terminals and files."""
    return text.replace("$", "").replace("\\nu", "nu")
