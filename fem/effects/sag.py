"""The tissue at rest under its weight: the numbers that the gate of gravity is computed from."""

from __future__ import annotations

from dataclasses import dataclass

SMALL_SHARE = 0.01  # of the volume: at the edge of the contact zone the strain of any fine mesh is large


@dataclass(frozen=True)
class Gradient:
    """Frobenius norm |grad z| of a displacement against the hand, rotations included, between vertices of a cell."""

    largest: float  # in any cell [1]; at the edge of the contact zone it grows with every refinement
    typical: float  # smallest number that at most `SMALL_SHARE` of the volume exceeds [1]
    share: float  # of the volume above `SMALL_STRAIN` [1]
    rms: float  # root of its mean square over the volume [1]

    @property
    def linear(self) -> bool:
        """Whether linear elasticity holds: only a small share of the volume is steep."""
        return self.share <= SMALL_SHARE


@dataclass(frozen=True)
class Sag:
    """Static displacement z of K_ee z = G g, the hand held still."""

    # acceleration of gravity (d,) [m/s2]; without gravity in the scene that of the earth, along the last axis
    g: tuple[float, ...]
    largest: float  # largest |z| of a node [m]
    gradient: Gradient  # of z
