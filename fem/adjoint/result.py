"""What a gradient answers, of a full run or of a reduced one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from softgrasp.fem.petsc import Array
from softgrasp.fem.shown import Shown

Loss = Callable[[Array], tuple[float, Array]]
"""J and dJ/dy (steps + 1, p) of outputs y (steps + 1, p) [m]."""


@dataclass(frozen=True, repr=False)
class RunGradient[Run](Shown):
    """A run and the derivatives of J with respect to all that it depends on."""

    run: Run
    """The run that was differentiated."""
    value: float
    """J."""
    lam: Array
    """dJ/dlambda of every layer, (layers,) [1/Pa]."""
    mu: Array
    """dJ/dmu of every layer, (layers,) [1/Pa]."""
    beta: Array | None
    """dJ/dbeta of every layer, (layers,) [1/s]; None for a model without damping."""
    rho: Array | None
    """dJ/drho of every layer, (layers,) [m3/kg]; None for canonical models, which are not affine in it."""
    alpha: float | None
    """dJ/dalpha [s]; None for a model without damping."""
    start: Array
    """dJ/dx_0; of the hand zero where it is prescribed.

    Of a reduced model (N,); of a full one by [q_s, v_s, z, v_z] with z relative to the hand, the tissue's rows of this
    rank, (2 n_s + 2 n_local,).
    """
    force: Array | None
    """dJ/du of every step, (steps, n_s) [1/N]; None where the hand is prescribed."""
    hand: tuple[Array, Array] | None
    """dJ/dq_s and dJ/dv_s, (steps + 1, n_s) each [1/m, s/m]; None where a force moves the hand."""
