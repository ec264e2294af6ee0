"""Sections of a scene for reduction, control and studies."""

from __future__ import annotations

from itertools import product
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from softgrasp.fem.scene.tissue import Box, Dropped, Label, NonNegative, Positive, Section, check_box

Range = Annotated[list[Positive], Field(min_length=2, max_length=2)]


_FRAMES = ("", "_relative")
_PODS = ("global_pod", "pod_fixed", "componentwise_pod", "componentwise_pod_fixed")
_PSD = (("psd",), ("", "_cotangent_lift", "_svd_like"), ("", "_fixed"), ("", "_qv"), _FRAMES)
BASES = (*map("".join, product(_PODS, _FRAMES)), *map("".join, product(*_PSD)), "craig_bampton")
"""Names of :mod:`softgrasp.reduction.bases.registry`, here because scenes are read without what builds bases."""


class Reduction(Section):
    """Which reduced models `softgrasp reduce` builds and compares."""

    methods: list[str] = Field(
        default_factory=list, description="bases by name [no unit]; empty: the paper's six and the best beyond them"
    )
    plugins: list[Label] = Field(
        default_factory=list,
        description="Python files with bases of your own, whose names `methods` may then have [no unit]; they join the "
        "comparison, and they run with your rights",
    )
    N: list[Annotated[int, Field(ge=1)]] = Field(
        default_factory=lambda: [4, 6, 8, 10, 12, 14, 18, 22, 26, 30, 40, 60],
        description="numbers of basis vectors to try, the hand's own included [1]",
    )
    energy: Annotated[float, Field(gt=0, lt=1)] = Field(
        0.999, description="share of the snapshot energy that picks N [1], the paper's 99.9 %"
    )
    inner: Literal["auto", "euclidean", "mass", "energy"] = Field(
        "auto",
        description="inner product of the bases [no unit]; auto: energy for canonical bases beyond the paper's six, "
        "which makes them ten times better, else Euclidean",
    )
    engine: Literal["tsqr", "svd", "gram"] = Field(
        "tsqr", description="factorisation of the snapshots [no unit]; gram is fast and loses small singular values"
    )
    lambda_range: Range | None = Field(
        None,
        description="range of lambda for tests at other parameters [Pa]; by default 0.6 to 10 times that of the first "
        "layer, 0.8 to 2.4 times with effects.finite_strain",
    )
    mu_range: Range | None = Field(
        None,
        description="range of mu for tests at other parameters [Pa]; by default 0.4 to 10 times that of the first "
        "layer, 0.8 to 2.4 times with effects.finite_strain",
    )

    train: Literal["corners", "greedy"] | list[Range] = Field(
        "corners",
        description="[lambda, mu] of full runs that train bases beside the scene's own, for the tests at other "
        "parameters [Pa]; corners: those of lambda_range and mu_range; empty: none; greedy: builds one certified model",
    )
    certify: Literal["off", "two", "proof", "estimate"] = Field(
        "off",
        description="one model with a bound or estimate of its error [no unit]: two bases and a proof, a proof or an "
        "estimate alone",
    )
    tolerance: Annotated[float, Field(gt=0, lt=1)] = Field(
        1e-2, description="relative error that a certified model is built to, and above which it refuses [1]"
    )
    norm: Literal["energy", "output"] = Field(
        "energy", description="what the tolerance is about [no unit]: energy norm of the deformation, or the outputs"
    )
    grid: Annotated[int, Field(ge=1)] = Field(
        20, description="values of lambda and of mu, logarithmically over their ranges, where the greedy looks [1]"
    )
    layers: Literal["together", "apart"] = Field(
        "together",
        description="layers keep their ratios to the first [no unit], or each has the factors of the box for itself, "
        "at as many points, spread evenly",
    )
    add: Annotated[int, Field(ge=1)] = Field(4, description="modes that each full run of the greedy adds [1]")
    max_N: Annotated[int, Field(ge=1)] = Field(320, description="largest N of the greedy's basis [1]")
    validation: Annotated[int, Field(ge=0)] = Field(
        0, description="random parameters where full runs test the certified model afterwards [1]"
    )
    motions: Literal["auto", "own", "unit", "mirrored"] | list[list[float]] = Field(
        "auto",
        description="motions that train [no unit]: own, the scene's; unit, every freedom of the hand by itself, for "
        "certified models; mirrored, the scene's with other signs too, or further targets [m], with "
        "effects.finite_strain; auto: own, and mirrored with that effect",
    )

    @model_validator(mode="after")
    def _check(self) -> Reduction:
        for key in ("lambda_range", "mu_range"):
            low, high = getattr(self, key) or (0.0, 0.0)
            if low > high:
                raise ValueError(f"{key} is [{low}, {high}]; the first must not exceed the second")
        return self


class Study(Section):
    """How `softgrasp study` and `effects` judge."""

    tolerance: Annotated[float, Field(gt=0, lt=1)] = Field(
        1e-3, description="relative change of the outputs that counts [1]"
    )
    repeats: Annotated[int, Field(ge=1)] = Field(5, description="repeats behind each median time [1]")


class Loop(Section):
    """How the feedback runs in the closed loop."""

    sampling: Literal["midpoint", "held"] = Field(
        "midpoint", description="feedback inside the midpoint rule, or sampled and held as on a robot [no unit]"
    )
    rate: Positive = Field(1000.0, description="sampling rate [Hz], held only")
    limit: Positive | list[Positive] | None = Field(
        None, description="largest force on the hand in each direction [N], one number or one per axis; none by default"
    )
    limit_torque: Positive | list[Positive] | None = Field(
        None,
        description="largest torque on a turning hand about each axis [N m], one number or one per axis; none by "
        "default",
    )
    delay: bool | Annotated[int, Field(ge=0, le=100)] = Field(
        False, description="delay of the load in samples, true for one [1], held only"
    )


def _with_hyphen(method: str) -> str:
    """Name of a solver with hyphens, "newton-adi": the one spelling in the hash and the file of a scene."""
    return method.replace("_", "-")


class ControlOutput(Section):
    """One vector-valued output of the control problem."""

    kind: Literal["node", "region", "hand"] = Field(description="a node, the mean of a region, or the hand [no unit]")
    point: list[float] | None = Field(None, description="the output is that of the node nearest to it [m]; kind node")
    box: Box | None = Field(None, description="[[lo], [hi]] [m]; mean over the nodes inside; kind region")
    name: Label = Field("", description="label [no unit]")

    @model_validator(mode="after")
    def _check(self) -> ControlOutput:
        for key, kind in (("point", "node"), ("box", "region")):
            if (getattr(self, key) is not None) != (self.kind == kind):
                raise ValueError(f"{key} and kind = '{kind}' go together; give both or neither")
        check_box(self.box, "box")
        return self


Weight = float | list[list[float]]


def _check_weight(key: str, weight: Weight, definite: bool) -> None:
    """Raises ValueError: a weight is no symmetric matrix, or not positive definite (else semidefinite)."""
    word = "> 0" if definite else ">= 0"
    if isinstance(weight, list):
        if any(len(row) != len(weight) for row in weight) or not weight:
            raise ValueError(f"{key} is not square; give a number or a square symmetric matrix")
        matrix = np.array(weight)
        if not np.array_equal(matrix, matrix.T):
            raise ValueError(f"{key} is not symmetric; give a number or a square symmetric matrix")
        eigenvalues = np.linalg.eigvalsh(matrix)
        least = float(eigenvalues[0])
        # rounding of eigvalsh is of the order n eps |matrix|
        noise = 10 * len(weight) * float(np.finfo(float).eps) * float(np.abs(eigenvalues).max())
        good = least > noise if definite else least >= -noise
        if not good:
            raise ValueError(f"{key} has the eigenvalue {least:.3g}; all must be {word}")
    elif weight < 0 or (definite and weight == 0):
        raise ValueError(f"{key} is {weight}; it must be {word}")


class Constraints(Section):
    """Plan of piecewise constant forces past every [[obstacle]], within the limits of the hand, with its margins."""

    force: Positive | list[Positive] | None = Field(
        None,
        description="largest force on the hand in each direction, and torque where it turns [N, N m], one number or "
        "one per axis; none by default",
    )
    speed: Positive | None = Field(None, description="largest speed of the hand in each direction [m/s]")
    jump: Positive | None = Field(None, description="largest change of the force from interval to interval [N, N m]")
    body: Literal["boundary"] | Annotated[list[Label | list[float]], Field(min_length=1)] = Field(
        "boundary",
        description="what keeps every gap [no unit]: the whole boundary, or some of its nodes with all between them, "
        "each given by the name of an output of kind node or by a point near to it [m]",
    )
    clearance: NonNegative = Field(0.0, description="distance to every obstacle beyond all margins [m]")
    margin: Literal["bound"] | NonNegative = Field(
        "bound",
        description="what the reduced plant may leave out at every node [m]; bound: the exact l1 bound for all forces "
        "within ``force``",
    )
    finite_strain: bool = Field(
        False,
        description="with effects.finite_strain: estimate the error of the linear plant under the plan, and plan "
        "again with it as a further margin [no unit]",
    )
    noise: NonNegative = Field(
        3.0,
        description="with control.observer: standard deviations of every node, and of the force, that gaps and limit "
        "keep as a further margin [1]",
    )
    N: Annotated[int, Field(ge=8)] = Field(
        22, description="states of the reduced plant of the plan, those of the hand included [1], even"
    )
    grid: Positive = Field(1.0, description="interval over which the plan holds the force [s]")
    parts: Annotated[int, Field(ge=1, le=100)] = Field(8, description="parts of an interval between checks [1]")
    horizon: Literal["auto"] | Positive = Field(
        "auto", description="length of the plan [s]; auto: longer until all that follows is proved safe"
    )
    penalty: Literal["auto"] | Positive = Field(
        "auto",
        description="cost of a metre inside an obstacle where no plan keeps all gaps [1/m]; auto: twenty times the "
        "mean cost of a metre of the way",
    )

    @model_validator(mode="after")
    def _check(self) -> Constraints:
        if self.N % 2:
            raise ValueError(f"N is {self.N}; displacements and velocities come in pairs, give an even number")
        return self


class SampleNoise(Section):
    """Standard deviations of the samples of an observer."""

    pose: Positive = Field(1e-5, description="of the displacement of the hand [m, rad]")
    marker: Positive = Field(1e-3, description="of the displacement of a marker [m]")
    speed: Positive | None = Field(
        None, description="of the velocity of the hand [m/s, rad/s]; where it is left out the velocity is no sample"
    )
    force: Positive | None = Field(
        None,
        description="of the force that the tissue puts on the hand [N, N m]; where it is left out there is no such "
        "sensor",
    )


class Disturbances(Section):
    """White noise that acts on hand and tissue between the samples."""

    hand: Positive = Field(0.02, description="acceleration along every freedom of the hand [m/s2, rad/s2 per sqrt(Hz)]")
    load: NonNegative = Field(0.05, description="load on the tissue along every axis [N per sqrt(Hz)]")
    box: Box | None = Field(
        None, description="[[lo], [hi]] [m]; the load is spread over the free nodes inside, over all without it"
    )

    @model_validator(mode="after")
    def _check(self) -> Disturbances:
        check_box(self.box, "box")
        return self


class Observer(Section):
    """Kalman filter of hand and tissue, from samples of every tick of the loop."""

    markers: list[list[float]] = Field(
        default_factory=list, description="points of the tissue whose displacement is measured, nearest free nodes [m]"
    )
    noise: SampleNoise = Field(
        default_factory=SampleNoise,
        description="standard deviations of the samples {pose, marker, speed, force} [m, N]",
    )
    disturbance: Disturbances = Field(
        default_factory=Disturbances,
        description="what moves hand and tissue besides the loads {hand, load, box} [m/s2, N per sqrt(Hz)]",
    )
    N: Annotated[int, Field(ge=8)] = Field(
        14, description="states of the filter that runs, those of the hand included [1], even"
    )
    delay: Annotated[int, Field(ge=0, le=20)] = Field(0, description="ticks that all samples come late [1]")

    @model_validator(mode="after")
    def _check(self) -> Observer:
        if self.N % 2:
            raise ValueError(f"N is {self.N}; displacements and velocities come in pairs, give an even number")
        if not self.markers and self.noise.force is None:
            raise ValueError("markers or noise.force is missing; an observer needs a sample of the tissue")
        return self


class Control(Section):
    """Quadratic cost: integral of y' Q y + u' R u."""

    outputs: Annotated[list[ControlOutput], Field(min_length=1)] = Field(
        description="outputs y {kind, point or box [m], name}"
    )
    Q: Weight = Field(1.0, description="weight of the outputs [1/(m2 s)]: number or matrix, positive semidefinite")
    R: Weight = Field(1.0, description="weight of the hand load [1/(N2 s)]: number or matrix, positive definite")

    method: Annotated[
        Literal["auto", "newton-adi", "newton_adi", "radi", "galerkin", "dense", "modal"], AfterValidator(_with_hyphen)
    ] = Field("auto", description="solver of the Riccati equation [no unit]; auto chooses by size")
    tolerance: Annotated[float, Field(gt=0, lt=1)] = Field(
        1e-10, description="relative residual of the Riccati equation [1]"
    )
    N: list[Annotated[int, Field(ge=1)]] = Field(
        default_factory=lambda: [4, 6, 8, 10, 12, 16, 20, 30, 40],
        description="dimensions of the reduced Riccati equations [1]",
    )
    loop: Loop = Field(default_factory=Loop, description="how the feedback runs [various]")
    constraints: Dropped[Constraints] = Field(
        None, description="plan past obstacles and within limits [various]; off unless given"
    )
    observer: Dropped[Observer] = Field(
        None, description="Kalman filter of the tissue from markers and forces [various]; off unless given"
    )

    @property
    def output_names(self) -> list[str]:
        """Names of the outputs, y1, y2, .. by number where none is given."""
        return [output.name or f"y{i + 1}" for i, output in enumerate(self.outputs)]

    @model_validator(mode="after")
    def _check(self) -> Control:
        names = self.output_names
        for i, name in enumerate(names):
            if name in names[:i]:
                raise ValueError(f"outputs[{names.index(name)}] and outputs[{i}] are both named {name}; name one anew")
        _check_weight("Q", self.Q, definite=False)
        _check_weight("R", self.R, definite=True)
        return self
