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
    def cases(self) -> int:
        """Number of cases."""
        return sum(len(f.cases) for f in self.families)

    @property
    def passed(self) -> int:
        """Number of cases that keep their bound."""
        return sum(f.passed for f in self.families)

    @property
    def refused(self) -> int:
        """Number of cases that are refused as they may be."""
        return sum(f.refused for f in self.families)

    @property
    def failed(self) -> list[str]:
        """Cases that break their promise, with their family."""
        return [f"{f.family.name}: {case}" for f in self.families for case in f.failed]

    @property
    def summary(self) -> str:
        """One sentence on the whole suite."""
        text = (
            f"{self.cases} cases: {self.passed} keep their bound, {self.refused} are refused as they may be, "
            f"{len(self.failed)} fail"
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
                "cases": self.cases,
                "passed": self.passed,
                "refused": self.refused,
                "failed": self.failed,
                "families": {f.family.name: f.to_dict() for f in self.families},
                "time": {"total": sum(f.seconds for f in self.families)},
            }
        )
        return result


def bare_label(text: str) -> str:
    """A label without the marks of mathematics, for terminals and files."""
    return text.replace("$", "").replace("\\nu", "nu")
