"""What a work-precision study measures: one class of points for each of its questions."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields
from typing import Any, ClassVar

from softgrasp.fem import SceneError
from softgrasp.study.precision.settings import Refine, Setting
from softgrasp.study.report import to_json

QUESTIONS = ("forward", "reduced", "bases", "riccati", "reduced_riccati")
CONTROL = ("riccati", "reduced_riccati")  # of these, the ones about feedback
TITLES = {
    "forward": "Full model: mesh, order, time step, solver",
    "reduced": "Reduced models: basis and N",
    "bases": "Bases: engine and tolerance",
    "riccati": "Riccati equation: method and tolerance",
    "reduced_riccati": "Reduced Riccati equation: basis and N",
}


@dataclass(frozen=True)
class Request:
    """What a study shall answer."""

    tolerance: float | None = None  # relative error of the deformation to answer for, or None
    budget: float | None = None  # seconds of a step to answer for, or None
    # arguments of ``--question``, each one or several with commas; empty stands for all questions
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        split = tuple(part.strip() for name in self.names for part in name.split(","))
        object.__setattr__(self, "names", split)
        unknown = [name for name in split if name not in QUESTIONS]
        if unknown:
            raise SceneError(f"--question {unknown[0]}: it must be one of {', '.join(QUESTIONS)}")
        if split and not (self.tolerance is None and self.budget is None) and not {"forward", "reduced"} <= set(split):
            raise SceneError("--tolerance and --budget need the questions forward and reduced; name both, or none")

    @property
    def questions(self) -> tuple[str, ...]:
        """In the order of :data:`QUESTIONS`."""
        return tuple(q for q in QUESTIONS if q in self.names or not self.names)

    @property
    def options(self) -> str:
        """As they are typed."""
        tolerance = "" if self.tolerance is None else f" --tolerance {self.tolerance!r}"
        budget = "" if self.budget is None else f" --budget {self.budget!r}s"
        return tolerance + budget + (f" --question {','.join(self.names)}" if self.names else "")


@dataclass(frozen=True)
class WorkPoint:
    """One point of a diagram."""

    question: ClassVar[str] = ""
    series: str  # points that are one line
    label: str  # the setting in words
    seconds: float  # what it costs
    error: float  # relative, of what the question is about
    ok: bool = True  # a setting that may be used; unstable models may not

    def to_row(self) -> dict[str, Any]:
        """A flat table row; what is not finite becomes None, and None of an optional attribute is left out."""
        values = {
            f.name: value for f in fields(self) if (value := getattr(self, f.name)) is not None or f.default is MISSING
        }
        return {"question": self.question, **{name: to_json(value) for name, value in values.items()}}


@dataclass(frozen=True, kw_only=True)
class RunPoint(WorkPoint):
    """A run of the full model, or of a reduced one that was made of it."""

    cells: tuple[int, ...] | None  # cells of the full model by direction
    order: int  # order of its elements
    steps: int  # number of its time steps
    solver: str  # name of its solver
    rtol: float | None  # relative tolerance of its solver, see Setting
    refine: Refine  # refinement of its mesh, see Setting
    error_displacement: float  # largest error of the outputs over the largest one; ``error`` is that against the hand
    error_range: tuple[float, float]  # between what ``error`` lies, given that of the reference
    p50: float  # median time of a step [s]; inf for an unstable model
    p99: float  # 99 % quantile of the time of a step [s]; inf for an unstable model
    max: float  # largest time of a step [s]; inf for an unstable model

    @property
    def setting(self) -> Setting:
        """Of the full run, or of that behind a reduced model."""
        return Setting(self.cells, self.order, self.steps, self.solver, self.rtol, self.refine)

    @property
    def parameters(self) -> dict[str, Any]:
        """What names the run in result.json."""
        return self.setting.parameters


@dataclass(frozen=True, kw_only=True)
class ForwardPoint(RunPoint):
    """A run of the full model."""

    question: ClassVar[str] = "forward"
    n_e: int  # tissue unknowns
    states: int  # dimension of the first-order model
    dt: float  # time step [s]
    mesh: float  # time of the mesh [s]
    assembly: float  # time of the assembly [s]
    factor: float  # time of the factorisation [s]
    per_step: float  # time of a step [s]
    # change of the deformation against the most steps on the same mesh; None for the most steps
    error_time: float | None = None
    error_solver: float | None = None  # against the usual solver on the same mesh and steps; None for that


@dataclass(frozen=True, kw_only=True)
class ReducedPoint(RunPoint):
    """A run of a reduced model; what is not named here is as in :class:`softgrasp.study.reduce.linear.result.Point`."""

    question: ClassVar[str] = "reduced"
    method: str  # reduction method, as in [reduction]
    N: int  # number of all columns of the basis
    N_tissue: int  # number of columns of the tissue
    split: tuple[int, ...]  # numbers of columns by part of the basis
    error_canonical: float  # error of the states (q, p) [1]
    error_energy: float  # error in the energy norm [1]
    projection_error_deformation: float  # error of the deformation by projection alone [1]
    projection_error: float  # error of the states by projection alone [1]
    time_offline: float  # time of basis and projection [s]
    time_setup: float  # time of the set-up of the reduced run [s]
    time_online: float  # time of all steps of the reduced run [s]
    spectral_abscissa: float  # largest real part of the poles [1/s]
    stable: bool  # whether no pole grows
    error_full: float  # error of the states against the full run behind the model [1]
    error_full_deformation: float  # error of the deformation against the full run behind the model [1]
    error_outputs_full: float  # of the deformation of the outputs against that run
    scratch: float  # seconds with everything before it
    mesh: str  # mesh and order of the full run in words

    @property
    def parameters(self) -> dict[str, Any]:
        """What names the run in result.json."""
        return super().parameters | {"method": self.method, "N": self.N}


@dataclass(frozen=True, kw_only=True)
class BasisPoint(WorkPoint):
    """A factorisation of the snapshots at a tolerance; orthonormality is the largest entry of ``|U'U - I|``."""

    question: ClassVar[str] = "bases"
    tolerance: float  # tolerance of the factorisation [1]
    columns: int  # number of columns of U
    orthonormality: float  # largest entry of |U'U - I| [1]


@dataclass(frozen=True, kw_only=True)
class RiccatiPoint(WorkPoint):
    """A solution of the Riccati equation by a method at a tolerance; ``reason`` when it was not reached."""

    question: ClassVar[str] = "riccati"
    method: str  # solver
    tolerance: float  # tolerance that was asked for [1]
    reason: str = ""  # why it was not reached, else empty
    residual: float  # relative residual, recomputed [1]
    repeats: int | None = None  # number of timed repeats
    rank: int | None = None  # number of columns of the factor Z
    newton_steps: int | None = None  # number of Newton steps
    solves: int | None = None  # number of shifted solves
    factorisations: int | None = None  # number of shifted factorisations


@dataclass(frozen=True, kw_only=True)
class ReducedRiccatiPoint(WorkPoint):
    """A reduced gain on the full plant; what is not named is as in the GainReport of ``lqr``, without its bounds."""

    question: ClassVar[str] = "reduced_riccati"
    method: str  # basis, as in [control]
    N: int  # number of all columns of the basis
    error_P: float  # noqa: N815
    error_K: float  # noqa: N815
    cost_excess: float  # excess cost over the optimal one [1]
    abscissa_full: float  # largest real part of the poles of the full loop [1/s]
    time_are: float  # time of the reduced Riccati equation [s]
    stable: bool  # whether the full loop is stable
    certified: bool  # whether that is proved
    reason: str  # why there is no gain, else empty
    sampled_radius: float  # largest modulus of the poles from tick to tick [1]
    time_lift: float  # seconds to project the equation and to lift its gain
    time_basis: float  # seconds of the basis, all orders together
    scratch: float  # seconds with everything before it
