"""A basis for fits: lowest modes, and the static responses whose changes with the stiffness the data show.

    X = K^-1 [G diag(load), K_theta K^-1 G diag(load), C']

are the responses to the loads of the hand and of gravity, their changes with each stiffness, K_theta = theta dK/dtheta,
and the responses that the outputs see. Modes alone need five times the columns in a layered body, whose sag changes
with every layer, and slopes of the outputs in too few of them send the fit to wrong values.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softgrasp.fem.accuracy.krylov import static_solves
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array, normalising, times_columns, total
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.reduction.identify.unknowns import Unknown, value_of

SHARE = 0.5  # of the columns that responses take at most
LEAST = 1e-6  # of the largest response in the energy norm: what adds less is not worth a column
DROPPED = 1e-10  # of squares of unit columns, below which these depend on each other


def response_basis(model: Model, unknowns: Sequence[Unknown], load: Array, k: int) -> Array:
    """Phi' M Phi = 1 of k columns at most, local rows (n_local, k). Collective.

    ``load``: largest acceleration of the hand less that of free fall, by its degrees of freedom, (n_s,).

    Raises SolverError: a solve fails.
    """
    system, comm = model.system, model.system.layout.comm
    k = min(k, system.layout.n_e)
    X = _responses(model, unknowns, load)
    modes = lowest_modes(system, k)[1]
    most = int(SHARE * k)
    added = _leading(model, modes[:, : k - most], X, most).shape[1]
    statics = _leading(model, modes[:, : k - added], X, added)
    Phi = np.hstack([modes[:, : k - added], statics])
    M, K = (total(comm, Phi.T @ times_columns(A, Phi)) for A in (system.M_ee, system.K_ee))
    size = np.sqrt(np.diag(M))
    Q = normalising(M / np.outer(size, size), DROPPED) / size[:, None]
    Q = comm.bcast(Q @ np.linalg.eigh(Q.T @ (K + K.T) @ Q / 2)[1])
    return np.asfortranarray(Phi @ Q)


def _responses(model: Model, unknowns: Sequence[Unknown], load: Array) -> Array:
    """X with columns of comparable energy, local rows. Collective."""
    system, comm = model.system, model.system.layout.comm
    with static_solves(model) as solve:
        X = solve(np.hstack([system.G * load, model.output_columns]))
        first, seen = X[:, : len(load)], X[:, len(load) :]
        slopes = []
        for u in unknowns:
            if u.kind in ("mu", "lambda"):
                key = "K_mu" if u.kind == "mu" else "K_lambda"
                K_X = sum(times_columns(getattr(system.layers[i], key).ee, first) for i in u.layers)
                slopes.append(value_of(system.materials, u) * solve(np.asfortranarray(K_X)))
    sizes = [np.sqrt(total(comm, np.einsum("ij,ij->j", Y, times_columns(system.K_ee, Y)))) for Y in (first, seen)]
    scale = sizes[0].max(initial=0.0) / np.maximum(sizes[1], 1e-300)
    return np.hstack([first, *slopes, seen * scale])


def _leading(model: Model, modes: Array, X: Array, most: int) -> Array:
    """The directions of most energy that responses add to modes, M-orthogonal to these, local rows. Collective."""
    system, comm = model.system, model.system.layout.comm
    whole = total(comm, np.einsum("ij,ij->j", X, times_columns(system.K_ee, X))).max(initial=0.0)
    for _ in range(2):  # once leaves rounding of what is taken away
        X = X - modes @ total(comm, times_columns(system.M_ee, modes).T @ X)
    gram = total(comm, X.T @ times_columns(system.K_ee, X))
    sizes, vectors = comm.bcast(np.linalg.eigh((gram + gram.T) / 2))
    keep = np.flatnonzero(sizes > LEAST**2 * whole)[::-1][:most]
    return np.asarray(X @ (vectors[:, keep] / np.sqrt(sizes[keep])))
