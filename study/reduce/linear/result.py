"""What ``softgrasp reduce`` returns: the points of every method, errors at other parameters, times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from softgrasp.reduction import FullRun, Method, ReducedModel
from softgrasp.study.reduce.result import reduce_result
from softgrasp.study.reduce.times import FullTimes, Turns

COMPARED = 14  # N at which methods are compared: the paper's
LARGER = 30  # N of the second model that is tested at other parameters
POINT_UNITS = {"spectral_abscissa": " [1/s]", "time_offline": " [s]", "time_setup": " [s]", "time_online": " [s]"}
"""Units of a point's fields, as they follow its names; the others are shares and counts."""
N_NOTE = (
    "N counts all columns of V for every method, as in the paper, also the hand's own 2 n_s of bases with fixed solid "
    "modes. V_e: those without the hand's (N_tissue), for componentwise POD displacements + velocities."
)


@dataclass(frozen=True)
class Point:
    """One basis at one N; errors are relative, times in seconds, the abscissa in 1/s. Unstable runs may overflow."""

    N: int  # columns of V, the hand's included
    N_tissue: int  # columns without the hand's own, which bases with fixed solid modes have
    # of N_tissue over the parts of the decomposition: displacement and velocity of componentwise POD
    split: tuple[int, ...]
    # |X - X_r|_F / |X|_F of X = [z, v_z], after removing the rigid motion of the hand: the measure that tables,
    # pictures and the best method go by
    error_deformation: float
    error: float  # |X - X_r|_F / |X|_F of X = [q_s, v_s, q_e, v_e]: the paper's error [SBRH21]
    error_canonical: float  # |X - X_r|_F / |X|_F of X = [q_s, p_s, q_e, p_e]
    error_energy: float  # largest error of the tissue's energy over its largest value
    projection_error_deformation: float  # least ``error_deformation`` of any state in the basis
    projection_error: float  # least ``error`` of any state in the basis
    time_offline: float  # processor time of basis and projection [s]; one factorisation of the snapshots serves all N
    time_setup: float  # what a new parameter costs before its run: small matrices, test of stability, propagator
    time_online: float  # a whole run
    spectral_abscissa: float  # largest real part of an eigenvalue
    stable: bool  # no growing mode


@dataclass(frozen=True)
class MethodSweep:
    """One method at all its N."""

    method: Method  # which
    points: tuple[Point, ...]  # one for every N
    # some of them by N, see :func:`kept_points`. All would fill the memory.
    models: dict[int, ReducedModel]
    sigma: tuple[np.ndarray, ...]  # singular values of every part of the decomposition
    # N in the scene that this basis cannot have, each with its reason
    refused: dict[int, str] = field(default_factory=dict)
    N_energy: int | None = None  # N that keeps the scene's share of the energy; None without snapshots
    inner: str = ""  # inner product of the bases


@dataclass(frozen=True)
class TestedModel:
    """One reduced model that is tested at other parameters."""

    method: Method  # of its basis
    several: bool  # whether runs at several parameters trained it; with the same method the bases are nested
    model: ReducedModel  # itself


@dataclass(frozen=True)
class BoxPoint:
    """One parameter with the deformation error of every model there."""

    lam: float  # first Lamé constant of the first layer [Pa]
    mu: float  # shear modulus of the first layer [Pa]
    trained: bool  # a run at this parameter trained some of the bases, so that it is no test
    errors: tuple[float, ...]  # one for each model


@dataclass(frozen=True)
class BoxErrors:
    """Deformation errors of one model: at the scene's own parameter, and over those that trained no basis."""

    method: str  # key
    N: int  # its dimension
    runs: int  # full runs that trained it
    own: float  # error at the scene's own parameter
    median: float  # median error over parameters that trained no basis
    largest: float  # largest error over parameters that trained no basis


@dataclass(frozen=True)
class DomainTests:
    """All tests at other parameters."""

    models: tuple[TestedModel, ...] = ()  # tested
    points: tuple[BoxPoint, ...] = ()  # errors over the box
    summary: tuple[BoxErrors, ...] = ()  # one for each model
    # [lambda, mu] of the runs that trained the models with ``several``, the scene's own first [Pa]
    trained_at: tuple[tuple[float, float], ...] = ()
    ranges: tuple[Sequence[float], Sequence[float]] = ((), ())  # of lambda and mu [Pa]
    none: str = ""  # why there are no tests; empty when there are

    def to_json(self) -> dict[str, Any]:
        """The entry "box" in ``result.json``."""
        models = [{"method": m.method.key, "N": m.model.N, "several": m.several} for m in self.models]
        points = [
            {"lambda": p.lam, "mu": p.mu, "trained": p.trained}
            | {"errors": [m | {"error_deformation": e} for m, e in zip(models, p.errors, strict=True)]}
            for p in self.points
        ]
        return {"reason_for_none": self.none, "trained_at": self.trained_at, "summary": self.summary, "points": points}


@dataclass(frozen=True)
class ReductionStudy:
    """All that ``softgrasp reduce`` measures."""

    full: FullRun  # the full run
    sweeps: tuple[MethodSweep, ...]  # every method
    times: FullTimes  # of the full model
    box: DomainTests  # errors at other parameters
    turns: Turns | None  # full model and the most accurate stable reduced one in turn; None without any
    findings: tuple[str, ...]  # what the numbers show, in sentences
    speed_notes: tuple[str, ...]  # what the times are measured against

    def speed(self, method: Method, p: Point) -> dict[str, Any]:
        """One entry of "speed" in ``result.json``."""
        keys = ("N", "N_tissue", "stable", "time_offline", "time_setup", "time_online")
        up = self.times.against(p)
        return {
            "method": method.key,
            "title": method.title,
            **{key: getattr(p, key) for key in keys},
            "speedup_same_model": up.again,
            "speedup_new_parameter": up.new,
            "break_even_runs": up.break_even_runs,
        }

    def result(self, seconds: dict[str, float]) -> dict[str, Any]:
        """The keys of ``result.json``; ``seconds`` of the stages. Collective."""
        full, stages = self.full.trajectory.seconds, ("mesh", "assembly", "factor", "steps", "per_step")
        return reduce_result(
            self.full,
            {
                "N_means": N_NOTE,
                "methods": {s.method.key: s.points for s in self.sweeps},
                "about": {
                    s.method.key: {
                        "title": s.method.title,
                        "paper": s.method.paper,
                        "structure_preserving": s.method.preserving,
                        "inner": s.inner,
                        "N_energy": s.N_energy,
                        "N_refused": {N: f"N = {N}: {reason}" for N, reason in s.refused.items()},
                    }
                    for s in self.sweeps
                },
                "findings": self.findings,
                "speed": [self.speed(method, p) for method, p in timed_points(self.sweeps)],
                "speed_notes": self.speed_notes,
                "headline": self.turns,
                "box": self.box.to_json(),
            },
            {key: full[key] for key in stages} | self.times.to_json() | seconds,
        )


def nearest(points: Sequence[Point], N: int = COMPARED, stable: bool = True) -> Point | None:
    """The point nearest to N, the smaller of two, among the stable ones or all."""
    chosen = [p for p in points if p.stable or not stable]
    return min(chosen, key=lambda p: (abs(p.N - N), p.N), default=None)


def by_error(sweeps: Sequence[MethodSweep]) -> list[tuple[MethodSweep, Point]]:
    """Methods with their stable point nearest to the N compared, the least error of the deformation first."""
    chosen = [(s, p) for s in sweeps if (p := nearest(s.points)) is not None]
    return sorted(chosen, key=lambda c: np.nan_to_num(c[1].error_deformation, nan=np.inf))


def timed_points(sweeps: Sequence[MethodSweep]) -> list[tuple[Method, Point]]:
    """Methods with the point whose times are shown: the stable one nearest to the N compared, else any."""
    chosen = [(s.method, nearest(s.points) or nearest(s.points, stable=False)) for s in sweeps]
    return [(method, p) for method, p in chosen if p is not None]


def best(points: Sequence[Point]) -> Point | None:
    """The stable point with the least error of the deformation."""
    chosen = [p for p in points if p.stable and np.isfinite(p.error_deformation)]
    return min(chosen, key=lambda p: p.error_deformation, default=None)


def unbeaten[T](points: Sequence[tuple[float, float, T]], gain: float = 0.0) -> list[tuple[float, float, T]]:
    """The Pareto front: those of (cost, error, what) that no other beats in both, by cost.

    A larger cost must gain more than the share ``gain`` of the error.
    """
    front: list[tuple[float, float, T]] = []
    for point in sorted(points, key=lambda p: p[:2]):
        if not front or point[1] < (1 - gain) * front[-1][1]:
            front.append(point)
    return front


def kept_points(points: Sequence[Point]) -> set[int]:
    """N whose models are kept: of the best stable one, and of those that pictures and the parameter box compare."""
    chosen = (best(points), nearest(points), nearest(points, LARGER), nearest(points, stable=False))
    return {p.N for p in chosen if p is not None}
