"""What ``softgrasp reduce`` returns: the points of every method, errors at other parameters, times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from softgrasp.reduction.bases.registry import Method
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.replay import FullRun

COMPARED = 14  # N at which methods are compared: the paper's
LARGER = 30  # N of the second model that is tested at other parameters


@dataclass(frozen=True)
class Point:
    """One basis at one N; errors are relative, times in seconds, the abscissa in 1/s. Unstable runs may overflow.

    Attributes:
        N: columns of V, the hand's included.
        N_tissue: columns without the hand's own, which bases with fixed solid modes have.
        split: of N_tissue over the parts of the decomposition: displacement and velocity of componentwise POD.
        error_deformation: |X - X_r|_F / |X|_F of X = [z, v_z], after removing the rigid motion of the hand: the measure
            that tables, pictures and the best method go by.
        error: the same of X = [q_s, v_s, q_e, v_e], for every basis the paper's error [SBRH21].
        error_canonical: the same of X = [q_s, p_s, q_e, p_e].
        error_energy: largest error of the tissue's energy over its largest value.
        projection_error_deformation, projection_error: the floors that the basis sets to the first two.
        time_offline: basis and projection; one factorisation of the snapshots serves all N.
        time_setup: what a new parameter costs before its run: small matrices, test of stability, propagator.
        time_online: a whole run.
        spectral_abscissa: largest real part of an eigenvalue.
        stable: no growing mode.
    """

    N: int
    N_tissue: int
    split: tuple[int, ...]
    error_deformation: float
    error: float
    error_canonical: float
    error_energy: float
    projection_error_deformation: float
    projection_error: float
    time_offline: float
    time_setup: float
    time_online: float
    spectral_abscissa: float
    stable: bool


@dataclass(frozen=True)
class Sweep:
    """One method at all its N.

    Attributes:
        method: which.
        points: one for every N.
        models: some of them by the number of their point, see :func:`kept_points`. All would fill the memory.
        sigma: singular values of every part of the decomposition.
        refused: N in the scene that this basis cannot have, each with its reason.
        N_energy: N that keeps the scene's share of the energy; None without snapshots.
        inner: inner product of the bases.
    """

    method: Method
    points: tuple[Point, ...]
    models: dict[int, ReducedModel]
    sigma: tuple[np.ndarray, ...]
    refused: dict[int, str] = field(default_factory=dict)
    N_energy: int | None = None
    inner: str = ""


@dataclass(frozen=True)
class TestedModel:
    """One reduced model that is tested at other parameters.

    Attributes:
        method: of its basis.
        several: whether runs at several parameters trained it.
        model: itself.
    """

    method: Method
    several: bool
    model: ReducedModel

    @property
    def family(self) -> tuple[str, bool]:
        """Models of one family have nested bases."""
        return self.method.key, self.several


@dataclass(frozen=True)
class BoxPoint:
    """One parameter with the deformation error of every model there.

    Attributes:
        lam, mu: of the first layer [Pa].
        trained: a run at this parameter trained some of the bases, so that it is no test.
        errors: one for each model.
    """

    lam: float
    mu: float
    trained: bool
    errors: tuple[float, ...]


@dataclass(frozen=True)
class BoxErrors:
    """Deformation errors of one model: at the scene's own parameter, and over those that trained no basis.

    Attributes:
        method: key.
        N: its dimension.
        runs: full runs that trained it.
        own, median, largest: errors.
    """

    method: str
    N: int
    runs: int
    own: float
    median: float
    largest: float


@dataclass(frozen=True)
class Box:
    """All tests at other parameters.

    Attributes:
        models: tested.
        points: errors over the box.
        summary: one for each model.
        trained_at: [lambda, mu] of the runs that trained the models with ``several``, the scene's own first [Pa].
        ranges: of lambda and mu [Pa].
        none: why there are no tests; empty when there are.
    """

    models: tuple[TestedModel, ...] = ()
    points: tuple[BoxPoint, ...] = ()
    summary: tuple[BoxErrors, ...] = ()
    trained_at: tuple[tuple[float, float], ...] = ()
    ranges: tuple[Sequence[float], Sequence[float]] = ((), ())
    none: str = ""


@dataclass(frozen=True)
class FullTimes:
    """Seconds of the full model: the steps of a run alone, and the factorisation before them."""

    steps: float
    factor: float


@dataclass(frozen=True)
class Speed:
    """One method against the full model at the stable N nearest to the one compared.

    Attributes:
        method, title: which.
        N: columns of V.
        N_tissue: those without the hand's own.
        stable: no model is otherwise; False when the method has no stable one.
        time_offline, time_setup, time_online: [s].
        speedup_same_model: full steps over a reduced run of the same model again, both with everything prefactored.
        speedup_new_parameter: full factorisation and steps over reduced set-up and run.
        break_even_runs: time_offline / (full run - reduced run) at new parameters; None when the reduced is not faster.
    """

    method: str
    title: str
    N: int
    N_tissue: int
    stable: bool
    time_offline: float
    time_setup: float
    time_online: float
    speedup_same_model: float
    speedup_new_parameter: float
    break_even_runs: float | None


@dataclass(frozen=True)
class ReductionStudy:
    """All that ``softgrasp reduce`` measures.

    Attributes:
        full: the full run.
        sweeps: every method.
        times: of the full model.
        speeds: every method with a model against the full model.
        box: errors at other parameters.
        findings: what the numbers show, in sentences.
        speed_notes: what the times are measured against.
    """

    full: FullRun
    sweeps: tuple[Sweep, ...]
    times: FullTimes
    speeds: tuple[Speed, ...]
    box: Box
    findings: tuple[str, ...]
    speed_notes: tuple[str, ...]


def nearest(points: Sequence[Point], N: int = COMPARED, stable: bool = True) -> int | None:
    """Number of the point nearest to N, the smaller of two, among the stable ones or all."""
    numbers = [i for i, p in enumerate(points) if p.stable or not stable]
    return min(numbers, key=lambda i: (abs(points[i].N - N), points[i].N)) if numbers else None


def best(points: Sequence[Point]) -> int | None:
    """Number of the stable point with the least error of the deformation."""
    numbers = [i for i, p in enumerate(points) if p.stable and np.isfinite(p.error_deformation)]
    return min(numbers, key=lambda i: points[i].error_deformation) if numbers else None


def kept_points(points: Sequence[Point]) -> set[int]:
    """Points whose models are kept: the best stable one, and those that pictures and the parameter box compare."""
    numbers = (best(points), nearest(points), nearest(points, LARGER), nearest(points, stable=False))
    return {i for i in numbers if i is not None}
