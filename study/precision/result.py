"""What a work-precision study finds: points, slopes and the reference of every question, and the answers."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import Any

from softgrasp.fem import Scene
from softgrasp.study.precision.fit import Slope, pareto
from softgrasp.study.precision.full import Series, TimedRun
from softgrasp.study.precision.points import ReducedPoint, RunPoint, WorkPoint
from softgrasp.study.precision.settings import Setting
from softgrasp.study.report import to_json

ADVICE = {
    "space": "a finer mesh than the time allows here",
    "time": "more steps, time.steps",
    "mixed": "more steps, time.steps, on finer meshes",
}


@dataclass(frozen=True)
class ReferenceSolution:
    """The reference solution with its error estimate, relative to the largest deformation and displacement."""

    series: Series  # the solution
    space: tuple[float, float]  # part of the mesh in the estimate: (deformation, displacement)
    time: tuple[float, float]  # part of the time step in the estimate: (deformation, displacement)
    mixed: tuple[float, float]  # part of mesh and step together in the estimate: (deformation, displacement)
    settings: tuple[Setting, ...]  # that were run
    note: str  # one sentence or more

    @property
    def parts(self) -> dict[str, tuple[float, float]]:
        """Of the estimate, by name."""
        return {"space": self.space, "time": self.time, "mixed": self.mixed}

    @property
    def error(self) -> float:
        """Estimated relative error of the deformation."""
        return sum(part[0] for part in self.parts.values())

    @property
    def error_displacement(self) -> float:
        """Estimated relative error of the displacement."""
        return sum(part[1] for part in self.parts.values())

    def range_of(self, error: float) -> tuple[float, float]:
        """Between what the true error of a setting lies, when so much was measured against this reference."""
        return max(error - self.error, 0.0), error + self.error

    @property
    def largest_part(self) -> str:
        """Name of the part that carries most of the error: space, time or mixed."""
        return max(self.parts, key=lambda name: self.parts[name][0])

    @property
    def need(self) -> str:
        """What would make that part smaller."""
        return ADVICE[self.largest_part]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "note": self.note, "error": self.error, "error_displacement": self.error_displacement, **self.parts,
            "settings": [s.label for s in self.settings],
        }  # fmt: skip


@dataclass(frozen=True)
class RiccatiReference:
    """What gains are compared with: tight solutions by two methods."""

    names: tuple[str, ...]  # methods and tolerances in words
    error: float | None  # relative difference of their gains; None with one method
    residuals: tuple[float, ...]  # of both


@dataclass(frozen=True)
class ReducedReference:
    """What reduced gains are compared with."""

    method: str  # of the optimal gain
    residual: float  # of its solution
    error: float | None  # relative difference to the tightest gain of another method
    optimal: float  # cost from the scene's start


@dataclass(frozen=True)
class Question:
    """One question of a study."""

    points: tuple[WorkPoint, ...] = ()  # measured
    slopes: tuple[Slope, ...] = ()  # fitted to them
    # what the points are compared with; of reduced models and bases, the full run behind them
    reference: ReferenceSolution | TimedRun | RiccatiReference | ReducedReference | None = None
    skipped: str = ""  # why there are no points; empty when there are some

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Table rows with a mark for the front."""
        front = pareto(self.points)
        return [p.to_row() | {"pareto": p in front} for p in self.points]


@dataclass(frozen=True)
class Choice:
    """A setting that answers."""

    point: RunPoint  # measured
    shares: dict[str, float]  # about how much of its error space, time step and reduced model carry
    sets: tuple[str, ...]  # arguments of ``--set`` that run it again
    predicted: tuple[float, float] | None = None  # error and seconds; None without a prediction

    @property
    def command(self) -> str:
        """Name of the command that runs it again."""
        return "reduce" if isinstance(self.point, ReducedPoint) else "simulate"

    def to_dict(self, command: str) -> dict[str, Any]:
        """For JSON, with the whole command that runs it again."""
        row, names = self.point.to_row(), (
            "error_displacement", "error_range", "p50", "p99", "max", "scratch", "per_step",
            "error_outputs_full", "error_full",
        )  # fmt: skip
        return {
            "label": self.point.label,
            "command": command,
            "setting": {name: value for name, value in self.point.parameters.items() if value is not None},
            "set": self.sets,
            "predicted": self.predicted and dict(zip(("error", "seconds"), self.predicted, strict=True)),
            "measured": {name: row[name] for name in ("error", "seconds", *names) if name in row},
            "shares": self.shares,
        }


@dataclass(frozen=True)
class Answer:
    """The answer to a tolerance or a budget."""

    kind: str  # "tolerance" or "budget"
    limit: float  # the tolerance [1] or the budget [s]
    sentences: tuple[str, ...]  # the answer in words
    full: Choice | None = None  # best run of the full model; None where none meets the limit
    reduced: Choice | None = None  # best run of a reduced model; None where none meets the limit
    closest: Choice | None = None  # when nothing does

    @property
    def met(self) -> bool:
        """Whether something meets the limit."""
        return bool(self.full or self.reduced)

    @property
    def choices(self) -> dict[str, Choice]:
        """What the sentences name, in their order."""
        every = {"full": self.full, "reduced": self.reduced, "closest": self.closest}
        return {name: choice for name, choice in every.items() if choice is not None}


@dataclass(frozen=True)
class Source:
    """One source of error."""

    name: str  # of the source
    error: float  # that it leaves [1]
    share: float = 0.0  # of the sum of all parts [1]
    wasted: int = 0  # whole digits below a tenth of the largest part, which the largest part hides
    halved_by: str = ""  # setting that halves it; empty where none that was tried does
    cost: float | None = None  # time of that setting over the time now [1]; None without one


@dataclass(frozen=True)
class ErrorBudget:
    """Where the digits of one setting are lost; the largest part first."""

    label: str  # the setting in words
    parts: tuple[Source, ...]  # sources of error
    missing: tuple[tuple[str, str], ...] = ()  # sources that are no part of it, with the reason

    @property
    def sentence(self) -> str:
        """The largest part, and what is computed for nothing."""
        first = self.parts[0]
        text = f"Of the error of {self.label}, {first.name} carries {100 * first.share:.0f} %"
        text += f" and is halved by {first.halved_by}, in {first.cost:.2g} of the time." if first.cost else "."
        wasted = [f"{p.wasted} of {p.name}" for p in self.parts if p.wasted]
        return text + (f" Wasted digits: {', '.join(wasted)}." if wasted else "")


@dataclass(frozen=True)
class WorkStudy:
    """All that one study found."""

    scene: Scene  # the scene
    truth: ReferenceSolution | None  # solution that outputs are compared with; None when no question needed it
    questions: dict[str, Question]  # by name, in the order of softgrasp.study.precision.points.QUESTIONS
    answers: tuple[Answer, ...]  # to a tolerance and a budget
    # of the scene's own setting and of the one that answers; none without the forward question
    error_budgets: tuple[ErrorBudget, ...]
    measured_for_the_answers: tuple[WorkPoint, ...]  # points beside those of the questions
    measured: int  # number of runs made now
    cached: int  # number of runs taken from the cache

    @property
    def points(self) -> dict[str, tuple[WorkPoint, ...]]:
        """Of every question that was answered."""
        return {name: question.points for name, question in self.questions.items() if not question.skipped}

    def of[P: WorkPoint](self, kind: type[P]) -> list[P]:
        """Points of one class."""
        return [p for question in self.questions.values() for p in question.points if isinstance(p, kind)]

    @property
    def slopes(self) -> tuple[Slope, ...]:
        """Of all questions."""
        return tuple(chain.from_iterable(question.slopes for question in self.questions.values()))

    @property
    def skipped(self) -> dict[str, str]:
        """Questions without points, with the reason."""
        return {name: question.skipped for name, question in self.questions.items() if question.skipped}

    def to_dict(self) -> dict[str, Any]:
        """For JSON, without the answers."""
        references = {
            name: q.reference
            for name, q in self.questions.items()
            if isinstance(q.reference, RiccatiReference | ReducedReference)
        }
        result: dict[str, Any] = to_json(
            {
                "repeats": self.scene.study.repeats,
                "reference": None if self.truth is None else self.truth.to_dict(),
                "references": references,
                "points": {name: self.questions[name].rows for name in self.points},
                "pareto": {name: [p.label for p in pareto(points)] for name, points in self.points.items()},
                "slopes": self.slopes,
                "error_budgets": self.error_budgets,
                "skipped": self.skipped,
                "measured_for_the_answers": [p.to_row() for p in self.measured_for_the_answers],
                "runs": {"measured": self.measured, "cached": self.cached},
            }
        )
        return result
