"""What speaks against an answer: reasons to refuse it, and warnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.fem.shown import percent
from softgrasp.reduction.identify.unknowns import Unknown

SIGHT = 1.0  # change of the data per log theta, in sigma, below which they leave an error above a factor e
NAMED = 0.3  # of the largest entry of a direction: smaller ones are not named
LAGS = 10  # of the test for white residuals
BY_CHANCE = 1e-4  # probability below which residuals are not called white
OUTLIER = 4.0  # [sigma]
CHANCE = 4.0  # standard deviations of the misfit by chance


@dataclass(frozen=True)
class Residuals:
    """Size and whiteness of what the fit leaves."""

    misfit: float  # root mean square over sigma; with a robust loss 1.48 median |r| [1]
    limit: float  # largest misfit by chance [1]
    lag: float  # correlation of neighbouring residuals [1]
    white: float  # probability of such correlations by chance [1]
    outliers: int  # residuals above 4 sigma [1]
    count: int  # measured numbers [1]


def judge(residual: Array, tables: Sequence[Array], parameters: int, robust: bool) -> Residuals:
    """Misfit against chance, and the test of Ljung and Box on each output [LB78].

    Args:
        residual: all residuals over their sigma, (m,).
        tables: the same of each experiment over time, (times, outputs), nan where nothing was measured.
        parameters: number of values that were fitted.
        robust: whether the loss was the robust one, so that outliers are clipped.
    """
    from scipy.special import chdtrc

    m = len(residual)
    freedom = max(m - parameters, 1)
    misfit = 1.4826 * float(np.median(np.abs(residual))) if robust else float(np.sqrt((residual**2).sum() / freedom))
    spread = 1.166 / np.sqrt(m) if robust else 1 / np.sqrt(2 * freedom)  # of the estimate of a unit deviation
    q, degrees, product, square = 0.0, 0, 0.0, 0.0
    for column in (c[np.isfinite(c)] for table in tables for c in table.T):
        n = len(column)
        if n <= 2 * LAGS or not column.any():
            continue
        x = np.clip(column, -OUTLIER, OUTLIER) if robust else column
        x = x - x.mean()
        r = np.array([(x[lag:] * x[:-lag]).sum() for lag in range(1, LAGS + 1)])
        q += n * (n + 2) * float(((r / (x @ x)) ** 2 / (n - np.arange(1, LAGS + 1))).sum())
        degrees, product, square = degrees + LAGS, product + float(r[0]), square + float(x @ x)
    white = float(chdtrc(degrees, q)) if degrees else 1.0
    lag = product / square if square else 0.0
    return Residuals(misfit, 1 + CHANCE * float(spread), lag, white, int((np.abs(residual) > OUTLIER).sum()), m)


def direction_in_words(unknowns: Sequence[Unknown], direction: Array, least: float = NAMED) -> str:
    """A direction of log theta: "lambda alone", or a product of powers, those above ``least`` of the largest."""
    direction = direction * np.sign(direction[np.argmax(np.abs(direction))])
    named = [(u.name, x) for u, x in zip(unknowns, direction, strict=True) if abs(x) > least * np.abs(direction).max()]
    if len(named) == 1:
        return f"{named[0][0]} alone"
    return "the combination " + " ".join(f"{name}^{x:.2g}" for name, x in named)


def unseen(unknowns: Sequence[Unknown], sizes: Array, directions: Array) -> list[str]:
    """Directions that the data do not determine, in words.

    Args:
        sizes: change of the data along each direction of log theta, in sigma, (n,).
        directions: unit vectors of log theta as rows, (n, n).
    """
    return [direction_in_words(unknowns, d) for s, d in zip(sizes, directions, strict=True) if s < SIGHT]


def reasons(
    unknowns: Sequence[Unknown],
    residuals: Residuals,
    unsettled: float,
    invisible: Sequence[str],
    noise: Array,
    parts: dict[str, Array | None],
    cures: dict[str, str],
    edges: Sequence[str] = (),
) -> tuple[str, ...]:
    """Why an answer is refused, a sentence each.

    Args:
        residuals: what :func:`judge` found.
        unsettled: largest change of log theta in the last of too many rounds, 0 where they converged.
        invisible: directions that the data do not determine, of :func:`unseen`.
        noise: part of the noise in each value, relative, (n,).
        parts: "mesh", "time step", "reduction" with that part in each value, (n,), None where it is not known.
        cures: what to set against each of these parts, an imperative by the same name.
        edges: names of the values that end where the range of the only small model does.
    """
    found = []
    if residuals.misfit > residuals.limit:
        found.append(
            f"The misfit is {residuals.misfit:.4g} sigma, and chance leaves at most {residuals.limit:.4g}: the model "
            "lacks something that the data show, or the noise is larger than stated."
        )
    if unsettled:
        found.append(
            f"The fit does not converge: a value still changes by {percent(unsettled)} in the last round; start nearer "
            "to the answer, fit other parameters, or state a larger noise."
        )
    found += [
        f"{name} ends at the end of the box of the certified model: train a wider one, or leave it out."
        for name in edges
    ]
    found += [f"The data do not determine {words}: fit fewer parameters, or measure more." for words in invisible]
    for name, part in parts.items():
        if part is None:
            found.append(f"The part of the {name} is not known for this scene, so that the answer has no error bar.")
            continue
        worst = int(np.argmax(np.abs(part) / noise))
        if not invisible and abs(part[worst]) > noise[worst]:
            found.append(
                f"The {name} changes {unknowns[worst].name} by about {percent(abs(part[worst]))}, more than the noise "
                f"with {percent(noise[worst])}: {cures[name]}."
            )
    return tuple(found)


def warnings(residuals: Residuals, robust: bool) -> tuple[str, ...]:
    """What a reader should know although the answer is accepted, a sentence each."""
    found = []
    if residuals.misfit < 2 - residuals.limit:
        found.append(
            f"The misfit is {residuals.misfit:.3g} sigma, below the {2 - residuals.limit:.3g} that chance leaves at "
            "least: the noise is smaller than stated, so that its part is too large and may hide that of the mesh."
        )
    if residuals.white < BY_CHANCE:
        found.append(
            f"The residuals are not white (correlation of neighbours {residuals.lag:.2g}, probability by chance at "
            f"most {max(residuals.white, 1e-15):.0e}): the noise is correlated, or the model lacks something below it."
        )
    if residuals.outliers > max(1, 1e-3 * residuals.count) and not robust:
        found.append(
            f"{residuals.outliers} of {residuals.count} residuals exceed {OUTLIER:g} sigma: where these are outliers, "
            "use the robust loss."
        )
    return tuple(found)
