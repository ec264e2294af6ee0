"""Samples of the posterior of a fit by emcee [FHLG13]: a check of its covariance, which supposes a linear model.

log p(theta, nuisances) = -sum rho(r) / 2 + const,   flat in log theta within the range of the reduced model
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.errors import SceneError, SoftgraspError
from softgrasp.fem.petsc import Array
from softgrasp.fem.shown import Shown
from softgrasp.reduction.identify.fit import ROBUST, Misfit

FEWEST = 1000  # samples
WALKERS = 4  # a parameter
FARTHEST = 0.1  # largest semi-axis of the walkers' start, in the logarithms
BURNED = 0.2  # of the steps, before which samples are not counted
SEED = 0
MISSING = "--posterior needs the package emcee; pip install 'softgrasp[posterior]', or leave it out"


@dataclass(frozen=True, repr=False)
class Posterior(Shown):
    """What samples say of the logarithms of the values."""

    mean: Array  # mean of log theta less the answer's, (k,) [1]
    deviations: Array  # standard deviation of log theta, (k,) [1]
    correlation: Array  # correlation of log theta, (k, k) [1]
    independent: float  # number of independent samples, by the autocorrelation of the chains [1]
    count: int  # number of samples [1]


def check_posterior(samples: int) -> None:
    """Raise SceneError where the samples are too few, or emcee is not installed."""
    if samples < FEWEST:
        raise SceneError(f"--posterior {samples}: give at least {FEWEST} samples")
    try:
        import emcee  # noqa: F401
    except ImportError:
        raise SceneError(MISSING) from None


def sample(misfit: Misfit, p: Array, covariance: Array, samples: int, robust: bool) -> Posterior:
    """Samples around the answer p by the affine invariant ensemble. Online; not collective.

    Args:
        covariance: of [log theta, nuisances], by which the walkers start, none farther than some 0.1: a
            start that ignores correlations lies far outside of a thin ellipsoid.
        samples: number of them, those before the count begins included.
    """
    import emcee

    k, size = misfit.k, len(p)
    low, high = misfit.near.limits(p[:k])

    def density(x: Array) -> float:
        if (x[:k] < low).any() or (x[:k] > high).any():
            return -np.inf
        try:
            r = misfit.residual(x)
        except SoftgraspError:  # no material, or no stable run
            return -np.inf
        rho = 2 * ROBUST**2 * (np.sqrt(1 + (r / ROBUST) ** 2) - 1) if robust else r**2
        return -float(rho.sum()) / 2

    walkers = max(WALKERS * size, 8)
    random = np.random.RandomState(SEED)
    values, vectors = np.linalg.eigh(covariance)
    axes = vectors * np.minimum(np.sqrt(np.maximum(values, 0.0)), FARTHEST)
    begin = p + random.standard_normal((walkers, size)) @ axes.T
    begin[:, :k] = np.clip(begin[:, :k], low + 1e-9, high - 1e-9)
    sampler = emcee.EnsembleSampler(walkers, size, density)
    steps = -(-samples // walkers)
    sampler.run_mcmc(emcee.State(begin, random_state=random.get_state()), steps)
    first = int(BURNED * steps)
    chain = sampler.get_chain(discard=first)[:, :, :k]
    time = float(np.max(sampler.get_autocorr_time(discard=first, tol=0)))
    flat = chain.reshape(-1, k)
    return Posterior(
        mean=flat.mean(axis=0) - p[:k],
        deviations=flat.std(axis=0, ddof=1),
        correlation=np.corrcoef(flat.T).reshape(k, k),
        independent=len(flat) / max(time, 1.0),
        count=len(flat),
    )
