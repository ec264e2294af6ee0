"""The data of an effect, and the numbers that its gate is computed from."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.scene.scene import Scene

SMALL_SHARE = 0.01  # of the volume: at the edge of the contact zone the strain of any fine mesh is large


@dataclass(frozen=True)
class Gradient:
    """Frobenius norm |grad z| of a displacement against the hand, rotations included, between vertices of a cell."""

    largest: float  # largest |grad z| of all cells [1]; at the edge of the contact zone it grows with every refinement
    typical: float  # smallest number that at most `SMALL_SHARE` of the volume exceeds [1]
    share: float  # share of the volume above `SMALL_STRAIN` [1]
    rms: float  # root of its mean square over the volume [1]

    @property
    def linear(self) -> bool:
        """Whether linear elasticity is valid: only a small share of the volume is steep."""
        return self.share <= SMALL_SHARE


@dataclass(frozen=True)
class Sag:
    """Static displacement z of K_ee z = G g with the hand at rest."""

    # acceleration of gravity (d,) [m/s2]; without gravity in the scene that of the earth, along the last axis
    g: tuple[float, ...]
    largest: float  # largest |z| of a node [m]
    gradient: Gradient  # gradient of z


@dataclass(frozen=True)
class Gate:
    """A dimensionless number that decides whether an effect matters."""

    number: float  # its value, dimensionless
    symbol: str  # formula of the number
    threshold: float  # value above which the effect matters
    matters: bool  # the effect changes what this scene computes; for an effect that is off: it would
    sentence: str  # the finding in words
    proviso: str = ""  # condition under which the effect matters, in words; empty for none
    condition: str = ""  # what decides beside the number, wherever ``matters`` is not number > threshold; else empty

    @property
    def comparison(self) -> str:
        """Number against threshold, and what else decides, as one line."""
        number = "not computed" if math.isnan(self.number) else f"{self.number:.3g}"
        beside = [] if math.isnan(self.threshold) else [f"threshold {self.threshold:.3g}"]
        beside += [self.condition] if self.condition else []
        return f"{self.symbol} = {number}" + (f" ({'; '.join(beside)})" if beside else "")


@dataclass(frozen=True)
class Problem:
    """Scales of one scene; `fem.model.scales` computes them."""

    scene: Scene  # scene of the problem
    dimension: int  # 2 or 3
    length: float  # largest extent of the tissue [m]
    materials: tuple[LayerMaterial, ...]  # materials, one per layer that has cells
    tissue_mass: float  # mass of the whole tissue [kg]
    # moments of inertia of the rigid tissue about the reference, one per rotation [kg m2]
    tissue_inertia: tuple[float, ...]
    # lowest angular frequencies of the clamped tissue [1/s], ascending; empty when not computed
    omega: tuple[float, ...]
    zeta: tuple[float, ...]  # damping ratio of each of them [1]
    sag: Sag  # the tissue at rest under its weight
    # gradient of the linear static response to the largest acceleration of the hand, and to gravity if on
    response: Gradient
    clear: bool = False  # whether the path of the hand keeps the deformed tissue clear of every obstacle, by estimate


class Effect(ABC):
    """One unit of physics that a scene switches on."""

    name: str  # its key
    term: str  # term of the equation that it adds
    cost: str  # operators and work that it adds, one sentence
    threshold: float  # threshold of its number, where that does not depend on the scene

    def active(self, scene: Scene) -> bool:
        """Whether the scene has it on."""
        return bool(getattr(scene.effects, self.name))

    def operators(self, scene: Scene) -> tuple[str, ...]:
        """Names of the operators it allocates in this scene; empty when it is off, or where it needs none."""
        return ()

    @abstractmethod
    def gate(self, problem: Problem) -> Gate:
        """The dimensionless number that decides whether it matters."""


def force_drives(scene: Scene) -> bool:
    """Whether a force moves the hand: in the run itself, or in the control problem."""
    return scene.motion.drive == "force" or scene.control is not None
