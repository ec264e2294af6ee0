"""A basis of one's own for ``reduction.plugins``: what the tissue does under slow motions of the hand.

The hand's acceleration a loads the tissue by -G a. For slow motions z = -K^-1 G a + K^-1 M K^-1 G a'' - ..., so that
the columns K^-1 G, K^-1 M K^-1 G, ... match the moments of the transfer function at zero frequency.
"""

import numpy as np

from softgrasp.fem.petsc import times_columns
from softgrasp.fem.solve.stiffness import static_columns
from softgrasp.reduction.bases.plugins import displacement_method, mass_orthonormal


def static_responses(states, k):
    """Moments at zero, block after block, local rows (n_local, k or more)."""
    system = states.system
    block = static_columns(system, np.asfortranarray(system.G))
    columns = block
    while columns.shape[1] < k:
        columns = mass_orthonormal(system, columns)
        last = np.asfortranarray(columns[:, -block.shape[1] :])
        columns = np.hstack([columns, static_columns(system, times_columns(system.M_ee, last))])
    return columns


METHODS = [displacement_method("static_responses", "static responses", static_responses)]
