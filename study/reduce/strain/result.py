"""What ``softgrasp reduce`` finds at finite strain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from softgrasp.reduction import FullRun, StrainModel, TrainingDomain
from softgrasp.study.reduce.times import FullTimes, Turns

CELLS_AT = (14, 24)  # N at which tau is varied


@dataclass(frozen=True)
class StrainPoint:
    """One model at finite strain; errors are relative and in z unless they say otherwise, times in seconds."""

    N: int  # dimension with the hand's 2 n_s
    k: int  # displacements
    tau: float  # largest |G x - b| / |b| of the cubature weights x that was asked for
    residual: float  # |G x - b| / |b| that was reached
    cells: int  # that carry a weight
    error_own: float  # of z on the scene's own run
    error_own_velocity: float  # of v in M_ee on the scene's own run
    error_own_energy_norm: float  # of (z, v) in (z'K_ee z + v'M_ee v)^(1/2) on the scene's own run
    estimate_own: float  # what the model itself estimates of ``error_own``
    error_training: float  # over all training runs
    error_galerkin: float  # over all training runs, of the model on all cells
    floor: float  # of the basis, on the scene's own run
    error_materials: float | None  # largest on held-out runs of new materials; None without any
    error_motions: float | None  # largest on held-out runs of new motions; None without any
    # largest change of the model's own energy that neither load nor damping explains, over all training runs
    drift: float
    evaluations: float  # of the force in a step
    engine: str  # of the stepper, "C" or "NumPy"
    time_offline: float  # basis, model on all cells, forces and weights, after the full runs
    time_setup: float  # of a new parameter before its run
    time_online: float  # of a run
    time_estimate: float  # of the error of a run, after it


@dataclass(frozen=True)
class HeldOutTest:
    """A full run that trained no model of its family."""

    kind: str  # "material" or "motion", whichever is new
    lam: float  # first Lamé constant of the first layer [Pa]
    mu: float  # shear modulus of the first layer [Pa]
    target: tuple[float, ...]  # where the hand ends [m]
    errors: dict[int, float | None]  # in z by N; None where the model refuses the run or fails
    estimates: dict[int, float | None]  # of them by N, made by the model without the full run


@dataclass(frozen=True)
class StrainFamily:
    """Models of all N from the same training runs."""

    key: str  # "own", the scene's run alone, or "box", runs at other materials and motions too
    box: TrainingDomain  # what they answer for
    runs: int  # full runs that trained them
    points: tuple[StrainPoint, ...]  # with tau from the model on all cells, one for each N
    curves: tuple[StrainPoint, ...]  # those, and others of some N with given tau
    tests: tuple[HeldOutTest, ...]  # held-out runs
    models: dict[int, StrainModel]  # those of ``points`` by N
    refused: dict[int, str]  # reason by N

    @property
    def title(self) -> str:
        """How its models were trained."""
        return "trained on the scene's run" if self.key == "own" else "trained over the box"


@dataclass(frozen=True)
class StrainStudy:
    """All that is measured."""

    full: FullRun  # the scene's own full run
    families: tuple[StrainFamily, ...]  # one or two
    times: FullTimes  # of the full run
    turns: Turns  # full model and the most accurate reduced one in turn
    linear: float  # error in z of linear elasticity on the same scene
    none: str  # why there are no runs at other materials; empty when there are


def most_accurate(families: Sequence[StrainFamily]) -> tuple[StrainPoint, StrainFamily]:
    """The point of the least error on the scene's own run."""
    return min(((p, f) for f in families for p in f.points), key=lambda pair: pair[0].error_own)
