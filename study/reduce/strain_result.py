"""What ``softgrasp reduce`` returns for a scene with effects.finite_strain."""

from __future__ import annotations

from dataclasses import dataclass

from softgrasp.reduction.replay import FullRun
from softgrasp.reduction.strain.model import Box, StrainModel
from softgrasp.study.reduce.result import FullTimes


@dataclass(frozen=True)
class StrainPoint:
    """One model; errors are relative and in z unless they say otherwise, times in seconds.

    Attributes:
        N, k: dimension with the hand's 2 n_s, and displacements.
        tau, residual: of the weights, asked for and reached.
        cells: that carry a weight.
        error_own, error_own_velocity, error_own_energy_norm: on the scene's own run, which trained the model: of z, of
            v in M_ee, of (z, v) in (z'K_ee z + v'M_ee v)^(1/2).
        error_training: over all training runs.
        error_galerkin: the same of the model on all cells.
        floor: of the basis, on the scene's own run.
        error_materials, error_motions: largest on held-out runs; None without any.
        drift: largest change of the model's own energy that neither load nor damping explains, over all training runs.
        evaluations: of the force in a step.
        engine: of the stepper, "C" or "NumPy".
        time_offline: basis, model on all cells, forces and weights, after the full runs.
        time_setup, time_online: a new parameter before its run, and a run.
    """

    N: int
    k: int
    tau: float
    residual: float
    cells: int
    error_own: float
    error_own_velocity: float
    error_own_energy_norm: float
    error_training: float
    error_galerkin: float
    floor: float
    error_materials: float | None
    error_motions: float | None
    drift: float
    evaluations: float
    engine: str
    time_offline: float
    time_setup: float
    time_online: float


@dataclass(frozen=True)
class Test:
    """A full run that trained no model of its family.

    Attributes:
        kind: "material" or "motion", whichever is new.
        lam, mu: of the first layer [Pa].
        target: where the hand ends [m].
        errors: in z by N; None where the model refuses the run or fails.
    """

    kind: str
    lam: float
    mu: float
    target: tuple[float, ...]
    errors: dict[int, float | None]


@dataclass(frozen=True)
class Family:
    """Models of all N from the same training runs.

    Attributes:
        key: "own", the scene's run alone, or "box", runs at other materials and motions too.
        box: what they answer for.
        runs: full runs that trained them.
        points: with tau from the model on all cells, one for each N.
        curves: those, and others of some N with given tau.
        tests: held-out runs.
        models: those of ``points`` by N.
        refused: reason by N.
    """

    key: str
    box: Box
    runs: int
    points: tuple[StrainPoint, ...]
    curves: tuple[StrainPoint, ...]
    tests: tuple[Test, ...]
    models: dict[int, StrainModel]
    refused: dict[int, str]


@dataclass(frozen=True)
class StrainStudy:
    """All that is measured.

    Attributes:
        full: the scene's own full run.
        families: one or two.
        times: of the full run.
        linear: error in z of linear elasticity on the same scene.
        none: why there are no runs at other materials; empty when there are.
    """

    full: FullRun
    families: tuple[Family, ...]
    times: FullTimes
    linear: float
    none: str


def speed_up(point: StrainPoint, times: FullTimes) -> tuple[float, float, float | None]:
    """Same model again, new parameter, and break-even runs; as for linear models, costs are counted whole."""
    whole, new = times.factor + times.steps, point.time_setup + point.time_online
    return times.steps / point.time_online, whole / new, point.time_offline / (whole - new) if whole > new else None
