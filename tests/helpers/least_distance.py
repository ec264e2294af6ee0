"""The oracle of plans: least distance by non-negative least squares [LH74]."""

from __future__ import annotations

import numpy as np
import scipy.optimize


def least_squares(G: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Lawson and Hanson: E u - e_{n+1} of the best u >= 0 is (x, -1) to scale, E = [-G'; -h']."""
    E = -np.vstack([G.T, h])
    u, _ = scipy.optimize.nnls(E, np.eye(len(E))[-1], maxiter=100_000)
    left = E @ u - np.eye(len(E))[-1]
    return -left[:-1] / left[-1]
