"""What `softgrasp effects` finds: change, cost, verdict and proof of each effect, and result.json of all."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from softgrasp.study.forward.explain import EffectReport, Explanation

COUNTED = 1e-3  # relative growth of work or memory that counts as a cost; gravity's n_s numbers do not


@dataclass(frozen=True)
class Change:
    """Largest change of the outputs over the run."""

    outputs: float  # max |y - y'| over max |y|, y the displacements of all outputs [1]
    deformation: float  # max |y - y'| over max |y|, y the outputs relative to the rigid motion of the hand [1]
    absolute: float  # max |y - y'| [m]


@dataclass(frozen=True)
class Shown:
    """What brings an effect out that does not show in the scene as it is."""

    partners: tuple[str, ...] = ()  # effects beside which it shows, though it does not in the scene as it is
    pair: bool = False  # it shows switched together with its partner, not beside it
    among: tuple[str, ...] = ()  # further effects that had to be switched for that
    together: float = 0.0  # change by it beside the partners, by the pair if it is one [1]
    forced: bool = False  # it shows only when a force moves the hand


@dataclass(frozen=True, kw_only=True)
class JointChange(Shown):
    """One effect switched alone, all others as advised."""

    change: Change  # of the outputs of the run
    control: float | None  # of the outputs under a force [1]; None when that is no question


@dataclass(frozen=True)
class Cost:
    """The scene with the effect minus the scene without it; times are medians of paired samples."""

    assembly: float  # seconds of the assembly
    setup: float  # seconds of the factor and the solves before the first step
    assembly_range: tuple[float, float]  # least and largest paired sample [s]
    setup_range: tuple[float, float]  # least and largest paired sample [s]
    assembly_noise: float  # by which the assembly of the scene differs from itself [s]
    setup_noise: float  # by which the factor and the first solves of the scene differ from themselves [s]
    step: float  # seconds of a step
    step_relative: float  # share of the step time [1]
    step_low: float  # least paired share of the step time [1]
    step_high: float  # largest paired share of the step time [1]
    step_noise: float  # share by which a step of the scene differs from itself [1]
    step_quartiles: tuple[float, float]  # lower and upper quartile of the paired shares [1]
    flops: float  # operations of PETSc in a step [1]
    flops_relative: float  # share of the operations [1]
    memory: float  # memory that the run holds [byte]
    memory_relative: float  # share of the memory [1]
    holds: tuple[str, ...]  # names of what only the scene with the effect holds
    objects: dict[str, int]  # objects that PETSc counts as created, by class

    @property
    def any(self) -> bool:
        """Whether counted work or memory grows; times are too noisy to decide."""
        return self.flops_relative > COUNTED or self.memory_relative > COUNTED

    @property
    def step_shows(self) -> bool:
        """Whether all paired samples agree that a step takes longer, or shorter, by more than the noise."""
        return (self.step_low > 0 or self.step_high < 0) and abs(self.step_relative) > self.step_noise


@dataclass(frozen=True)
class ZeroCostCheck:
    """What is counted to show that an effect that is off costs nothing; times are too noisy for it.

    Compared are the scene before the effect was tried, after it, and with the effect at strength zero, if it has one.
    """

    same_operators: bool  # hashes of all operators
    same_objects: bool  # PETSc objects by class, none of them made in the steps
    same_work: bool  # operations of a step, before and after the trial

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
    """One effect; what was not tried is None."""

    name: str  # the effect
    on: bool  # the scene has it on
    value: str  # in the scene, or the trial value
    gate: EffectReport  # number, threshold and sentence of its gate, with what explain says
    verdict: str  # needed, optional, wasted, or not tried
    advice: str  # one sentence
    change: Change | None = None  # of the outputs of the run when it is switched alone
    control: float | None = None  # change of the outputs when a force moves the hand [1]; None: not asked
    company: JointChange | None = None  # change beside all other advised effects
    cost: Cost | None = None  # of having it on
    proof: ZeroCostCheck | None = None  # for an effect that is off

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
    beside: tuple[str, ...]  # those of them that were on when each effect was switched alone
    explanation: Explanation  # of the scene as it is; its warnings are repeated in the report
    tolerance: float  # relative change that counts [1]
    repeats: int  # samples behind each median of a step
    builds: int  # samples behind each median of assembly and factor
    noise: tuple[float, float]  # step times of the scene against itself, least and largest paired ratio less 1 [1]
    noise_quartiles: tuple[float, float]  # the middle half of them [1]
    base: dict[str, float]  # the scene as it is: medians of mesh, assembly, setup, step [s], memory [byte], flops
    sizes: dict[str, int]  # n_s, n_e, states, steps and cells of the scene
    elements: Elements | None  # what P2 changes; None unless P1 may lock
    coarser: int  # unknowns of the coarser copy of a large mesh that gives all changes of the outputs [1]; 0: none

    @property
    def tried(self) -> list[EffectResult]:
        """Effects that could be switched."""
        return [f for f in self.findings if f.cost is not None]

    @property
    def off(self) -> list[EffectResult]:
        """Effects that are off, each with its proof."""
        return [f for f in self.findings if f.proof is not None]

    @property
    def warnings(self) -> tuple[str, ...]:
        """What explain warns of, and what was measured about it."""
        return (*self.explanation.warnings, *([self.elements.advice] if self.elements else []))

    def to_dict(self) -> dict[str, Any]:
        """What result.json holds."""
        own = ("tolerance", "repeats", "builds", "noise", "base", "advised", "warnings", "sizes", "coarser")
        return {name: getattr(self, name) for name in own} | {
            "effects": {f.name: f.to_dict() for f in self.findings},
            "off_is_free": all(f.proof.holds for f in self.off if f.proof),
            "missing": self.explanation.missing,
            "idle": self.explanation.idle,
            "elements": None if self.elements is None else asdict(self.elements),
        }
