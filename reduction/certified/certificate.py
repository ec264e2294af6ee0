"""Errors of a certified run: proved bounds, and estimates, which are called estimates."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.petsc import Array
from softgrasp.fem.shown import Card, Shown, percent
from softgrasp.reduction.online import ReducedTrajectory

Kind = Literal["proof", "estimate"]
NORMS = {"energy": "largest energy norm of the deformation", "output": "largest deformation at the outputs"}
"""What the error of the reduction is relative to, by ``reduction.norm``."""


class ToleranceError(SoftgraspError):
    """The error of a run, proved or estimated as its certificate says, is above the tolerance.

    Attributes:
        run: the run with its certificate.
    """

    def __init__(self, text: str, run: CertifiedRun) -> None:
        super().__init__(text)
        self.run = run


@dataclass(frozen=True)
class Bound:
    """Error of a run at every step."""

    values: Array = field(repr=False)  # bound at every step, (steps + 1,), or (steps + 1, p) of each component
    size: float  # largest value of the reduced solution itself, in the norm of the error
    kind: Kind  # "proof": not exceeded; "estimate": about so large

    @property
    def largest(self) -> Array:
        """Largest value over the run, of every component."""
        return np.asarray(self.values.max(axis=0))

    @property
    def relative(self) -> float:
        """Largest value over the largest of the true solution, which is at least the reduced one less the proof.

        Infinite when the proof is larger than the reduced solution, 0 when nothing moves.
        """
        error = float(np.linalg.norm(self.largest))
        least = self.size - error if self.kind == "proof" else self.size
        return 0.0 if error == 0 else error / least if least > 0 else float("inf")


@dataclass(frozen=True)
class OfflineMeshEstimate:
    """Error of the mesh in the deformation of the outputs, estimated offline; no bound."""

    places: tuple[tuple[float, float], ...]  # (lambda, mu) of the first layer where it was estimated [Pa]
    estimates: tuple[float, ...]  # relative error there, as large as that of full runs to 1 % on the paper's scene [1]

    @property
    def largest(self) -> float:
        """Over all places."""
        return max(self.estimates)


@dataclass(frozen=True, repr=False)
class Certificate(Shown):
    """Errors of one reduced run, separated by their sources: reduction, time step, mesh.

    Attributes:
        energy: of the deformation in the energy norm, |e|^2 = e_z'K e_z + e_v'M e_v [J^(1/2)]; for a hand that a force
            drives with the tissue pulling back, of deformation and hand, e_v with the hand's velocity.
        outputs: proof for every output component [m, rad].
        estimate: difference to the run of the larger basis in the energy norm; None without one.
        outputs_estimate: difference to the run of the larger basis at every output [m, rad]; None without one.
        effectivity_at_most: of the proof's running maximum, as far as the numbers themselves prove it; infinite if they
            do not.
        time_step: estimate of the error of the step, relative, in the energy norm; None where no finer table of the
            motion was given.
        time_step_proof: :attr:`time_step` with the bounds of both runs added; None if not requested.
        mesh: estimate of the error of the mesh; None: not known.
        inside: the materials lie in the box that the model was trained in.
        norm: what :attr:`reduction` is about: "energy" or "output".
        tolerance: of the relative error; None: none was set.
    """

    energy: Bound
    outputs: Bound
    estimate: Bound | None = None
    outputs_estimate: Bound | None = None
    effectivity_at_most: float = np.inf
    time_step: float | None = None
    time_step_proof: float | None = None
    mesh: OfflineMeshEstimate | None = None
    inside: bool = True
    norm: str = "energy"
    tolerance: float | None = None

    @property
    def proved(self) -> bool:
        """Whether :attr:`reduction` is proved, not estimated."""
        return self.energy.kind == "proof"

    @property
    def how(self) -> str:
        """What :attr:`reduction` is, in a word."""
        return "proved" if self.proved else "estimated"

    @property
    def what(self) -> str:
        """What :attr:`reduction` is relative to, in words."""
        return NORMS[self.norm]

    @property
    def reduction(self) -> float:
        """Proved relative error of the reduction, in the norm of the tolerance."""
        return (self.outputs if self.norm == "output" else self.energy).relative

    def claim(self, number: str) -> str:
        """What is known of the error, whose :attr:`reduction` is ``number`` in words."""
        if self.reduction == np.inf:
            return f"has a bound larger than the deformation itself (nothing is {self.how})"
        return f"is {self.how} to be at most {number} of the {self.what}"

    @property
    def passed(self) -> bool:
        """Whether the error is at most the tolerance."""
        return self.tolerance is None or self.reduction <= self.tolerance

    @property
    def reasons(self) -> tuple[str, ...]:
        """Warnings about this run, one sentence each."""
        result = []
        if not self.inside:
            result.append("The materials lie outside the box of the training; the bound is valid there too.")
        if self.reduction > 1:
            result.append("The bound is larger than the deformation itself, so it proves nothing about this run.")
        others = {"time step": self.time_step, "mesh": None if self.mesh is None else self.mesh.largest}
        value, key = max(((value, key) for key, value in others.items() if value is not None), default=(0.0, ""))
        if value > self.reduction:
            result.append(f"The {key} leaves the larger error: a finer basis gains nothing.")
        return tuple(result)

    def card(self) -> Card:
        """The three errors with how they are known, and whether the materials lie in the box of the training."""
        return Card("Certificate", (*self._parts(), ("in the box", "yes" if self.inside else "no")))

    def sentence(self) -> str:
        """The three numbers in one line."""
        return " | ".join(f"{name} {value}" for name, value in self._parts())

    def _parts(self) -> tuple[tuple[str, str], ...]:
        step = "not known" if self.time_step is None else f"{percent(self.time_step)} (estimate)"
        mesh = "not known"
        if self.mesh is not None:
            count = len(self.mesh.places)
            where = f"largest of {count} trained materials" if count > 1 else "at one trained material"
            mesh = f"{percent(self.mesh.largest)} (estimate, {where})"
        return ("reduction", f"{percent(self.reduction)} ({self.how})"), ("time step", step), ("mesh", mesh)


@dataclass(frozen=True, repr=False)
class CertifiedRun(Shown):
    """A reduced run and what is known of its error."""

    trajectory: ReducedTrajectory  # reduced run
    certificate: Certificate  # its errors

    def card(self) -> Card:
        """Steps, size and outputs of the run, and its errors."""
        return Card("Certified run", (*self.trajectory.card().rows, ("error", self.certificate.sentence())))
