"""What an identification answers: values, the parts of their errors, and what speaks against them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.columns import Columns
from softgrasp.fem.model.build import MeshEstimate, Model
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.shown import Card, Shown, digits, percent
from softgrasp.reduction.identify.data import Measurements
from softgrasp.reduction.identify.posterior import Posterior
from softgrasp.reduction.identify.unknowns import Unknown
from softgrasp.reduction.identify.verdict import Residuals


@dataclass(frozen=True)
class Nuisance:
    """An offset or a time shift that was fitted beside the material, with its errors, all in its own unit."""

    name: str  # with the unit: "offset of tip_x in camera [m]"
    value: float  # as it was fitted
    noise: float  # standard deviation by the noise
    parts: dict[str, float | None]  # what "mesh", "time step" and "reduction" make of value - truth; None: not known

    @property
    def total(self) -> float:
        """Noise and the sizes of the other parts together."""
        return self.noise + sum(abs(part) for part in self.parts.values() if part is not None)


@dataclass(frozen=True, repr=False)
class Identified(Shown):
    """Values of a material from measurements, with their errors; made by :func:`identify`."""

    unknowns: tuple[Unknown, ...]
    """Names and units of what was fitted, (k,)."""
    start: Array
    """Values that the fit started from, (k,) [Pa, kg/m3, s]."""
    values: Array
    """Values found, (k,) [Pa, kg/m3, s]."""
    noise: Array
    """Standard deviation of each value by the noise, relative [1], (k,)."""
    parts: dict[str, Array | None]
    """Estimated relative error (k,) [1] of the values by "mesh", "time step", "reduction", "linear elasticity", signed.

    What each makes of log(value / truth), the proof of a certified model without a sign; None where it is not known.
    Linear elasticity is named where finite strain changes more than nothing, and values are linear all the same.
    """
    kinds: dict[str, str]
    """How each part of the error is known, in words, by its name."""
    law: str
    """Law of the material, "linear" or the name of a hyperelastic one."""
    covariance: Array
    """Covariance of log(values) by the noise, (k, k) [1]."""
    sensitivities: Array
    """Change of the data by a unit of each direction of log(values), (k,) [sigma]."""
    directions: Array
    """Directions of log(values), one a row, the largest sensitivity first, (k, k) [1]."""
    assumed: dict[str, Array]
    """Change of log(values) by a unit of the logarithm of each parameter that was not fitted, by its name, (k,) [1]."""
    nuisances: tuple[Nuisance, ...]
    """Each offset and time shift that was fitted too, with its errors."""
    residuals: Residuals
    """Size and whiteness of the residuals."""
    reasons: tuple[str, ...]
    """Why the answer is refused, a sentence each; empty where it is accepted."""
    warnings: tuple[str, ...]
    """What a reader should know although it is accepted, a sentence each."""
    history: tuple[tuple[float, ...], ...]
    """Values at the start and after each round, (k,) each."""
    runs: int
    """Number of reduced runs [1]."""
    N: int
    """Dimension of the reduced models, the hand's 2 n_s included."""
    scene: Scene
    """The scene with the values."""
    model: Model
    """The full model with the values."""
    estimate: MeshEstimate | None
    """Estimated error of the mesh at the values; None where there is none."""
    data: tuple[Measurements, ...]
    """What was measured, an experiment each."""
    fitted: tuple[Array, ...]
    """Outputs at the instants of the data, with offsets and shifts, (times, outputs) of each experiment [m, rad]."""
    sigma: Array
    """Standard deviation of the noise of each output, (outputs,) [m, rad]."""
    columns: Columns
    """Name, axis and unit of each output."""
    posterior: Posterior | None = None
    """Samples of the posterior, which check the covariance; None where none were asked for."""

    @property
    def correlation(self) -> Array:
        """Correlation of the values by the noise, (k, k) [1]."""
        scale = np.sqrt(np.diag(self.covariance))
        return np.asarray(self.covariance / np.outer(scale, scale))

    @property
    def total(self) -> Array:
        """Noise and the sizes of the other parts together, relative [1], (k,)."""
        known = [np.abs(part) for part in self.parts.values() if part is not None]
        return np.asarray(self.noise + np.sum(known, axis=0))

    def rows(self) -> list[tuple[str, str]]:
        """Each value with the parts of its error, in words."""
        result = []
        for i, u in enumerate(self.unknowns):
            parts = [f"noise {percent(self.noise[i])}"]
            parts += [
                f"{name} {'not known' if part is None else percent(part[i], '+')}" for name, part in self.parts.items()
            ]
            result.append((u.name, f"{digits(self.values[i])} {u.unit}, {', '.join(parts)}"))
        return result

    def card(self) -> Card:
        """Values with their errors, misfit and verdict."""
        r = self.residuals
        verdict = f"refused: {self.reasons[0]}" if self.reasons else "accepted"
        return Card(
            f"Identified {self.scene.name}",
            (*self.rows(), ("misfit", f"{r.misfit:.3g} sigma, by chance at most {r.limit:.3g}"), ("answer", verdict)),
        )
