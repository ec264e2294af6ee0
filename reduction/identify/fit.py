"""The fit: min over p = [log theta, nuisances] of sum |W y_N(theta) + c - data|^2 / sigma^2, and its linearisation.

The reduced model y_N has the basis of one theta; it is made anew where the fit has moved, until a round moves by
little. The basis then changes no more, for bases of neighbours differ where modes change their order; what the last one
leaves is measured at the answer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array
from softgrasp.reduction.identify.near import Experiment, Local
from softgrasp.reduction.identify.unknowns import Unknown
from softgrasp.reduction.online import ReducedTrajectory

ROUNDS = 15
MOVED, MOVED_NOISE = 0.05, 0.5  # change of log theta, or share of its noise, within which a basis is kept
LATE = 0.1  # of the run: largest time shift between hand and camera
EDGE = 1e-6  # of log theta: nearer to the end of a range a value lies on it
NO_RUN = 1e6  # residual of values at which a small model folds, which sends the fit back
ROBUST = 2.0  # standard deviations from which residuals count less, with `robust`


@dataclass(frozen=True)
class Nuisances:
    """What is fitted beside the material and reported apart."""

    offsets: tuple[tuple[int, int], ...]  # experiments and outputs whose place has an unknown constant error
    shifts: tuple[int, ...]  # experiments whose clock differs from that of the hand

    @staticmethod
    def of(experiments: Sequence[Experiment], offset: bool, shift: bool) -> Nuisances:
        """Those of all experiments, for the outputs that were measured in each."""
        columns = [
            (i, int(j)) for i, e in enumerate(experiments) for j in np.flatnonzero(e.data.seen.any(axis=0)) if offset
        ]
        return Nuisances(tuple(columns), tuple(range(len(experiments))) if shift else ())

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.offsets) + len(self.shifts)

    def split(self, p: Array, k: int) -> tuple[Array, Array, Array]:
        """Log theta, offsets, shifts."""
        theta, offsets, shifts = np.split(p, [k, k + len(self.offsets)])
        return theta, offsets, shifts


class Misfit:
    """Residuals over sigma and their Jacobian, by the reduced model of a round."""

    def __init__(self, near: Local, experiments: Sequence[Experiment], sigma: Array, nuisances: Nuisances) -> None:
        self.near, self.experiments, self.sigma, self.nuisances = near, experiments, sigma, nuisances
        self.k = len(near.unknowns)
        self.runs = 0  # reduced runs made
        self._last: tuple[bytes, Any, list[ReducedTrajectory]] | None = None

    def answers(self, p: Array) -> tuple[Any, list[ReducedTrajectory]]:
        """System and runs at parameters; those of the last call are kept."""
        key = p[: self.k].tobytes()
        if self._last is None or self._last[0] != key:
            small = self.near.system(np.exp(p[: self.k]))
            self._last = key, small, [self.near.run(small, e) for e in self.experiments]
            self.runs += len(self.experiments)
        return self._last[1:]

    def shift(self, p: Array, i: int) -> float:
        """Time shift of an experiment [s]."""
        shifts, values = self.nuisances.shifts, self.nuisances.split(p, self.k)[2]
        return float(values[shifts.index(i)]) if i in shifts else 0.0

    def measured(self, i: int, outputs: Array, p: Array) -> Array:
        """Outputs (steps + 1, outputs) of an experiment where it was measured, over sigma."""
        e, late = self.experiments[i], self.shift(p, i)
        W = e.own_weights if late == 0.0 else e.weights(late)
        return np.asarray(((W @ outputs) / self.sigma)[e.data.seen])

    def together(self, outputs: Sequence[Array], p: Array) -> Array:
        """Outputs of all experiments where they were measured, over sigma, (m,)."""
        return np.concatenate([self.measured(i, y, p) for i, y in enumerate(outputs)])

    def bounds(self, bounds: Sequence[Array], p: Array) -> Array:
        """Largest errors of outputs (steps + 1, outputs) where they were measured, over sigma, (m,)."""
        weights = [abs(e.weights(self.shift(p, i))) for i, e in enumerate(self.experiments)]
        pairs = zip(weights, bounds, self.experiments, strict=True)
        return np.concatenate([((W @ b) / self.sigma)[e.data.seen] for W, b, e in pairs])

    def residual(self, p: Array) -> Array:
        """(W y + c - data) / sigma, (m,); large where the small model has no run, so that the fit goes back."""
        _, offsets, _ = self.nuisances.split(p, self.k)
        first = self._last is None
        try:
            answers = self.answers(p)[1]
        except SolverError:
            if first:
                raise
            return np.full(sum(int(e.data.seen.sum()) for e in self.experiments), NO_RUN)
        parts = []
        for i, e in enumerate(self.experiments):
            known = e.data.values.copy()
            for (at, j), c in zip(self.nuisances.offsets, offsets, strict=True):
                known[:, j] -= c if at == i else 0.0
            parts.append(self.measured(i, answers[i].outputs, p) - (known / self.sigma)[e.data.seen])
        return np.concatenate(parts)

    def jacobian(self, p: Array) -> Array:
        """Its derivatives, (m, parameters)."""
        beside = np.vstack([self._nuisance(i, p) for i in range(len(self.experiments))])
        return np.hstack([self.slopes(p, self.near.unknowns), beside])

    def slopes(self, p: Array, by: Sequence[Unknown]) -> Array:
        """Derivatives by the logarithms of some parameters, fitted or not, (m, parameters)."""
        small, answers = self.answers(p)
        theta = np.exp(p[: self.k])
        parts = []
        for i, (e, answer) in enumerate(zip(self.experiments, answers, strict=True)):
            slopes = self.near.slopes(theta, by, small, answer, e)
            self.runs += len(by)
            parts.append(np.array([self.measured(i, y, p) for y in slopes]).reshape(len(by), -1).T)
        return np.vstack(parts)

    def _nuisance(self, i: int, p: Array) -> Array:
        """Columns of the nuisances in the rows of an experiment."""
        e, answers = self.experiments[i], self.answers(p)[1]
        seen, columns = e.data.seen, []
        for at, j in self.nuisances.offsets:
            column = np.zeros(seen.shape)
            column[:, j] = (at == i) / self.sigma[j]
            columns.append(column[seen])
        for at in self.nuisances.shifts:
            step, late = 1e-3 * e.dt, self.shift(p, i)  # the interpolation is a cubic between two steps
            slope = (e.weights(late + step) - e.weights(late - step)) @ answers[i].outputs / (2 * step)
            columns.append((at == i) * (slope / self.sigma)[seen])
        return np.stack(columns, axis=1) if columns else np.zeros((int(seen.sum()), 0))


@dataclass(frozen=True)
class Fit:
    """Where the rounds end."""

    misfit: Misfit  # at the reduced model of the last round
    p: Array  # [log theta, offsets, shifts]
    history: tuple[tuple[float, ...], ...]  # theta at the start and after each round
    runs: int  # reduced runs of all rounds
    unsettled: float  # largest change of log theta in the last of too many rounds; 0 where they converged [1]
    edges: tuple[str, ...] = ()  # names of the values at the end of the range that the only small model has


def fit_rounds(
    make: Callable[[Array], Local],
    experiments: Sequence[Experiment],
    start: Array,
    sigma: Array,
    nuisances: Nuisances,
    *,
    robust: bool = False,
    progress: Callable[[int], None] = lambda done: None,
) -> Fit:
    """Fit in rounds, see the module; Gauss-Newton in a trust region [BCL99]. Collective.

    Args:
        make: gives the small model for values near some (k,).
        start: log theta and nuisances.
        progress: called with the number of rounds done.

    Raises:
        ReductionError: there is no such small model.
        SolverError: it has no run at the values of a round.
    """
    from scipy.optimize import least_squares

    k, p, runs = len(start) - nuisances.count, start, 0
    history = [tuple(np.exp(p[:k]).tolist())]
    for rounds in range(1, ROUNDS + 1):
        near = make(np.exp(p[:k]))
        misfit = Misfit(near, experiments, sigma, nuisances)
        late = LATE * np.array([experiments[i].scene.time_end for i in nuisances.shifts])
        free = np.full(len(nuisances.offsets), np.inf)
        low, high = near.limits(p[:k])
        p = np.concatenate([np.clip(p[:k], low + EDGE / 2, high - EDGE / 2), p[k:]])
        found = least_squares(
            misfit.residual, p, misfit.jacobian, x_scale="jac", xtol=1e-9, ftol=1e-12, gtol=1e-12, max_nfev=50,
            bounds=(np.concatenate([low, -free, -late]), np.concatenate([high, free, late])),
            loss="soft_l1" if robust else "linear", f_scale=ROBUST if robust else 1.0,
        )  # fmt: skip
        change, p, runs = found.x - p, found.x, runs + misfit.runs
        history.append(tuple(np.exp(p[:k]).tolist()))
        progress(rounds)
        if near.whole_range:
            ends = np.minimum(p[:k] - low, high - p[:k]) < EDGE
            return Fit(
                misfit,
                p,
                tuple(history),
                runs,
                0.0,
                tuple(near.unknowns[i].name for i in map(int, np.flatnonzero(ends))),
            )
        _, sizes, directions = np.linalg.svd(apart(found.jac, k), full_matrices=False)
        size = max(1.48 * float(np.median(np.abs(found.fun))), 1.0)  # what is not fitted moves the values as noise does
        if (np.abs(directions @ change[:k]) <= np.maximum(MOVED, MOVED_NOISE * size / np.maximum(sizes, 1e-300))).all():
            return Fit(misfit, p, tuple(history), runs, 0.0)
    return Fit(misfit, p, tuple(history), runs, float(np.abs(change[:k]).max()))


def apart(J: Array, k: int) -> Array:
    """The first k columns of a Jacobian without their projection on the others, the nuisances."""
    if J.shape[1] == k:
        return J
    Q, _ = np.linalg.qr(J[:, k:])
    return np.asarray(J[:, :k] - Q @ (Q.T @ J[:, :k]))


@dataclass(frozen=True)
class Linearisation:
    """The fit near its end, d log theta = inverse @ (change of data over sigma)."""

    inverse: Array  # influence of each datum, (k, m)
    beside: Array  # its influence on each nuisance, (nuisances, m)
    covariance: Array  # of log theta by the noise, (k, k)
    sizes: Array  # singular values of the Jacobian, its change per sigma, (k,)
    directions: Array  # rows are its directions of log theta, (k, k)
    residual: Array  # (m,) [sigma]
    whole: Array  # covariance of [log theta, nuisances]

    @property
    def noise(self) -> Array:
        """Standard deviation of log theta by the noise, (k,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def linearise(misfit: Misfit, p: Array, robust: bool) -> Linearisation:
    """Influence psi' and variance psi^2 of a robust loss as of any M-estimate [H64]; 1 and 1 of least squares."""
    r, J = misfit.residual(p), misfit.jacobian(p)
    z = 1 + (r / ROBUST) ** 2
    slope, psi2 = (z**-1.5, r**2 / z) if robust else (np.ones_like(r), np.ones_like(r))
    root = np.sqrt(slope)[:, None]
    whole = np.linalg.pinv(root * J) * root.T
    inverse = np.linalg.pinv(apart(root * J, misfit.k)) * root.T
    by_psi, all_by_psi = inverse / slope, whole / slope
    _, sizes, directions = np.linalg.svd(apart(root * J, misfit.k), full_matrices=False)
    covariances = [(influence * psi2) @ influence.T for influence in (by_psi, all_by_psi)]
    return Linearisation(inverse, whole[misfit.k :], covariances[0], sizes, directions, r, covariances[1])


def by_experiment(misfit: Misfit, values: Array) -> Iterator[Array]:
    """A vector (m,) as tables (times, outputs) of each experiment, nan where nothing was measured."""
    ends = np.cumsum([int(e.data.seen.sum()) for e in misfit.experiments])
    for e, part in zip(misfit.experiments, np.split(values, ends[:-1]), strict=True):
        table = np.full(e.data.seen.shape, np.nan)
        table[e.data.seen] = part
        yield table
