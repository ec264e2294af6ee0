"""What a scene solves, before it is solved: equation, sizes, time scales, effects that matter, error of the mesh."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem import (
    SMALL_STRAIN,
    Scene,
    expected_order,
    extrapolated,
    largest_acceleration,
    lowest_modes,
    percent,
    spread,
)
from softgrasp.fem.effects import EFFECTS, Gate
from softgrasp.fem.effects.gate import SMALL_SHARE, Sag
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.model.memory import (
    Need,
    chosen,
    factor_bytes,
    need,
    steps_of,
)
from softgrasp.fem.model.refined import by_lines, scene_ends
from softgrasp.fem.model.scales import measure
from softgrasp.fem.run.forecast import Forecast, forecasts
from softgrasp.fem.solve.solvers import DIRECT_LIMIT
from softgrasp.study.forward.accuracy import estimate_error
from softgrasp.study.forward.bisected import bisected_copy
from softgrasp.study.forward.cautions import (
    coarse,
    locking,
    looked_at,
    out_of_reach,
    poisson_ratios,
    small_obstacles,
    turned,
)
from softgrasp.study.forward.copies import LOOKED_AT, Copy, box_copy, build_seconds, coarser_copy, cubic_copy
from softgrasp.study.forward.filed import file_copy
from softgrasp.study.forward.result import ModelSizes, model_sizes, output_places
from softgrasp.study.report import to_json
from softgrasp.study.report.equation import Equation, equation

if TYPE_CHECKING:  # plans are not imported where a scene asks for none
    from softgrasp.lqr.design.constrained import PlanSizes

MODES = 6
ESTIMATE_SECONDS = 0.5  # a dearer estimate of the mesh is left to simulate
LARGE = 200_000  # cells beyond which rank 0 does not look for the ends
BUILT_SECONDS = 0.1  # modelled time beyond which the sizes of a box are computed and nothing of it is assembled


@dataclass(frozen=True)
class SolverPlan:
    """Solver, reason and estimated memory of its factor over all ranks [byte] (0: no factor)."""

    name: str  # name of the solver
    reason: str  # why it is chosen
    factor_bytes: float  # memory of the factor over all ranks [byte]; 0 without one


@dataclass(frozen=True)
class TimePlan:
    """Step and end [s] against the first periods T_k = 2 pi / omega_k of the clamped tissue [s, 1/s]."""

    steps: int  # number of time steps
    dt: float  # time step [s]
    end: float  # end of the run [s]
    omega: tuple[float, ...]  # first angular frequencies of the clamped tissue [1/s]
    periods: tuple[float, ...]  # their periods 2 pi / omega [s]
    omega_dt: tuple[float, ...]  # their products with the time step [1]


@dataclass(frozen=True)
class EffectReport:
    """One effect in this scene: `fem.effects` says what the entries mean."""

    on: bool  # whether the scene switches it on
    term: str  # its term in the equation
    operators: tuple[str, ...]  # names of the operators that it adds
    cost: str  # what it adds to a run, a sentence
    gate: Gate  # number that decides whether it matters


@dataclass(frozen=True)
class EndReport:
    """Singular ends of one kind: how many points (2D) or edges (3D), and the smallest exponent alpha [1]."""

    kind: str  # kind of the ends in words
    count: int  # number of points (2D) or edges (3D)
    alpha: float  # smallest exponent of the solution there [1]


@dataclass(frozen=True)
class MeshSummary:
    """What is known of the mesh's error before a run."""

    ends: tuple[EndReport, ...]  # singular ends by kind and exponent, the strongest first
    order: float  # expected order of the outputs in n_e^(1/d) d/2, that is in the cell size h on even meshes [1]
    graded: bool  # whether cells shrink towards the ends
    first: bool  # whether a run may refine this mesh further
    coarser: bool  # whether the estimate is extrapolated from coarser cells
    estimate: float | None  # estimated relative error of the deformation [1]; None where it takes long
    bound: float | None  # bound on the relative error of the deformation [1]; None where it takes long
    time_error: float | None  # that of the time steps [1]
    shift: float | None  # of the ends of the zone against contact.box [m]


@dataclass(frozen=True)
class Explanation:
    """All that explain reports."""

    name: str  # of the scene
    equation: Equation  # with exactly the terms of this scene
    sizes: ModelSizes  # unknowns and entities
    solver: SolverPlan  # choice and cost
    time: TimePlan  # step against periods
    effects: dict[str, EffectReport]  # by name
    poisson: dict[str, float]  # Poisson's ratio of each material by layer name [1]
    missing: tuple[str, ...]  # effects that are off and would matter
    idle: tuple[str, ...]  # effects that are on and do not matter
    sag: Sag  # the tissue at rest under its weight
    warnings: tuple[str, ...]  # one sentence each
    outputs: dict[str, str]  # name and place of each output
    memory: Need  # estimated need of mesh, factor and steps
    forecasts: tuple[Forecast, ...]  # modelled cost of the run by the number of ranks; none at finite strain
    snapshot_columns: int  # number of states that the run stores in memory
    snapshot_bytes: int  # memory of these states over all ranks [byte]
    mesh: MeshSummary  # singular ends, and the error they leave
    coarser: int  # unknowns of the smaller copy of a large mesh that gives modes, sag and estimate [1]; 0: none
    built: bool  # whether the mesh itself was assembled; else the entries are computed from the copy
    counted: bool  # whether the unknowns are counted; else computed from the copy
    sampled: bool  # whether its cells are counted on a sample of those that are bisected
    copied: str  # whose modes and sag these are, where they are a copy's, in sentences
    dimension: int  # 2 or 3
    plan: PlanSizes | None = None  # of the plan past obstacles that `control` makes; None where it makes none

    def to_dict(self) -> dict[str, Any]:
        """Plain dicts, lists and numbers for JSON; what is not known is None."""
        result: dict[str, Any] = to_json(asdict(replace(self, equation=self.equation.plain())))
        return result


def explain(scene: Scene, comm: MPI.Intracomm) -> Explanation:
    """Assemble a scene, of a large mesh a smaller copy, and say what it is. Collective."""
    if build_seconds(scene) > BUILT_SECONDS:
        copy, mesh = box_copy(scene, comm), None
    else:
        copy, mesh = file_copy(scene, comm)
        copy = copy or bisected_copy(scene, comm)
        if copy is None:
            copy, mesh = cubic_copy(scene, comm, mesh)
    if copy is not None:
        return _explained(scene, copy.model, copy.sizes, copy=copy)
    return explain_model(build(scene, comm=comm, mesh=mesh, run=False))


def explain_model(model: Model) -> Explanation:
    """Say what a built model is. Collective. Raises SolverError: its modes or its sag cannot be computed."""
    return _explained(model.scene, coarser_copy(model), model_sizes(model), model)


def _explained(
    scene: Scene, looked: Model, sizes: ModelSizes, model: Model | None = None, copy: Copy | None = None
) -> Explanation:
    """The explanation of a scene of these sizes; modes and sag are those of ``looked``.

    Collective. ``model``: that of the scene, None where there is a ``copy`` instead.
    """
    known = model or looked
    d, ranks = looked.system.layout.dimension, sizes.ranks
    work = steps_of(scene, sizes.n_e, d, ranks)
    name, reason = chosen(scene, work)
    copies = work.copies(name)
    small = looked.system
    if small.layout.n_e <= DIRECT_LIMIT[d]:  # beyond, modes take minutes
        omega, Phi = lowest_modes(small, min(MODES, small.layout.n_e))
    else:
        omega, Phi = np.zeros(0), np.zeros((small.layout.n_local, 0))
    problem = measure(looked, omega, Phi, largest_acceleration(scene, sizes.n_s, small.M_hand))
    away = out_of_reach(looked, problem.response.rms, problem.length)
    problem = replace(problem, clear=bool(away))
    reports = {
        key: EffectReport(e.active(scene), e.term, e.operators(scene), e.cost, e.gate(problem))
        for key, e in EFFECTS.items()
    }
    columns = _snapshot_columns(scene, sizes.n_e)
    dt = scene.time_end / scene.time.steps
    periods = tuple((2 * np.pi / omega).tolist())
    poisson = poisson_ratios(small)
    copied = "" if copy is None else copy.text
    if model is not None and looked is not model:
        copied = f"{LOOKED_AT}the same scene on coarser cells, n_e = {small.layout.n_e}."
    return Explanation(
        name=scene.name,
        equation=equation(scene),
        sizes=sizes,
        solver=SolverPlan(name, reason, factor_bytes(name, sizes.n_e, d, copies)),
        time=TimePlan(scene.time.steps, dt, scene.time_end, problem.omega, periods, tuple((omega * dt).tolist())),
        effects=reports,
        poisson=poisson,
        missing=tuple(key for key, r in reports.items() if not r.on and r.gate.matters),
        idle=tuple(key for key, r in reports.items() if r.on and not r.gate.matters),
        sag=problem.sag,
        warnings=(
            *known.space.mesh.notes,
            *_warnings(scene, poisson, omega, dt, d, reports, problem.sag),
            *small_obstacles(known, 1.0 if copy is None else copy.finer, scene.tissue.order),
            *away,
            *(() if copy is None else copy.notes),
        ),
        outputs=output_places(known),
        memory=need(scene, d, sizes.cells, ranks, run=True),
        forecasts=forecasts(looked, scene, sizes.n_e, sizes.cells),
        snapshot_columns=columns,
        snapshot_bytes=16 * sizes.n_e * columns,
        mesh=mesh_report(scene, looked, sizes.n_e, model, copy),
        coarser=0 if looked is model else small.layout.n_e,
        built=model is not None,
        counted=copy is None or copy.counted,
        sampled=copy is not None and copy.ends is not None,
        copied=copied,
        dimension=d,
        plan=_plan(known, None if copy is None else copy.boundary),
    )


def _snapshot_columns(scene: Scene, n_e: int) -> int:
    """Number of states that a run keeps in memory."""
    columns = scene.time.steps // scene.output.every + 1 if scene.output.snapshots in ("auto", "memory") else 0
    return len(spread(columns, looked_at(n_e))) if scene.output.snapshots == "auto" else columns


def _plan(model: Model, boundary: int | None) -> PlanSizes | None:
    """Sizes of the quadratic program of `control`, for a mesh with so many nodes on its boundary. Collective."""
    if model.scene.control is None or model.scene.control.constraints is None:
        return None
    from softgrasp.lqr.design.constrained import plan_sizes  # no other scene needs it

    return plan_sizes(model, boundary)


def mesh_report(
    scene: Scene, looked: Model, n_e: int, model: Model | None = None, copy: Copy | None = None
) -> MeshSummary:
    """Look for singular ends and estimate the error, that of a coarser copy where the mesh is large. Collective."""
    known = model or looked
    tissue, order, refine = known.space.mesh, scene.tissue.order, scene.tissue.refine
    small = tissue.mesh.topology.index_map(tissue.dimension).size_global <= LARGE and (copy is None or copy.alike)
    ends = None if copy is None else copy.ends
    if ends is None and small:
        ends = scene_ends(known.system.layout.comm, tissue, known.scene)
    pairs = () if ends is None else zip(ends.kind, ends.alpha, strict=True)
    counts = Counter((kind, round(float(alpha), 3)) for kind, alpha in pairs)
    kinds = tuple(EndReport(k, n, a) for (k, a), n in sorted(counts.items(), key=lambda item: item[0][1]))
    graded = refine is not None and refine.grading != "off"
    edges = graded and tissue.dimension == 3 and not by_lines(scene)
    converges = 2.0 * order if ends is None else expected_order(ends, order, graded, edges)
    error = None if model is None else estimate_error(model, ESTIMATE_SECONDS)[0]
    if error is None and looked is not model and looked.scene.tissue.order == order and (copy is None or copy.alike):
        found = estimate_error(looked, ESTIMATE_SECONDS, cheapest=True)[0]  # it is extrapolated anyway
        error = None if found is None else extrapolated(found, known, n_e)
    coarse = error is not None and error.by == "coarser"
    values = (
        (None,) * 4
        if error is None
        else (
            error.estimate,
            error.bound,
            error.time_error,
            None if model is None else error.shift,
        )
    )
    first = refine is not None and refine.tolerance is not None and refine.passes > 0
    return MeshSummary(kinds, converges, graded, first, coarse, *values)


def _warnings(
    scene: Scene, poisson: dict[str, float], omega: Any, dt: float, d: int, effects: dict[str, EffectReport], sag: Sag
) -> list[str]:
    texts = locking(poisson, scene.tissue.order)
    if len(omega):
        texts += coarse(float(omega[0]), dt, scene.time_end, "the first period")
    if effects["gravity"].on and not sag.gradient.linear and not effects["finite_strain"].on:
        texts.append(
            f"At rest under its weight the tissue would sag by {sag.largest:.2g} m and |grad z| would be above "
            f"{SMALL_STRAIN} in {percent(sag.gradient.share)} of the body, and at most {sag.gradient.typical:.2g} in "
            f"{percent(1 - SMALL_SHARE)} of it: linear elasticity assumes small strains and rotations, "
            "effects.finite_strain does not."
        )
    if scene.effects.rotation and scene.effects.frame is None:
        texts += turned(max(map(abs, (scene.motion.target or [])[d:]), default=0.0))
    return texts
