"""What is known of the error that the mesh leaves in the outputs of a run."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from softgrasp.fem.petsc import Array


@dataclass(frozen=True)
class MeshEstimate:
    """Error of the deformation: outputs against the hand, over the largest of them."""

    estimate: float  # largest |delta y| over the run, relative [1]
    bound: float  # what the error has not exceeded wherever it could be checked, relative [1]
    # estimate of y - y_h at the time steps, (steps + 1, p) [m, rad]; y_h + delta is the corrected output
    delta: Array = field(repr=False)
    # relative errors of the two lowest frequencies that the run can see, omega_h / omega - 1 [1]
    omega: tuple[float, ...]
    time_error: float  # error of the time steps, relative like ``estimate`` [1]
    shift: float  # largest distance of the ends of the zone held from ``contact.box`` [m]
    n_e: int  # tissue unknowns of the mesh judged
    finer: int  # tissue unknowns of the mesh it was compared with
    by: str  # "order" (elements of the next order on the same cells) or "graded" (another mesh, which meets the zone)
    tolerance: float | None = None  # of the scene, or None
    passes: int = 0  # refinements after the first estimate
    obstacle: str = ""  # why the tolerance was not reached, or ""
    offer: tuple[float, int] | None = None  # tolerance and unknowns of a graded mesh that does better, or None
    seconds: float = 0.0  # what the estimate took, the slowest rank

    def corrected(self, outputs: Array) -> Array:
        """Outputs y_h + delta y (steps + 1, p) [m, rad]."""
        return np.asarray(outputs + self.delta)
