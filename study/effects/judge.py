"""Cost, verdict and proof for one effect, from the cases that `study.effects.measure` measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.effects import EFFECTS
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.simulate import Run, RunOptions
from softgrasp.study.effects.measure import Case, fingerprint, nothing_of, objects_of
from softgrasp.study.effects.objects import difference
from softgrasp.study.effects.switch import neutral

COUNTED = 1e-3  # relative growth of work or memory that counts as a cost; gravity's n_s numbers do not
TIMER = 0.03  # relative difference of two equal runs that cache and page placement can leave in every sample


@dataclass(frozen=True)
class Cost:
    """What the effect adds: the scene with it minus the scene without it.

    Attributes:
        assembly, setup, step: seconds, medians of paired samples; setup is factor and solves before the first step.
        assembly_range, setup_range: smallest and largest paired sample [s].
        step_relative: added share of a step's time [1].
        step_low, step_high: smallest and largest paired share [1].
        step_noise: share that a step of the scene differs from itself by [1].
        step_quartiles: lower and upper quartile of the paired shares [1].
        flops: added operations of PETSc in a step [1]; flops_relative: their share.
        memory: added memory [byte]; memory_relative: its share.
        holds: names of what only the scene with the effect holds.
        objects: what PETSc counts as created more, by class.
    """

    assembly: float
    setup: float
    assembly_range: tuple[float, float]
    setup_range: tuple[float, float]
    step: float
    step_relative: float
    step_low: float
    step_high: float
    step_noise: float
    step_quartiles: tuple[float, float]
    flops: float
    flops_relative: float
    memory: float
    memory_relative: float
    holds: tuple[str, ...]
    objects: dict[str, int]

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
    """What shows that an effect that is off costs nothing.

    Attributes:
        same_operators: built again after the trial with the effect on, all hashes are those from before.
        zero_strength: named with strength zero it gives the same hashes; None for effects without a strength.
        absent: operators made without its term have the same bits.
        same_objects: PETSc's own log counts the same objects, by class, created after the trial as before, and with the
            effect named at strength zero; and none in the steps.
        same_allocations: Inventory and held memory are those of the scene before the trial.
        declared: the Inventory holds what the effects that are on declare, and nothing more.
        same_work: as many operations in a step.
        step_ratio: median of paired step times, again over before [1]; its range is low to high.
        noise: spread of the single step times of one run, at least `TIMER` [1].
        within_noise: the range holds 1, or the median is no farther from it than the noise.
    """

    same_operators: bool
    zero_strength: bool | None
    absent: bool
    same_objects: bool
    same_allocations: bool
    declared: bool
    same_work: bool
    step_ratio: float
    step_low: float
    step_high: float
    noise: float
    within_noise: bool

    @property
    def holds(self) -> bool:
        """Whether the cost is zero: everything is the same but time, and time within noise."""
        counted = self.same_operators and self.absent and self.same_objects and self.same_work
        return (
            counted
            and self.same_allocations
            and self.declared
            and self.zero_strength is not False
            and self.within_noise
        )


def judge(change: float, felt: bool, costs: bool, tolerance: float) -> str:
    """needed, optional or wasted. Not collective.

    Needed: it changes the outputs by more than the tolerance. Optional: it does not, but it is free, or the control
    problem feels it. Wasted: it costs something and nothing shows it.

    Args:
        change: of the outputs of this run [1].
        felt: the control problem needs it.
        costs: counted work or memory grows.
        tolerance: of the scene [1].
    """
    if change > tolerance:
        return "needed"
    return "wasted" if costs and not felt else "optional"


def quartiles(samples: Array) -> tuple[float, float]:
    """Lower and upper quartile. Not collective."""
    low, high = np.quantile(samples, [0.25, 0.75])
    return float(low), float(high)


def cost_of(with_: Case, without: Case, noise: float = TIMER) -> Cost:
    """The differences of two cases; ``noise`` is what a step of one scene differs from itself by. Not collective."""

    def added(stage: str) -> Array:
        return np.asarray(np.array(with_.seconds[stage]) - np.array(without.seconds[stage]))

    assembly, setup, step = added("assembly"), added("setup"), added("step")
    shares = step / np.array(without.seconds["step"])
    more, less = sum(with_.bytes.values()), sum(without.bytes.values())
    return Cost(
        assembly=float(np.median(assembly)),
        setup=float(np.median(setup)),
        assembly_range=(float(assembly.min()), float(assembly.max())),
        setup_range=(float(setup.min()), float(setup.max())),
        step=float(np.median(step)),
        step_relative=float(np.median(shares)),
        step_low=float(shares.min()),
        step_high=float(shares.max()),
        step_noise=noise,
        step_quartiles=quartiles(shares),
        flops=with_.flops - without.flops,
        flops_relative=with_.flops / without.flops - 1 if without.flops else 0.0,
        memory=more - less,
        memory_relative=more / less - 1,
        holds=tuple(sorted(set(with_.bytes) - set(without.bytes))),
        objects=difference(with_.objects, without.objects),
    )


def declared_operators(model: Model) -> list[str]:
    """Operators that the bare model and the effects that are on declare, sorted. Not collective."""
    scene, bodies = model.scene, [layer.name for layer in model.system.layers]
    names = {"M_ee", "K_ee", "T", "G", *(f"{key}[{body}]" for body in bodies for key in ("K_mu", "K_lambda", "M_1"))}
    at_build = {name for name in EFFECTS["damping"].operators(scene) if EFFECTS["damping"].active(scene)}
    return sorted(names | at_build)


def prove_off(name: str, before: Case, again: Case) -> OffProof:
    """Compare the scene before and after the effect was on in this process. Collective."""
    ratio = np.array(again.seconds["step"]) / np.array(before.seconds["step"])
    median, low, high = float(np.median(ratio)), float(ratio.min()), float(ratio.max())
    noise = max(TIMER, before.spread, again.spread)
    zero: bool | None = None
    counts = [(again.objects, again.objects_in_steps)]
    with_zero = neutral(before.model.scene, name, before.model.system.layout.dimension)
    if with_zero is not None:
        model = build(with_zero, comm=before.model.system.layout.comm)
        run = Run(model, RunOptions())
        zero = fingerprint(model, run) == before.prints
        run.midpoint.destroy()
        if before.objects:
            counts.append(objects_of(before.model.system.layout.comm, with_zero))
    made, new = before.model.inventory, again.model.inventory
    return OffProof(
        same_operators=again.prints == before.prints,
        zero_strength=zero,
        absent=nothing_of(name, before),
        same_objects=not before.objects_in_steps and all(c == (before.objects, {}) for c in counts),
        same_allocations=made.forms == new.forms and made.operators == new.operators and before.bytes == again.bytes,
        declared=made.forms == ["K_mu", "K_lambda", "M_1"]
        and sorted(made.operators) == declared_operators(before.model),
        same_work=again.flops == before.flops,
        step_ratio=median,
        step_low=low,
        step_high=high,
        noise=noise,
        within_noise=low <= 1 <= high or abs(median - 1) <= noise,
    )
