"""What `softgrasp effects` finds: change, cost, verdict and proof of each effect, and result.json of all."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from softgrasp.study.forward.explain import EffectReport, Explanation


@dataclass(frozen=True)
class Change:
    """Largest change of the outputs over the run."""

    outputs: float  # max |y - y'| over max |y|, y the displacements of all outputs [1]
    deformation: float  # the same of the outputs relative to the rigid motion of the hand [1]
    absolute: float  # max |y - y'| [m]


@dataclass(frozen=True)
class Company:
    """One effect tried beside all others that are advised."""

    change: Change  # of the outputs when it alone is switched, the others as advised
    control: float | None  # the same under a force [1]; None when that is no question
    # effects whose switching makes it show, though it does not show in the scene as it is
    partners: tuple[str, ...] = ()
    either: bool = False  # it and its partner are on, each can go, but not both
    together: float = 0.0  # change that made it count beside the partners [1]
    forced: bool = False  # it shows only when a force moves the hand


COUNTED = 1e-3  # relative growth of work or memory that counts as a cost; gravity's n_s numbers do not


@dataclass(frozen=True)
class Cost:
    """What the effect adds: the scene with it minus the scene without it."""

    # assembly, setup, step: seconds, medians of paired samples; setup is factor and solves before the first step
    assembly: float
    setup: float
    # assembly_range, setup_range: smallest and largest paired sample [s]
    assembly_range: tuple[float, float]
    setup_range: tuple[float, float]
    step: float
    step_relative: float  # added share of a step's time [1]
    # step_low, step_high: smallest and largest paired share [1]
    step_low: float
    step_high: float
    step_noise: float  # share that a step of the scene differs from itself by [1]
    step_quartiles: tuple[float, float]  # lower and upper quartile of the paired shares [1]
    flops: float  # added operations of PETSc in a step [1]; flops_relative: their share
    flops_relative: float
    memory: float  # added memory [byte]; memory_relative: its share
    memory_relative: float
    holds: tuple[str, ...]  # names of what only the scene with the effect holds
    objects: dict[str, int]  # what PETSc counts as created more, by class

    @property
    def any(self) -> bool:
        """Whether counted work or memory grows; times are too noisy to decide."""
        return self.flops_relative > COUNTED or self.memory_relative > COUNTED

    @property
    def step_shows(self) -> bool:
        """Whether all paired samples agree that a step takes longer, or shorter, by more than the noise."""
        return (self.step_low > 0 or self.step_high < 0) and abs(self.step_relative) > self.step_noise


@dataclass(frozen=True)
class OffProof:
    """What is counted to show that an effect that is off costs nothing; times are too noisy for it."""

    # the hashes of all operators are the same before the effect was tried, after it, and with the effect named at
    # strength zero, where it has one
    same_operators: bool
    same_objects: bool  # PETSc's log counts the same objects in these three, by class, and none in the steps
    same_work: bool  # as many operations in a step after the trial as before

    @property
    def holds(self) -> bool:
        """Whether all are the same."""
        return all(asdict(self).values())


@dataclass(frozen=True)
class Elements:
    """What quadratic elements on the same mesh change where linear ones may lock."""

    nu: float  # largest ratio of Poisson in the tissue [1]
    change: Change  # of the outputs of the run, P2 against P1
    unknowns: float  # n_e with P2 over n_e with P1 [1]
    needed: bool  # the change is above the tolerance
    advice: str  # one sentence


@dataclass(frozen=True)
class EffectResult:
    """One effect."""

    name: str  # the effect
    on: bool  # the scene has it on
    value: str  # in the scene, or the trial value
    gate: EffectReport  # number, threshold and sentence of its gate, with what explain says
    verdict: str  # needed, optional, wasted, or not tried
    advice: str  # one sentence
    change: Change | None  # of the outputs of the run; None when not tried
    # change of the outputs when a force moves the hand; None when that is no question, or not needed to judge
    control: float | None
    company: Company | None  # the same tried again beside all other advised effects; None when not tried
    cost: Cost | None  # None when not tried
    proof: OffProof | None  # for an effect that is off

    @property
    def label(self) -> str:
        """The verdict as a reader takes it: an effect that is off is not, but would be wasted."""
        return "would be wasted" if self.verdict == "wasted" and not self.on else self.verdict

    @property
    def together(self) -> float | None:
        """Change of the outputs beside the effects that bring it out [1]; None when it needs none."""
        return self.company.together if self.company is not None and self.company.partners else None

    def to_dict(self) -> dict[str, Any]:
        """Its entry in result.json."""
        entry = asdict(self) | {"gate": asdict(self.gate.gate)}
        del entry["name"]
        if self.cost is not None:
            entry["cost"]["any"] = self.cost.any
        if self.proof is not None:
            entry["proof"]["holds"] = self.proof.holds
        return entry


@dataclass(frozen=True)
class EffectsStudy:
    """All findings of a scene."""

    findings: tuple[EffectResult, ...]  # in the order of `fem.effects.EFFECTS`
    advised: tuple[str, ...]  # effects that are on when every advice is followed, for control alone included
    explanation: Explanation  # of the scene as it is; its warnings are repeated in the report
    tolerance: float  # relative change that counts [1]
    repeats: int  # samples behind each median of a step; builds may have fewer
    builds: int  # samples behind each median of assembly and factor
    noise: tuple[float, float]  # step times of the scene against itself, smallest and largest paired ratio less 1 [1]
    noise_quartiles: tuple[float, float]  # the middle half of them [1]
    base: dict[str, float]  # medians of the scene as it is: assembly, setup, step [s], and memory [byte]
    sizes: dict[str, int]  # n_s, n_e, states, steps and cells of the scene
    elements: Elements | None  # what P2 changes; None unless P1 may lock

    @property
    def warnings(self) -> tuple[str, ...]:
        """What explain warns of, and what was measured about it."""
        return (*self.explanation.warnings, *([self.elements.advice] if self.elements else []))

    def to_dict(self) -> dict[str, Any]:
        """What result.json holds."""
        own = ("tolerance", "repeats", "builds", "noise", "base", "advised", "warnings", "sizes")
        return {name: getattr(self, name) for name in own} | {
            "effects": {f.name: f.to_dict() for f in self.findings},
            "off_is_free": all(f.proof.holds for f in self.findings if f.proof is not None),
            "missing": self.explanation.missing,
            "idle": self.explanation.idle,
            "elements": None if self.elements is None else asdict(self.elements),
        }
