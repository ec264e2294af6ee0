"""Checks of the user's control problem: weights and data, one sentence for each mistake."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.petsc import Array, PETSc

EPS = float(np.finfo(np.float64).eps)
MODAL_KEY = "control.method = 'modal'"  # of a scene: modal_lqr, which needs no damping
APART = 1e30  # of Q and R, either way: the gain goes with the root of their ratio, its squares must keep some digits


class ControlError(SoftgraspError):
    """The control problem has no optimal feedback, or none that double precision can represent."""


def check_weights(Q: Array, R: Array, outputs: int, inputs: int) -> None:
    """Q symmetric positive semidefinite of order ``outputs``, R symmetric positive definite.

    Raises:
        ControlError: a weight has the wrong shape, an entry that is no number, is not symmetric or has a forbidden
            eigenvalue, or the two are too far apart.
    """
    for name, W, order, definite in (("Q", Q, outputs, False), ("R", R, inputs, True)):
        if W.shape != (order, order):
            kind = "outputs" if name == "Q" else "inputs"
            raise ControlError(
                f"{name} has the shape {W.shape}; it must be ({order}, {order}), one row per {kind[:-1]}"
            )
        if not np.isfinite(W).all():
            raise ControlError(f"{name} has an entry that is not a finite number; give finite weights")
        size = float(np.abs(W).max())
        if float(np.abs(W - W.T).max()) > 10 * EPS * size:
            raise ControlError(f"{name} is not symmetric; give ({name} + {name}')/2")
        least = float(np.linalg.eigvalsh(W)[0])
        noise = 10 * order * EPS * size  # of eigvalsh
        if definite and least <= noise:
            raise ControlError(f"R has the eigenvalue {least:.3g}; all must be > 0, every input must cost something")
        if not definite and least < -noise:
            raise ControlError(f"Q has the eigenvalue {least:.3g}; all must be >= 0, no output may be rewarded")
    reward, price = float(np.abs(Q).max(initial=0.0)), np.linalg.eigvalsh(R)
    if reward and not (reward / APART < price[0] and price[-1] < reward * APART):
        raise ControlError(
            f"Q has entries up to {reward:.3g} and R eigenvalues from {price[0]:.3g} to {price[-1]:.3g}, too far apart "
            f"for double precision; keep their ratio between {1 / APART:.0e} and {APART:.0e}"
        )


def check_finite(**arrays: Array | PETSc.Mat | None) -> None:
    """All entries on this rank are finite. ``arrays``: by the name that a message should use; None is skipped.

    Raises ControlError: an entry is infinite or no number.
    """
    for name, given in arrays.items():
        array = given.getValuesCSR()[2] if isinstance(given, PETSc.Mat) else given
        if array is not None and not np.isfinite(array).all():
            raise ControlError(f"{name} has {int((~np.isfinite(array)).sum())} entries that are not finite numbers")


def square_root(Q: Array) -> Array:
    """S of full row rank with S' S = Q for a symmetric positive semidefinite Q."""
    values, vectors = np.linalg.eigh((Q + Q.T) / 2)
    keep = values > len(values) * EPS * max(float(values[-1]), 0.0)
    return np.asarray(np.sqrt(values[keep])[:, None] * vectors[:, keep].T)
