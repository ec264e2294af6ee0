"""Every basis at every N against the full run: errors, times, stability."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.scene.control import Reduction
from softgrasp.reduction.basis import Basis
from softgrasp.reduction.errors import Comparison
from softgrasp.reduction.model import ModelError, ReducedModel
from softgrasp.reduction.online import run
from softgrasp.reduction.projection import project
from softgrasp.reduction.registry import METHODS, PAPER_METHODS, Method, find_method, make_bases
from softgrasp.reduction.replay import Reference, prepare
from softgrasp.reduction.states import BasisError, States
from softgrasp.reduction.truncation import Truncation
from softgrasp.study.report.files import plain

BEYOND = ("psd_svd_like", "psd_svd_like_fixed", "psd_cotangent_lift_fixed", "psd_fixed_relative", "craig_bampton")
REPEATS, SETUPS = 15, 7  # behind each median of the online time and of the set-up
COMPARED = 14  # N at which methods are compared: the paper's
LARGER = 30  # N of the second model that is tested at other parameters

Progress = Callable[[str, int, int], None]
"""Called with the method, what is done and what there is."""


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
class Swept:
    """One method of the sweep.

    Attributes:
        method: which.
        points: one for every N.
        models: some of them by the number of their point: those of :func:`noted`. All would fill the memory.
        sigma: singular values of every part of the decomposition.
        refused: N in the scene that this basis cannot have, each with its reason.
        kept: N that keeps the wanted share of the energy; None without snapshots.
        inner: inner product of the bases.
    """

    method: Method
    points: tuple[Point, ...]
    models: dict[int, ReducedModel]
    sigma: tuple[np.ndarray, ...]
    refused: dict[int, str] = field(default_factory=dict)
    kept: int | None = None
    inner: str = ""

    def as_rows(self) -> list[dict[str, Any]]:
        """For result.json: numbers that are not finite become null, which JSON knows."""
        return [plain(asdict(p)) for p in self.points]


def chosen_methods(wanted: Reduction) -> tuple[str, ...]:
    """Methods of the scene, or the paper's six and those beyond.

    Raises:
        BasisError: a name is unknown.
    """
    names = tuple(wanted.methods) or (*PAPER_METHODS, *BEYOND)
    for name in names:
        find_method(name)
    return names


def nearest(points: Sequence[Point], N: int = COMPARED, stable: bool = True) -> int | None:
    """Number of the point nearest to N, the smaller of two, among the stable ones or all."""
    some = [i for i, p in enumerate(points) if p.stable or not stable]
    return min(some, key=lambda i: (abs(points[i].N - N), points[i].N)) if some else None


def best(points: Sequence[Point]) -> int | None:
    """Number of the stable point with the least error of the deformation."""
    some = [i for i, p in enumerate(points) if p.stable and np.isfinite(p.error_deformation)]
    return min(some, key=lambda i: points[i].error_deformation) if some else None


def noted(points: Sequence[Point]) -> set[int]:
    """Points whose models are kept: the best stable one, and those that pictures and the parameter box compare."""
    found = (best(points), nearest(points), nearest(points, LARGER), nearest(points, stable=False))
    return {i for i in found if i is not None}


def sizes_for(method: Method, n_s: int, wanted: Sequence[int]) -> list[int]:
    """The dimensions among ``wanted`` that this method can have, ascending; the hand's columns count."""
    none = misfits(method, n_s, wanted)
    return sorted({N for N in wanted if N not in none})


def misfits(method: Method, n_s: int, wanted: Sequence[int]) -> dict[int, str]:
    """Dimensions among ``wanted`` that this method cannot have whatever the snapshots are, with the reason."""
    step = 2 if method.pairs else 1
    hand = 2 * n_s if method.fixed else 0
    least = hand + step
    found = {}
    for N in wanted:
        if N % step:
            found[N] = f"N = {N}: only even N exist for this basis"
        elif least > N:
            found[N] = f"N = {N}: the {hand} columns of the hand count; ask for N >= {least}"
    return found


def bases_of(
    name: str, states: States, sizes: list[int], wanted: Reduction, refused: dict[int, str]
) -> tuple[tuple[Basis, ...], int | None]:
    """Bases at all sizes that the snapshots carry, and the columns that keep the wanted share of the energy.

    What does not fit is noted in ``refused`` by its N, with the reason. Collective.
    """
    method = METHODS[name]
    inner = None if wanted.inner == "auto" or not method.snapshots else wanted.inner
    rule = [Truncation(energy=wanted.energy)] if method.snapshots else []
    sizes = list(sizes)
    while sizes or rule:
        try:
            bases = make_bases(name, states, [*sizes, *rule], inner, wanted.engine)
        except BasisError as error:
            most = error.most
            beyond = [k for k in sizes if most is not None and k > most]
            if not beyond and rule:
                rule = []  # it may be the share that fails; what fails in general fails again
                continue
            what = "the snapshots carry above rounding" if method.snapshots else "this mesh has modes for"
            why = str(error).removeprefix(f"{name}: ")
            if most is not None and beyond:
                why = f"more than {what}; ask for N <= {most}"
            refused |= {k: f"N = {k}: {why}" for k in beyond or sizes}
            sizes = [k for k in sizes if beyond and k not in beyond]
        else:
            return bases[: len(sizes)], bases[-1].N if rule else None
    return (), None


def _median_time(work: Callable[[], object], repeats: int, comm: MPI.Intracomm) -> float:
    """Median seconds; the slowest rank counts. Collective."""
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - begin)
    return float(comm.allreduce(statistics.median(seconds), MPI.MAX))


def comparison_of(model: ReducedModel, against: Reference) -> Comparison:
    """What errors of this model and of smaller ones of its family are computed from. Not collective."""
    return Comparison(model, model.at(), against.model.system, against.snapshots, against.energy)


def measure(model: ReducedModel, against: Reference, comparison: Comparison | None = None) -> Point:
    """Run one reduced model at the scene's own parameter and compare. Collective.

    Args:
        model: which.
        against: the full run.
        comparison: of the largest model of the family; None prepares one for this model alone.

    Raises:
        ModelError: E or A is singular, so that the model has no run or no equilibrium to start in.
    """
    system = against.model.system
    comparison = comparison or comparison_of(model, against)
    with np.errstate(all="ignore"):  # an unstable model may overflow, and is marked
        small = model.at()
        step, drive = prepare(model, small, against, system)
        errors = comparison.errors(model, small, run(step, allow_unstable=True, **drive))
        comm = system.layout.comm
        setup = _median_time(lambda: prepare(model, model.at(), against, system)[0].stable, SETUPS, comm)
        online = _median_time(lambda: run(step, allow_unstable=True, **drive), REPEATS, comm)
    return Point(
        N=model.N,
        N_tissue=model.N - (2 * system.layout.n_s if model.fixed_solid else 0),
        split=model.split,
        error_deformation=errors.error_deformation,
        error=errors.error,
        error_canonical=errors.error_canonical,
        error_energy=errors.error_energy,
        projection_error_deformation=comparison.floor("deformation", model, small),
        projection_error=comparison.floor("velocities", model, small),
        time_offline=float(comm.allreduce(sum(model.seconds.values()), MPI.MAX)),
        time_setup=setup,
        time_online=online,
        spectral_abscissa=small.spectral_abscissa,
        stable=small.stable,
    )


def sweep(name: str, against: Reference, wanted: Reduction, progress: Progress | None = None) -> Swept:
    """One method at all its N. Collective.

    Raises:
        SolverError: a factorisation failed.
    """
    full, method = against.model, METHODS[name]
    states = States(full.system, ((full.system, against.snapshots),))
    sizes = sizes_for(method, full.system.layout.n_s, wanted.N)
    refused = misfits(method, full.system.layout.n_s, wanted.N)
    bases, kept = bases_of(name, states, sizes, wanted, refused)
    outputs, key = make_outputs(full.scene, full.system), scene_hash(full.scene)
    points: list[Point] = []
    models: dict[int, ReducedModel] = {}
    # smaller bases are leading columns of the largest: one factorisation gives the errors of all
    comparison = comparison_of(project(bases[-1], full.system, outputs, key), against) if bases else None
    for i, basis in enumerate(bases):
        if progress is not None:
            progress(name, i, len(bases))
        model = project(basis, full.system, outputs, key)
        try:
            points.append(measure(model, against, comparison))
        except ModelError as error:
            refused[basis.N] = f"N = {basis.N}: {str(error).removeprefix(f'{name}: ')}"
            continue
        models[len(points) - 1] = model
        models = {j: models[j] for j in models if j in noted(points)}
    return Swept(
        method=method,
        points=tuple(points),
        models=models,
        sigma=bases[0].sigma if bases else (),
        refused=dict(sorted(refused.items())),
        kept=kept,
        inner=bases[0].inner if bases else "",
    )
