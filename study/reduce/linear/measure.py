"""Every basis at every N against the full run, and the best of them over the box: errors, times, stability."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem import Reduction, Scene
from softgrasp.reduction import Basis, ModelComparison, ModelError, ReducedModel, project_scene, registry
from softgrasp.reduction.bases.condense import condensed
from softgrasp.reduction.bases.states import BasisError, States, states_of
from softgrasp.reduction.errors import all_at, prepare
from softgrasp.reduction.online import run
from softgrasp.reduction.parameters import box_of, grid_of, outside, run_at, training_of, training_states
from softgrasp.reduction.propagator import Propagator
from softgrasp.reduction.replay import FullRun, comparison_of, replay_inputs, replay_linear
from softgrasp.study.reduce.linear.bases import bases_of, shares_of, small
from softgrasp.study.reduce.linear.ranks import dealt, divided
from softgrasp.study.reduce.linear.result import (
    COMPARED,
    LARGER,
    BoxErrors,
    BoxPoint,
    DomainTests,
    MethodSweep,
    Point,
    TestedModel,
    by_error,
    kept_points,
    nearest,
    timed_points,
)
from softgrasp.study.reduce.times import FullTimes, Say, Turns, in_turn
from softgrasp.study.shell import median_processor_seconds

FURTHER = ("psd_svd_like", "psd_svd_like_fixed", "psd_cotangent_lift_fixed", "psd_fixed_relative", "craig_bampton")
REPEATS, SETUPS = 5, 3  # behind each median of the online time and of the set-up
METHODS_TESTED = 4  # over the box
PAPER_SIZES = 956, 600  # n_e and steps of its forward run
PAPER_FULL, PAPER_REDUCED = 16.22, 0.097  # seconds of [SBRH21]: 2n = 1916, 600 steps, and PSD at N = 14
LEAST_MESH = 50  # tissue unknowns: a body of fewer deforms in no useful way

Progress = Callable[[int, int], None]
"""Called with what is done and what there is."""


def chosen_methods(scene: Scene) -> tuple[str, ...]:
    """Methods of the scene, or the paper's six, further ones and the scene's own. Collective.

    Raises BasisError: a name is unknown, or a file of ``reduction.plugins`` does not give a basis.
    """
    options: Reduction = scene.reduction
    own: tuple[str, ...] = ()
    if options.plugins:
        from softgrasp.reduction.bases.plugins import load_plugins  # only scenes with bases of their own pay for it

        own = load_plugins([scene.path(file) for file in options.plugins])
    names = tuple(options.methods) or (*registry.PAPER_METHODS, *FURTHER, *own)
    for name in names:
        registry.find_method(name)
    return names


def measured(
    bases: Sequence[Basis], full: FullRun, refused: dict[int, str], progress: Progress = lambda done, of: None
) -> Iterator[Measured]:
    """Models of nested bases with their errors; one without a run is put into ``refused``. Collective."""
    if not bases:
        return
    outputs = full.model.outputs
    # smaller bases are leading columns of the largest: one factorisation gives the errors of all
    comparison = comparison_of(project_scene(bases[-1], full.model, outputs), full)
    for i, basis in enumerate(bases):
        progress(i, len(bases))
        model = project_scene(basis, full.model, outputs)
        try:
            yield measure(model, full, comparison)
        except ModelError as error:
            refused[basis.N] = error.reason


@dataclass(frozen=True)
class Measured:
    """One reduced model with its errors, before its times."""

    model: ReducedModel
    point: Point  # without times of set-up and run
    step: Propagator  # at the scene's own parameter
    drive: dict[str, Any]  # keywords of its run

    def light(self, full: FullRun) -> Measured:
        """The same without rows on the mesh, unless a new run needs them for its start."""
        if full.model.scene.time.start == "equilibrium" and "force" in self.drive:
            return self
        return replace(self, model=replace(self.model, reconstruction=None))

    def timed(self, full: FullRun) -> Point:
        """The point with the times of set-up and run, medians of processor time. Collective."""
        comm, model = full.model.system.layout.comm, self.model
        with np.errstate(all="ignore"):  # an unstable model may overflow, and is marked
            setup = median_processor_seconds(comm, lambda: replay_inputs(model, model.at(), full)[0].stable, SETUPS)
            online = median_processor_seconds(comm, lambda: run(self.step, allow_unstable=True, **self.drive), REPEATS)
        return replace(self.point, time_setup=setup, time_online=online)


def measure(model: ReducedModel, full: FullRun, comparison: ModelComparison) -> Measured:
    """Run one reduced model at the scene's own parameter and compare. Collective.

    ``comparison``: of the largest model of the family. Raises ModelError: E or A is singular, so that the model has no
    run or no equilibrium to start in.
    """
    layout = full.model.system.layout
    with np.errstate(all="ignore"):  # an unstable model may overflow, and is marked
        small = model.at()
        step, drive = replay_inputs(model, small, full)
        errors = comparison.errors(model, small, run(step, allow_unstable=True, **drive))
    point = Point(
        N=model.N,
        N_tissue=model.N - (2 * layout.n_s if model.fixed_solid else 0),
        split=model.split,
        **asdict(errors),
        projection_error_deformation=comparison.projection_error("deformation", model, small),
        projection_error=comparison.projection_error("velocities", model, small),
        time_offline=float(layout.comm.allreduce(sum(model.seconds.values()), MPI.MAX)),
        time_setup=math.nan,
        time_online=math.nan,
        spectral_abscissa=small.spectral_abscissa,
        stable=small.stable,
    )
    return Measured(model, point, step, drive)


@dataclass(frozen=True)
class Untimed:
    """One method at all its N, before its times; see :class:`MethodSweep`."""

    name: str  # key of the method
    found: list[Measured]
    refused: dict[int, str]
    N_energy: int | None
    bases: tuple[tuple[np.ndarray, ...], str]  # singular values and inner product

    def times(self, full: FullRun) -> tuple[Point, ...]:
        """Its points with times. Collective."""
        return tuple(each.timed(full) for each in self.found)

    def sweep(self, points: tuple[Point, ...]) -> MethodSweep:
        """The method with these points."""
        models = {each.model.N: each.model for each in self.found if each.model.N in kept_points(points)}
        sigma, inner = self.bases
        refused = dict(sorted(self.refused.items()))
        return MethodSweep(registry.find_method(self.name), points, models, sigma, refused, self.N_energy, inner)


def untimed(
    name: str,
    full: FullRun,
    options: Reduction,
    progress: Progress = lambda done, of: None,
    states: States | None = None,
) -> Untimed:
    """One method at all its N without times. Collective. Raises SolverError: a factorisation failed.

    Args:
        states: of the run, which several methods share; None: made here.
    """
    refused: dict[int, str] = {}
    states = states or states_of(full.model.system, full.snapshots)
    bases, N_energy = bases_of(name, states, options.N, options, refused)
    found: list[Measured] = []
    for each in measured(bases, full, refused, progress):
        found.append(each)
        kept = kept_points([one.point for one in found])
        found = [one if one.model.N in kept else one.light(full) for one in found]
    return Untimed(name, found, refused, N_energy, (bases[0].sigma, bases[0].inner) if bases else ((), ""))


def sweep(name: str, full: FullRun, options: Reduction, progress: Progress = lambda done, of: None) -> MethodSweep:
    """One method at all its N, as :func:`untimed`, with its times. Collective. Raises SolverError: as there."""
    found = untimed(name, full, options, progress)
    return found.sweep(found.times(full))


def sweep_all(
    names: Sequence[str],
    full: FullRun,
    say: Say,
    options: Reduction | None = None,
    ranks: MPI.Intracomm = MPI.COMM_SELF,
) -> tuple[MethodSweep, ...]:
    """Every method at all N of the options, None for those of the scene. Collective.

    On one rank with a free core a forked process makes and measures the bases of some of the methods, but takes no
    times. ``ranks``: that divide methods and times, with the whole run each.
    """
    options = options or full.model.scene.reduction
    size = len(options.N)
    every = states = states_of(full.model.system, full.snapshots)
    with suppress(BasisError):  # each method states what is wrong with the snapshots
        states = condensed(every)

    def one(name: str) -> Untimed:
        def progress(done: int, of: int) -> None:
            say(name, size * names.index(name) + size * done // of, size * len(names))

        used = states if name in registry.METHODS else every  # a user's basis may need the columns in time
        return untimed(name, full, options, progress, used)

    parts = shares_of(names, ranks.size if ranks.size > 1 else 2 if small(states) else 1)
    same = full.model.system.layout, *map(registry.find_method, names)
    found = divided(ranks, [[partial(one, name) for name in part] for part in parts], same)
    found.sort(key=lambda each: names.index(each.name))
    times = dealt(ranks, [partial(each.times, full) for each in found])
    return tuple(each.sweep(points) for each, points in zip(found, times, strict=True))


def box_models(
    full: FullRun, sweeps: Sequence[MethodSweep], states: States | None, ranks: MPI.Intracomm = MPI.COMM_SELF
) -> list[TestedModel]:
    """Models of the best methods at two N: those of the sweep, and from ``states`` with the same N. Collective."""
    outputs, options, models = full.model.outputs, full.model.scene.reduction, []
    tested = [s for s, _ in by_error(sweeps)[:METHODS_TESTED]]
    sizes = [sorted({p.N for N in (COMPARED, LARGER) if (p := nearest(s.points, N)) is not None}) for s in tested]

    def trained(s: MethodSweep, wanted: list[int]) -> list[ReducedModel]:
        if states is None or not s.method.snapshots:
            return []
        bases, _ = bases_of(s.method.key, states, wanted, options, {})
        return [project_scene(b, full.model, outputs) for b, _ in zip(bases, wanted, strict=False)]

    same = full.model.system.layout, *(s.method for s in tested)
    order = sorted(range(len(tested)), key=lambda i: not (tested[i].method.pairs and tested[i].method.snapshots))
    every = dealt(ranks, [partial(trained, tested[i], sizes[i]) for i in order], same)  # the longest first
    for i, (s, wanted) in enumerate(zip(tested, sizes, strict=True)):
        models += [TestedModel(s.method, False, s.models[N]) for N in wanted]
        models += [TestedModel(s.method, True, model) for model in every[order.index(i)]]
    return models


Family = tuple[str, bool]
"""Key of a method, and whether several runs trained it."""


def families(full: FullRun, models: Sequence[TestedModel]) -> dict[Family, ModelComparison]:
    """Comparison with the full run by family of models, made with the largest model of each. Collective."""
    largest = {(m.method.key, m.several): m.model for m in sorted(models, key=lambda m: m.model.N)}
    made = {family: comparison_of(model, full) for family, model in largest.items()}
    prepare(list(made.values()), ["deformation"])
    return made


def moved(known: dict[Family, ModelComparison], full: FullRun) -> dict[Family, ModelComparison]:
    """Comparisons as of :func:`families` with another full run, of the same densities. Collective."""
    system = full.model.system
    places = [each.model.at(system.materials) for each in known.values()]
    return dict(zip(known, all_at(list(known.values()), places, system, full.snapshots), strict=True))


def errors_at(
    full: FullRun, models: Sequence[TestedModel], comparisons: dict[Family, ModelComparison]
) -> tuple[float, ...]:
    """Deformation errors of all models at the parameter of one full run, without any new projection. Collective."""
    errors = []
    for m in models:
        with np.errstate(all="ignore"):  # may be unstable away from the training parameter
            reduced = replay_linear(m.model, full.model, full, allow_unstable=True)
            small, comparison = m.model.at(full.model.system.materials), comparisons[m.method.key, m.several]
            errors.append(comparison.state_error("deformation", m.model, small, reduced))
    return tuple(errors)


def measure_box(
    full: FullRun,
    sweeps: Sequence[MethodSweep],
    progress: Progress = lambda done, of: None,
    ranks: MPI.Intracomm = MPI.COMM_SELF,
) -> DomainTests:
    """Train, and test over the box. Collective. Raises SolverError: a run failed. ResourceError: no memory.

    ``ranks``: that divide runs and methods, with the whole run each.
    """
    scene = full.model
    reason = outside(scene) or ("" if by_error(sweeps) else "no method has a stable model")
    if reason:
        return DomainTests(none=reason)
    first, training, grid = scene.system.materials[0], training_of(scene), grid_of(scene)
    each = partial(dealt, ranks, same=(scene.system.layout,))
    models = box_models(full, sweeps, training_states(full, training, each) if training else None, ranks)
    trained_at = ((first.lam, first.mu), *training)
    known = families(full, models)

    def at(k: int) -> tuple[float, ...]:
        progress(k, len(grid))
        place = run_at(scene, *grid[k])
        return errors_at(place, models, moved(known, place))

    calls: list[Callable[[], tuple[float, ...]]] = [partial(at, k) for k in range(len(grid))]
    *errors, own = dealt(ranks, [*calls, lambda: errors_at(full, models, known)])
    points = [
        BoxPoint(lam, mu, any(np.allclose((lam, mu), place) for place in trained_at), found)
        for (lam, mu), found in zip(grid, errors, strict=True)
    ]
    tests, summary = [p for p in points if not p.trained] or points, []
    for i, m in enumerate(models):
        seen = [p.errors[i] for p in tests]
        runs = len(trained_at) if m.several else int(m.method.snapshots)
        largest = max(seen, key=lambda e: (not np.isfinite(e), e))
        summary.append(BoxErrors(m.method.key, m.model.N, runs, own[i], statistics.median(seen), largest))
    return DomainTests(tuple(models), tuple(points), tuple(summary), trained_at if training else (), box_of(scene))


def headline_turns(full: FullRun, sweeps: Sequence[MethodSweep], ranks: MPI.Intracomm = MPI.COMM_SELF) -> Turns | None:
    """Full model and the most accurate stable reduced one in turn; None without any. Collective.

    ``ranks``: that divide the rounds.
    """
    if not (chosen := by_error(sweeps)):
        return None
    s, p = chosen[0]
    model = s.models[p.N]
    step, drive = replay_inputs(model, model.at(), full)

    def new() -> None:
        small = model.at()
        again, inputs = replay_inputs(model, small, full)
        run(again, allow_unstable=not small.stable, **inputs)

    return in_turn(full.model, lambda: run(step, **drive), new, ranks)


def speed_notes(n_e: int, steps: int, full: FullTimes, sweeps: Sequence[MethodSweep]) -> tuple[str, ...]:
    """What the speed-up is measured against, the mesh of equal times, and the paper's figure beside ours."""
    against = (
        f"Full model, prefactored: {steps} steps in {1e3 * full.steps:.1f} ms; its factorisation takes "
        f"{1e3 * full.factor:.1f} ms. new: a new parameter, small matrices, test of stability and propagator with the "
        "run. x again: steps of the full model over a run of the same small model again, all made beforehand on both "
        "sides. x new: factorisation and steps over new. Break-even runs = offline / (full - new), at new parameters; "
        "the full run that gives the snapshots is one more."
    )
    stable = [(method, p) for method, p in timed_points(sweeps) if p.stable]
    if not stable:
        return (against,)
    method, p = next((chosen for chosen in stable if chosen[0].key == "psd"), stable[0])
    # tissue unknowns at which a full run would take as long as a reduced one, at this mesh's time per unknown
    mesh, model = n_e * p.time_online / full.steps, f"{method.title}, N = {p.N}"
    if mesh < LEAST_MESH:
        pays = f"the reduced run ({model}) is faster than a full run on every mesh"
    else:
        pays = f"a full run of n_e = {mesh:.0f} would take as long as the reduced one ({model})"
    notes = (
        against,
        f"Break-even mesh: {pays}, at this mesh's time per unknown. The reduced time does not grow with the mesh, see "
        "python -m benchmarks meshes.",
    )
    if (n_e, steps) != PAPER_SIZES:
        return notes
    return (
        *notes,
        f"The paper reports {PAPER_FULL} s against {PAPER_REDUCED} s at 2n = 1916 and N = 14, a speed-up of "
        f"{PAPER_FULL / PAPER_REDUCED:.0f}; here the same comparison, each side from its matrices on, gives "
        f"{1e3 * (full.factor + full.steps):.1f} ms against {1e3 * (p.time_setup + p.time_online):.2f} ms, "
        f"a speed-up of {full.against(p).new:.0f} for a new parameter ({model}).",
    )
