"""Measurements that determine some parameters best: sums of their information with the largest determinant."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.petsc import Array

RIDGE = 1e-13  # over the mean information: what is not seen counts as little, not as nothing
GAIN = 1e-9  # of the logarithm of the determinant: a smaller gain is rounding
SWEEPS = 20  # most passes over the chosen ones
LOST = 1e-12  # reciprocal condition below which a direction is not seen


def determinant(F: Array, k: int) -> Array:
    """Log det of the information F (..., m, m) about the first k parameters, where the others are not known."""
    whole = np.linalg.slogdet(F)[1]
    return np.asarray(whole if F.shape[-1] == k else whole - np.linalg.slogdet(F[..., k:, k:])[1])


def ellipsoid(F: Array, k: int) -> Array:
    """Size of the errors by the information F (..., m, m), det(F)^(-1/2k): the mean semi-axis of their ellipsoid.

    The mean is the geometric one. What is not seen counts as 1e130 at most.
    """
    with np.errstate(divide="ignore"):
        return np.asarray(np.exp(-np.maximum(determinant(F, k), -600.0 * k) / (2 * k)))


def choose(F: Array, k: int, count: int) -> list[int]:
    """Numbers of ``count`` of the candidates' F (c, m, m) with a large determinant of their sum, the best first.

    Greedy, then exchanged one by one while that gains [F72], and put in the greedy order.
    """
    m = F.shape[-1]
    base = RIDGE * max(float(np.trace(F, axis1=1, axis2=2).mean()), np.finfo(float).tiny) * np.eye(m)
    chosen = _greedy(F, k, count, base, list(range(len(F))))
    for _ in range(SWEEPS):
        before = list(chosen)
        for place, old in enumerate(chosen):
            rest = base + F[[i for i in chosen if i != old]].sum(axis=0)
            value = determinant(rest + F, k)
            value[[i for i in chosen if i != old]] = -np.inf
            best = int(np.argmax(value))
            if value[best] > value[old] + GAIN:
                chosen[place] = best
        if chosen == before:
            break
    return _greedy(F, k, count, base, sorted(chosen))


def _greedy(F: Array, k: int, count: int, base: Array, among: list[int]) -> list[int]:
    chosen: list[int] = []
    total = base.copy()
    for _ in range(count):
        left = [i for i in among if i not in chosen]
        best = left[int(np.argmax(determinant(total + F[left], k)))]
        chosen.append(best)
        total = total + F[best]
    return chosen


def deviations(F: Array, k: int) -> Array:
    """Standard deviations (k,) of the first k parameters by the information F (m, m); infinite where none is seen."""
    values, vectors = np.linalg.eigh((F + F.T) / 2)
    if values[0] <= LOST * values[-1]:
        lost = values <= LOST * max(values[-1], np.finfo(float).tiny)
        hidden = (vectors[:, lost] ** 2).sum(axis=1) > LOST
        variance = (vectors[:, ~lost] ** 2 / values[~lost]).sum(axis=1)
        return np.asarray(np.sqrt(np.where(hidden, np.inf, variance))[:k])
    return np.asarray(np.sqrt((vectors**2 / values).sum(axis=1))[:k])


def unseen_directions(F: Array, k: int) -> Array:
    """Directions of the first k parameters that the information F (m, m) does not contain, one a row."""
    if F.shape[-1] > k:  # what the others can take over is not seen
        F = F[:k, :k] - F[:k, k:] @ np.linalg.pinv(F[k:, k:]) @ F[k:, :k]
    values, vectors = np.linalg.eigh((F + F.T) / 2)
    return np.asarray(vectors[:, values <= LOST * max(values[-1], np.finfo(float).tiny)].T)
