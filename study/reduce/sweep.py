"""Every basis at every N against the full run: errors, times, stability."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.scene.control import Reduction
from softgrasp.fem.scene.file import scene_hash
from softgrasp.reduction.basis import Basis
from softgrasp.reduction.errors import Comparison, View
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.online import run
from softgrasp.reduction.projection import project
from softgrasp.reduction.registry import METHODS, PAPER_METHODS, Method, find_method, make_bases
from softgrasp.reduction.replay import Reference, prepare
from softgrasp.reduction.states import BasisError, States
from softgrasp.reduction.truncation import Truncation
from softgrasp.study.shell.session import plain

BEYOND = ("psd_svd_like", "psd_svd_like_fixed", "psd_cotangent_lift_fixed", "psd_fixed_relative", "craig_bampton")
REPEATS, SETUPS = 15, 3  # behind each median of the online time and of the set-up
COMPARED = 14  # N at which methods are compared: the paper's
LARGER = 30  # N of the second model that is tested at other parameters

Progress = Callable[[str, int, int], None]
"""Called with the method, what is done and what there is."""


@dataclass(frozen=True)
class Point:
    """One basis at one N; errors are relative, times in seconds, the abscissa in 1/s. Unstable runs may overflow.

    Attributes:
        N: columns of the basis that count, see :func:`uncounted`.
        columns: basis vectors in all, with those of the hand.
        error: |X - X_r|_F / |X|_F of the snapshot matrix that the basis is built from: [q_s, v_s, q_e, v_e], or
            [q_s, p_s, q_e, p_e] for a canonical basis [SBRH21].
        error_qv: the same of [q_s, v_s, q_e, v_e] for every basis.
        error_deformation: of [z, v_z], after removing the rigid motion of the hand.
        error_energy: largest error of the tissue's energy over its largest value.
        projection_error: the floor of ``error`` that the basis sets.
        projection_error_qv: the floor of ``error_qv``.
        time_offline: basis and projection; one factorisation of the snapshots serves all N.
        time_setup: small matrices and propagator at a parameter.
        time_online: a whole run.
        spectral_abscissa: largest real part of an eigenvalue.
        stable: no growing mode.
    """

    N: int
    columns: int
    error: float
    error_qv: float
    error_deformation: float
    error_energy: float
    projection_error: float
    projection_error_qv: float
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
        refused: N asked for that this basis cannot have, each with its reason.
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
    """Number of the stable point with the least error."""
    some = [i for i, p in enumerate(points) if p.stable and np.isfinite(p.error)]
    return min(some, key=lambda i: points[i].error) if some else None


def noted(points: Sequence[Point]) -> set[int]:
    """Points whose models are kept: the best stable one, and those that pictures and the parameter box compare."""
    found = (best(points), nearest(points), nearest(points, LARGER), nearest(points, stable=False))
    return {i for i in found if i is not None}


def uncounted(method: Method, n_s: int) -> int:
    """Columns that N leaves out: the hand's own of canonical bases with fixed solid modes and of Craig-Bampton."""
    return 2 * n_s if method.fixed and method.preserving else 0


def sizes_for(method: Method, n_s: int, wanted: Sequence[int]) -> list[int]:
    """Numbers of columns that give the dimensions among ``wanted`` that this method can have."""
    none = misfits(method, n_s, wanted)
    return sorted({N + uncounted(method, n_s) for N in wanted if N not in none})


def misfits(method: Method, n_s: int, wanted: Sequence[int]) -> dict[int, str]:
    """Dimensions among ``wanted`` that this method cannot have whatever the snapshots are, with the reason."""
    step = 2 if method.pairs else 1
    hand = 2 * n_s - uncounted(method, n_s) if method.fixed else 0
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
    hand = uncounted(method, states.layout.n_s)
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
                why = f"more than {what}; ask for N <= {most - hand}"
            refused |= {k - hand: f"N = {k - hand}: {why}" for k in beyond or sizes}
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
    """
    system = against.model.system
    comparison = comparison or comparison_of(model, against)
    with np.errstate(all="ignore"):  # an unstable model may overflow, and is marked
        small = model.at()
        step, drive = prepare(model, small, against, system)
        errors = comparison.errors(model, small, run(step, allow_unstable=True, **drive))
        own: View = "momenta" if model.coordinates == "qp" else "velocities"
        comm = system.layout.comm
        setup = _median_time(lambda: prepare(model, model.at(), against, system), SETUPS, comm)
        online = _median_time(lambda: run(step, allow_unstable=True, **drive), REPEATS, comm)
    return Point(
        N=model.N - uncounted(METHODS[model.name], system.layout.n_s),
        columns=model.N,
        error=errors.error_canonical if own == "momenta" else errors.error,
        error_qv=errors.error,
        error_deformation=errors.error_deformation,
        error_energy=errors.error_energy,
        projection_error=comparison.floor(own, model, small),
        projection_error_qv=comparison.floor("velocities", model, small),
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
        models[i] = project(basis, full.system, outputs, key)
        points.append(measure(models[i], against, comparison))
        models = {j: models[j] for j in models if j in noted(points)}
    hand = uncounted(method, full.system.layout.n_s)
    return Swept(
        method=method,
        points=tuple(points),
        models=models,
        sigma=bases[0].sigma if bases else (),
        refused=dict(sorted(refused.items())),
        kept=None if kept is None else kept - hand,
        inner=bases[0].inner if bases else "",
    )
